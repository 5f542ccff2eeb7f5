"""Print the import graph of the package, and fail if it has a circle or an import that points up.

    python tools/import_graph.py

Modules are printed layer by layer, and within a layer after the modules that they import. An import inside a function
counts as any other. Only the face, ``mgavatar/__init__.py``, is left out: it resolves its names when they are used.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from itertools import groupby
from pathlib import Path

from command_line import run

from mgavatar.errors import DataError

ROOT = Path(__file__).resolve().parents[1]

FACE = "mgavatar"

LAYERS: dict[str, tuple[str, ...]] = {
    "kernels": ("kernels",),
    "ground": (
        "camera",
        "config",
        "configs",
        "device",
        "errors",
        "files",
        "gaussians",
        "losses",
        "presets",
        "progress",
    ),
    "head": ("head",),
    "capture": ("capture",),
    "synthetic": ("synthetic",),
    "geometry": ("geometry",),
    "appearance": ("appearance",),
    "avatar file": ("avatar_file",),
    "avatar": ("avatar",),
    "fitting": ("fitting",),
    "driving": ("driving",),
    "scoring": ("scoring",),
    "reporting": ("reporting",),
    "export": ("export",),
    "pipeline": ("pipeline",),
    "benchmarks": ("benchmarks",),
    "demo": ("demo",),
    "command line": ("cli", "__main__"),
}
"""The way of the data: a layer imports from itself and from those before it. The names are folders and modules."""


def source_files() -> dict[str, Path]:
    """Return the file of every installed module, by the module's name."""
    folders = {
        "mgavatar": ROOT / "mgavatar",
        "mgavatar.kernels": ROOT / "kernels",
        "mgavatar.configs": ROOT / "configs",
    }
    modules = {}
    for package, folder in folders.items():
        for path in folder.rglob("*.py"):
            inside = path.relative_to(folder)
            if package == "mgavatar" and inside.parts[0] in ("kernels", "configs"):  # links to the other two
                continue
            name = ".".join([package, *inside.with_suffix("").parts]).removesuffix(".__init__")
            modules[name] = path
    return modules


def imports(path: Path, *, lazy: bool) -> Iterator[str]:
    """Yield what a file imports, by its full name: ``module`` or ``module.name``.

    Args:
        path: A Python file.
        lazy: Include imports inside functions and under ``TYPE_CHECKING``.

    Raises:
        DataError: If an import is relative.
    """
    nodes: list[ast.AST] = [ast.parse(path.read_text("utf-8"))]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise DataError(f"{path}, line {node.lineno}: a relative import; write the module's full name")
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif not lazy and (
            isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            or (isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING")
        ):
            continue
        nodes += ast.iter_child_nodes(node)


def import_graph(files: Mapping[str, Path]) -> dict[str, set[str]]:
    """Return the modules among ``files`` that each of them imports, at once or inside a function, without the face."""
    modules = set(files) - {FACE}
    graph = {}
    for name in sorted(modules):
        found = (_module_of(imported, modules) for imported in imports(files[name], lazy=True))
        graph[name] = {other for other in found if other is not None} - {name}
    return graph


def _module_of(imported: str, modules: set[str]) -> str | None:
    """Return the module that ``import`` loads for a full name: itself, else the one that has the name; None if none."""
    while imported and imported not in modules:
        imported = imported.rpartition(".")[0]
    return imported or None


def layer_of(module: str) -> int:
    """Return the place of a module's layer among ``LAYERS``.

    Raises:
        DataError: If it belongs to none.
    """
    top = module.removeprefix(f"{FACE}.").partition(".")[0]
    for place, members in enumerate(LAYERS.values()):
        if top in members:
            return place
    raise DataError(f"{module}: belongs to no layer; add {top} to LAYERS in tools/import_graph.py")


def ordered(graph: Mapping[str, set[str]]) -> list[str]:
    """Return the modules layer by layer, and within a layer after those that they import.

    Raises:
        DataError: If modules import each other in a circle, or one imports from a later layer; the message names them.
    """
    up = [f"{name} imports {other}" for name in graph for other in sorted(graph[name]) if points_up(name, other)]
    if up:
        raise DataError(f"imports that point up: {'; '.join(up)}")
    try:
        order = list(TopologicalSorter({name: sorted(graph[name]) for name in sorted(graph)}).static_order())
    except CycleError as error:
        raise DataError(f"a circle of imports: {' <- '.join(error.args[1])}") from error
    return sorted(order, key=layer_of)  # stable: within a layer, the order stays


def points_up(name: str, other: str) -> bool:
    """Return True if a module imports from a later layer than its own."""
    return layer_of(other) > layer_of(name)


def print_graph() -> str:
    """Return the import graph as text, one line per module.

    Raises:
        DataError: As :func:`ordered`.
    """
    graph = import_graph(source_files())
    imported = set().union(*graph.values())
    shown = [
        name for name in ordered(graph) if graph[name] or name in imported
    ]  # folders with a docstring alone are not
    lines: list[str] = []
    for layer, names in groupby(shown, key=layer_of):
        lines.append(list(LAYERS)[layer])
        for name in names:
            others = sorted(graph[name], key=lambda other: (layer_of(other), other))
            lines.append(f"    {_short(name):32} {', '.join(map(_short, others))}".rstrip())
    n_imports = sum(map(len, graph.values()))
    return "\n".join([*lines, f"{len(graph)} modules, {n_imports} imports; no circle, no import that points up"])


def _short(module: str) -> str:
    return module.removeprefix(f"{FACE}.")


if __name__ == "__main__":
    run(print_graph)
