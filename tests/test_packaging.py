"""The installed package: every folder and data file, one name for the kernels, and dependencies that are used."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import resources
from pathlib import Path

import pytest
from import_graph import FACE, LAYERS, import_graph, imports, layer_of, ordered, print_graph, source_files

import mgavatar
from mgavatar import cli
from mgavatar.errors import DataError

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
REQUIRED = PROJECT["project"]["dependencies"]
EXTRAS = PROJECT["project"]["optional-dependencies"]
DISTRIBUTION_OF = {"warp": "warp-lang", "PIL": "Pillow", "kornia_rs": "kornia-rs"}
"""Names to install, where they differ from the names to import."""

POSIX_ONLY = {
    "crypt",
    "curses",
    "fcntl",
    "grp",
    "posix",
    "pty",
    "pwd",
    "readline",
    "resource",
    "syslog",
    "termios",
    "tty",
}
"""Modules of Python's that Windows lacks."""


MODULES = source_files()


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
    # Git for Windows writes a link as a text file unless it is told otherwise; installing works all the same.
    assert (link.readlink() if link.is_symlink() else Path(link.read_text("utf-8"))) == Path("../kernels")


def test_kernels_have_one_name():
    """``import kernels`` would be another package of the index, or a second copy of every kernel."""
    spec = importlib.util.spec_from_file_location("kernels", ROOT / "kernels" / "__init__.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.raises(ImportError, match=r"import mgavatar\.kernels, not kernels"):
        spec.loader.exec_module(module)
    assert "kernels" not in sys.modules


def test_the_installed_package_has_its_data():
    """Presets, the report's templates and the type marker are there in every way of installing."""
    assert PROJECT["tool"]["setuptools"]["package-data"] == {
        "mgavatar.configs": ["*.toml"],
        "mgavatar": ["py.typed"],
        "mgavatar.reporting": ["*.j2"],
    }
    for package, folder in (("mgavatar.configs", "configs"), ("mgavatar.reporting", "mgavatar/reporting")):
        shipped = {file.name for file in resources.files(package).iterdir()}
        assert {path.name for path in (ROOT / folder).iterdir() if path.suffix in (".toml", ".j2")} <= shipped
    assert (resources.files("mgavatar") / "py.typed").is_file()


def test_the_wheel_is_complete(tmp_path):
    """It holds every module and data file and nothing else, also if it is built from a checkout without links."""
    for folder in ("mgavatar", "kernels", "configs"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("kernels", "__pycache__"))
    (tmp_path / "mgavatar" / "kernels").write_text("../kernels", "utf-8")
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, tmp_path)
    build = "import setuptools.build_meta as backend; backend.build_wheel('dist')"
    subprocess.run([sys.executable, "-c", build], cwd=tmp_path, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").iterdir()
    with zipfile.ZipFile(wheel) as archive:
        shipped = {name for name in archive.namelist() if ".dist-info/" not in name}
    modules = {
        "/".join([*name.split("."), *(["__init__"] if path.name == "__init__.py" else [])]) + ".py"
        for name, path in MODULES.items()
    }
    presets = {f"mgavatar/configs/{path.name}" for path in (ROOT / "configs").glob("*.toml")}
    templates = {"mgavatar/reporting/page.html.j2", "mgavatar/reporting/chart.svg.j2"}
    assert shipped == modules | presets | templates | {"mgavatar/py.typed"}


def test_the_version_is_said_once():
    """The package, the project and what is installed agree."""
    assert mgavatar.__version__ == PROJECT["project"]["version"]
    assert importlib.metadata.version("mgavatar") == mgavatar.__version__


def test_the_command_is_the_command_line():
    """``mgavatar`` starts ``mgavatar.cli:main``."""
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="mgavatar")
    assert entry.load() is cli.main


def names(requirements: list[str]) -> set[str]:
    """Return the names of the distributions that are required."""
    return {re.split(r"[<>=!~\[ ;]", requirement)[0].lower() for requirement in requirements}


def imported_distributions(*, lazy: bool) -> dict[str, set[str]]:
    """Return the modules that import each distribution of other people's."""
    found: dict[str, set[str]] = {}
    for name, path in MODULES.items():
        for imported in imports(path, lazy=lazy):
            top = imported.partition(".")[0]
            if top not in sys.stdlib_module_names and top not in ("mgavatar", "__future__"):
                found.setdefault(DISTRIBUTION_OF.get(top, top).lower(), set()).add(name)
    return found


def test_only_declared_dependencies_are_imported():
    """Whatever is imported is Python's, the project's, or in pyproject.toml; extras only inside functions."""
    users = {name: requirements for name, requirements in EXTRAS.items() if name != "dev"}
    optional = names([requirement for extra in users.values() for requirement in extra])
    for lazy, allowed in ((False, names(REQUIRED)), (True, names(REQUIRED) | optional)):
        for distribution, modules in imported_distributions(lazy=lazy).items():
            assert distribution in allowed, f"{distribution} is imported by {modules}"


def test_no_dependency_and_no_extra_without_code_behind_it():
    """Whatever a user has to install is imported somewhere in the package."""
    imported = set(imported_distributions(lazy=True))
    assert set(EXTRAS) == {"video", "dev"}
    for requirements in (REQUIRED, *(extra for name, extra in EXTRAS.items() if name != "dev")):
        assert names(requirements) <= imported


def test_importing_needs_nothing_that_windows_lacks():
    """Modules that only POSIX has are imported where they are used, with another way out."""
    for name, path in MODULES.items():
        loaded = {imported.partition(".")[0] for imported in imports(path, lazy=False)}
        assert not POSIX_ONLY & loaded, name


def test_text_files_have_an_encoding():
    """Without one, Windows reads and writes text in the code page of its user's country."""
    for path in (*MODULES.values(), *(ROOT / "tools").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call):
                assert not lacks_encoding(node), f"{path}, line {node.lineno}: {ast.unparse(node)}"


def lacks_encoding(call: ast.Call) -> bool:
    """Return True for ``read_text()``, ``write_text(text)`` and ``open()`` of a text file, without an encoding."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if any(keyword.arg == "encoding" for keyword in call.keywords):
        return False
    if name in ("read_text", "write_text"):
        return len(call.args) < (1 if name == "read_text" else 2)
    of_path = isinstance(call.func, ast.Attribute)
    if name != "open" or (of_path and ast.unparse(call.func.value) in ("Image", "av", "archive", "os")):
        return False
    modes = call.args[0 if of_path else 1 :][:1] + [word.value for word in call.keywords if word.arg == "mode"]
    return not any(isinstance(mode, ast.Constant) and "b" in str(mode.value) for mode in modes)


def test_a_missing_encoding_is_found():
    """The search above sees what it is for."""
    for code, missing in (
        ("p.read_text()", True),
        ("p.read_text('utf-8')", False),
        ("p.write_text(t)", True),
        ("p.write_text(t, encoding='utf-8')", False),
        ("p.open()", True),
        ("p.open('a', encoding='utf-8')", False),
        ("p.open('rb')", False),
        ("open(p, 'w')", True),
        ("open(p, mode='xb')", False),
        ("Image.open(p)", False),
    ):
        (call,) = (node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Call))
        assert lacks_encoding(call) is missing, code


def test_imports_point_one_way():
    """No circle, and no layer imports from a later one, not even inside a function."""
    graph = import_graph(MODULES)
    order = ordered(graph)
    assert len(order) == len(MODULES) - 1  # the face resolves its names when they are used
    assert order.index("mgavatar.kernels.rasterize") < order.index("mgavatar.head.body")
    assert order.index("mgavatar.geometry.stage") < order.index("mgavatar.fitting.fit")
    assert {"mgavatar.head.body", "mgavatar.camera"} <= graph["mgavatar.avatar_file"]


def test_the_face_imports_nothing_at_once():
    """``import mgavatar`` is quick, and any module may import it."""
    assert not [name for name in imports(MODULES[FACE], lazy=False) if name.startswith("mgavatar")]


def test_every_layer_has_modules():
    """A folder that is renamed is renamed among the layers too."""
    filled = {layer_of(name) for name in MODULES if name != FACE}
    assert filled == set(range(len(LAYERS)))
    members = {name.split(".")[1] for name in MODULES if name != FACE}
    assert members == {member for layer in LAYERS.values() for member in layer}


@pytest.mark.parametrize(
    ("graph", "words"),
    [
        ({"mgavatar.head.body": {"mgavatar.capture.subject"}}, "head.body imports mgavatar.capture.subject"),
        ({"mgavatar.head.body": {"mgavatar.head.model"}, "mgavatar.head.model": {"mgavatar.head.body"}}, "a circle"),
        ({"mgavatar.helpers": set()}, "mgavatar.helpers: belongs to no layer"),
    ],
)
def test_imports_that_are_refused(graph, words):
    """An arrow that points up, a circle within a layer, a module without a place."""
    with pytest.raises(DataError, match=words):
        ordered(graph)


def test_imports_of_a_file(tmp_path):
    """Imports inside functions count; a name is followed to the module that has it; relative ones are refused."""
    (tmp_path / "a.py").write_text("import numpy\ndef f():\n    from mgavatar.b import c, d\n", "utf-8")
    (tmp_path / "b.py").write_text("from mgavatar.b.c import d\n", "utf-8")
    (tmp_path / "c.py").write_text("from . import d\n", "utf-8")
    files = {"mgavatar.a": tmp_path / "a.py", "mgavatar.b": tmp_path / "b.py", "mgavatar.b.c": tmp_path / "b.py"}
    graph = import_graph(files)
    assert graph["mgavatar.a"] == {"mgavatar.b", "mgavatar.b.c"}
    assert graph["mgavatar.b"] == {"mgavatar.b.c"}
    with pytest.raises(DataError, match=r"c\.py, line 1: a relative import"):
        list(imports(tmp_path / "c.py", lazy=True))


def test_the_import_graph_is_printed():
    """One line per module, with what it imports from nearer to the ground first."""
    text = print_graph()
    assert re.search(r"^    avatar +kernels\.rasterize, camera, ", text, re.MULTILINE)
    assert text.index("\nground\n") < text.index("\nhead\n") < text.index("\ncommand line\n")
