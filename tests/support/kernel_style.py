"""The lint of Warp kernels: reads their source and lists what breaks the style that makes a tape correct."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping

_GROUPS = ("# In:", "# Out:")
_SHAPE = re.compile(r"#\s*\[[^\]]+\]")


def lint(source: str, snippets: Mapping[str, str]) -> list[str]:
    """List the faults of all kernels and device functions in one file.

    Args:
        source: Python source of the file.
        snippets: C++ text that decorators of native functions name, by the name of the variable that holds it.

    Returns:
        One line per fault, with the name of the kernel or function; empty if there is none.
    """
    functions = {node.name: node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)}
    device = {name: node for name, node in functions.items() if _is_device(node)}
    top_level = {node.name for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)}
    lines = source.splitlines()
    faults = []
    for name, node in device.items():
        faults += [f"{name}: {fault}" for fault in _annotation_faults(node)]
        if _decorated(node, "kernel"):
            written = written_arrays(name, device, snippets)
            found = [*_name_faults(name, name in top_level), *_group_faults(node, lines, written)]
            faults += [f"{name}: {fault}" for fault in found]
    return faults


def kernel_names(source: str) -> list[str]:
    """List the kernels of one file in their order."""
    nodes = ast.walk(ast.parse(source))
    return [node.name for node in nodes if isinstance(node, ast.FunctionDef) and _decorated(node, "kernel")]


def generated_adjoints(source: str) -> list[str]:
    """List the kernels of one file whose adjoint Warp derives: those that do not switch it off."""
    tree = ast.parse(source)
    calls = [node.value for node in tree.body if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)]
    if any(
        "set_module_options" in ast.unparse(call) and "'enable_backward': False" in ast.unparse(call) for call in calls
    ):
        return []
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and _decorated(node, "kernel")]
    return [node.name for node in nodes if "enable_backward=False" not in ast.unparse(node.decorator_list[0])]


def written_arrays(name: str, device: Mapping[str, ast.FunctionDef], snippets: Mapping[str, str]) -> set[str]:
    """Name the parameters of a device function that it writes to, by itself or through the functions that it calls."""
    node = device[name]
    parameters = [argument.arg for argument in node.args.args]
    if text := _snippet(node, snippets):
        return {parameter for parameter in parameters if _written_in_c(parameter, text)}
    written = set(_written_here(node))
    for call in _calls(node):
        callee = getattr(call.func, "id", "")
        if callee in device and callee != name:
            inside = written_arrays(callee, device, snippets)
            declared = [argument.arg for argument in device[callee].args.args]
            passed = zip(declared, call.args, strict=False)
            written |= {value.id for inner, value in passed if inner in inside and isinstance(value, ast.Name)}
    return written & set(parameters)


def _decorated(node: ast.FunctionDef, kind: str) -> bool:
    """Return True if a decorator is ``wp.kind``, called or not."""
    targets = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
    return any(isinstance(t, ast.Attribute) and t.attr == kind for t in targets)


def _is_device(node: ast.FunctionDef) -> bool:
    """Return True for kernels, device functions and native functions; ``native`` is the files' shorthand."""
    targets = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
    shorthand = any(isinstance(t, ast.Name) and t.id == "native" for t in targets)
    return shorthand or any(_decorated(node, kind) for kind in ("kernel", "func", "func_native"))


def _snippet(node: ast.FunctionDef, snippets: Mapping[str, str]) -> str:
    """Join the C++ texts that the decorator of a native function names; empty for one that is written in Python."""
    if _decorated(node, "kernel"):
        return ""
    names = [n.id for d in node.decorator_list for n in ast.walk(d) if isinstance(n, ast.Name)]
    return "\n".join(snippets[name] for name in names if name in snippets)


def _written_in_c(parameter: str, text: str) -> bool:
    """Return True if C++ text stores to ``parameter.data``, or takes a pointer to it that is not const."""
    data = rf"\b{parameter}\.data\b"
    element = rf"{data}\[[^;=]*\]\s*(?:[-+*/|&^]|<<|>>)?=(?!=)"
    pointer = r"\w+(?:::\w+)?\s*\*\s*(?:__restrict__\s+)?\w+\s*=\s*&?\s*"
    mutable = any(not re.search(r"\bconst\s+$", text[: m.start()]) for m in re.finditer(pointer + data, text))
    called = rf"(?:memcpy|atomicAdd)\(\s*(?:\([^()]*\))?\s*&?{data}"
    return mutable or re.search(element, text) is not None or re.search(called, text) is not None


def _calls(node: ast.FunctionDef) -> Iterator[ast.Call]:
    return (n for n in ast.walk(node) if isinstance(n, ast.Call))


def _written_here(node: ast.FunctionDef) -> Iterator[str]:
    """Names of what is stored to by subscript or by an atomic in a function's own body."""
    for statement in ast.walk(node):
        if isinstance(statement, ast.Assign):
            targets = statement.targets
        elif isinstance(statement, ast.AugAssign | ast.AnnAssign):
            targets = [statement.target]
        else:
            continue
        flat = [part for target in targets for part in getattr(target, "elts", [target])]
        for target in flat:
            while isinstance(target, ast.Subscript):
                target = target.value
                if isinstance(target, ast.Name):
                    yield target.id
    for call in _calls(node):
        if getattr(call.func, "attr", "").startswith("atomic_") and isinstance(call.args[0], ast.Name):
            yield call.args[0].id


def _is_array(annotation: ast.expr | None) -> bool:
    return annotation is not None and re.match(r"wp\.array\d?d?\[", ast.unparse(annotation)) is not None


def _annotation_faults(node: ast.FunctionDef) -> Iterator[str]:
    for argument in node.args.args:
        if isinstance(argument.annotation, ast.Call):
            yield f"{argument.arg} is declared as {ast.unparse(argument.annotation)}, not as wp.array[...]"


def _name_faults(name: str, at_top_level: bool) -> Iterator[str]:
    if not name.endswith("_kernel"):
        yield "the name does not end in _kernel"
    if at_top_level and not name.startswith("_"):  # kernels of a dtype are local to the function that makes them
        yield "the name is public"


def _group_faults(node: ast.FunctionDef, lines: list[str], written: set[str]) -> Iterator[str]:
    """Faults of the parameters' groups, of their shape comments, and of what is written."""
    signature = lines[node.lineno - 1 : node.body[0].lineno - 1]
    headings = [line.strip() for line in signature if line.strip().startswith("#")]
    if headings != list(_GROUPS):
        yield f"its groups are {headings}, not {list(_GROUPS)}"
        return
    start = node.lineno + next(i for i, line in enumerate(signature) if line.strip() == _GROUPS[0])
    split = node.lineno + next(i for i, line in enumerate(signature) if line.strip() == _GROUPS[1])
    for argument in node.args.args:
        if argument.lineno < start:
            yield f"{argument.arg} stands above {_GROUPS[0]}"
        is_array, is_output = _is_array(argument.annotation), argument.lineno > split
        if is_array and not _SHAPE.search(lines[argument.lineno - 1]):
            yield f"{argument.arg} has no shape in a trailing comment"
        if is_output and not is_array:
            yield f"{argument.arg} stands under {_GROUPS[1]} but is not an array"
        if is_output and is_array and argument.arg not in written:
            yield f"{argument.arg} stands under {_GROUPS[1]} but is not written"
        if not is_output and argument.arg in written:
            yield f"{argument.arg} stands under {_GROUPS[0]} but is written"
