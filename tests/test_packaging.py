"""What is installed: every folder, the presets, one name for the kernels, and only declared dependencies."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import re
import sys
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter
from importlib import resources
from pathlib import Path

import pytest

import mgavatar
from mgavatar import cli

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DISTRIBUTION_OF = {"warp": "warp-lang", "PIL": "Pillow", "kornia_rs": "kornia", "pxr": "usd-core"}
"""Where the name to import is not the name to install; kornia brings kornia_rs along."""


def source_files() -> dict[str, Path]:
    """Every module that is installed, by its name."""
    folders = {
        "mgavatar": ROOT / "mgavatar",
        "mgavatar.kernels": ROOT / "kernels",
        "mgavatar.configs": ROOT / "configs",
    }
    modules = {}
    for package, folder in folders.items():
        for path in folder.rglob("*.py"):
            inside = path.relative_to(folder)
            if package == "mgavatar" and inside.parts[0] in ("kernels", "configs"):
                continue
            name = ".".join([package, *inside.with_suffix("").parts]).removesuffix(".__init__")
            modules[name] = path
    return modules


MODULES = source_files()


def imports(path: Path, *, lazy: bool) -> Iterator[str]:
    """Modules that a file imports; without ``lazy``, only those that importing it imports."""
    nodes: list[ast.AST] = [ast.parse(path.read_text())]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif not lazy and (
            isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            or (isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING")
        ):
            continue
        nodes += ast.iter_child_nodes(node)


def test_the_packages_are_the_folders():
    """A new folder with an ``__init__.py`` that pyproject.toml does not list would be missing from the wheel."""
    packages = {name for name, path in MODULES.items() if path.name == "__init__.py"}
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == packages
    assert PROJECT["tool"]["setuptools"]["packages"] == sorted(packages)


def test_every_folder_of_modules_is_a_package():
    """No module lies in a folder without ``__init__.py``."""
    for path in MODULES.values():
        assert (path.parent / "__init__.py").is_file(), path


def test_where_the_packages_come_from():
    """Kernels and presets have folders of their own; type checkers find the kernels by a link."""
    assert PROJECT["tool"]["setuptools"]["package-dir"] == {
        "mgavatar": "mgavatar",
        "mgavatar.kernels": "kernels",
        "mgavatar.configs": "configs",
    }
    link = ROOT / "mgavatar" / "kernels"
    assert link.is_symlink()
    assert link.resolve() == ROOT / "kernels"


def test_kernels_have_one_name():
    """``import kernels`` would be another package of the index, or a second copy of every kernel."""
    spec = importlib.util.spec_from_file_location("kernels", ROOT / "kernels" / "__init__.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.raises(ImportError, match=r"import mgavatar\.kernels, not kernels"):
        spec.loader.exec_module(module)
    assert "kernels" not in sys.modules


def test_the_presets_and_the_type_marker_ship():
    """As data of their packages, in every way of installing."""
    shipped = {file.name for file in resources.files("mgavatar.configs").iterdir()}
    assert {path.name for path in (ROOT / "configs").glob("*.toml")} <= shipped
    assert (resources.files("mgavatar") / "py.typed").is_file()
    assert PROJECT["tool"]["setuptools"]["package-data"] == {"mgavatar.configs": ["*.toml"], "mgavatar": ["py.typed"]}


def test_the_version_is_said_once():
    """The package, the project and what is installed agree."""
    assert mgavatar.__version__ == PROJECT["project"]["version"]
    assert importlib.metadata.version("mgavatar") == mgavatar.__version__


def test_the_command_is_the_command_line():
    """``mgavatar`` starts ``mgavatar.cli:main``."""
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="mgavatar")
    assert entry.load() is cli.main


def test_the_extras():
    """What is optional is named by what it is for."""
    assert set(PROJECT["project"]["optional-dependencies"]) == {"viewer", "video", "track", "usd", "fleet", "dev"}


def test_only_declared_dependencies_are_imported():
    """Whatever is imported is of Python, of the project, or in pyproject.toml; extras only where they are used."""

    def names(requirements: list[str]) -> set[str]:
        return {re.split(r"[<>=!~\[ ;]", requirement)[0].lower() for requirement in requirements}

    required = names(PROJECT["project"]["dependencies"])
    optional = names([r for extra in PROJECT["project"]["optional-dependencies"].values() for r in extra])
    for name, path in MODULES.items():
        for lazy, allowed in ((False, required), (True, required | optional)):
            for imported in imports(path, lazy=lazy):
                top = imported.partition(".")[0]
                if top not in sys.stdlib_module_names and top not in ("mgavatar", "__future__"):
                    assert DISTRIBUTION_OF.get(top, top).lower() in allowed, f"{name} imports {top}"


def test_imports_point_one_way():
    """No module imports, on the way or at once, one that imports it."""
    graph = {
        name: {other for other in imports(path, lazy=False) if other in MODULES and other != name}
        for name, path in MODULES.items()
    }
    order = list(TopologicalSorter(graph).static_order())  # raises CycleError
    assert order.index("mgavatar.geometry.stage") < order.index("mgavatar.fitting.fit") < len(order)
    for name, others in graph.items():
        if name.startswith("mgavatar.kernels"):
            assert all(other.startswith("mgavatar.kernels") for other in others), name
        if name.startswith("mgavatar.geometry"):
            assert not any(other.startswith("mgavatar.appearance") for other in others), name
