"""``docs/paper-map.md`` is true: every equation is in it, and every file and name that it gives is there."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAP = ROOT / "docs" / "paper-map.md"
EQUATIONS = range(1, 12)
PARTS = (
    "Subdivision", "Vertex-bound Gaussians", "Triplane", "Freezing", "Face frame", "Density control",
    "Hash grid", "View direction", "UV position maps", "Latent", "Rasterizer", "SSIM",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """A line of the table: what in the paper, and where in the code."""

    part: str
    places: tuple[tuple[str, str], ...]


def rows() -> list[Row]:
    """Parse the one table of the file."""
    lines = [line for line in MAP.read_text().splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[0] == ["Paper", "What", "Where"]
    assert set("".join(cells[1])) <= set("-: ")
    found = []
    for line in cells[2:]:
        assert len(line) == 3, line
        places = re.findall(r"`([^`:]+\.py):([\w.]+)`", line[2])
        assert len(places) == line[2].count("`") // 2, f"not file:name: {line[2]}"
        found.append(Row(line[0], tuple(places)))
    return found


ROWS = rows()
PLACES = sorted({place for row in ROWS for place in row.places})


def node_of(file: str, name: str) -> ast.AST:
    """The function, class, method, field or constant that a dotted name means in a file."""
    node: ast.AST = ast.parse((ROOT / file).read_text())
    for part in name.split("."):
        for child in ast.walk(node) if isinstance(node, ast.FunctionDef) else ast.iter_child_nodes(node):
            if child is not node and part in names_of(child):
                node = child
                break
        else:
            raise LookupError(f"{file} has no {name}")
    return node


def names_of(node: ast.AST) -> set[str]:
    """What a statement names."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return {target.id for target in targets if isinstance(target, ast.Name)}


def equations_in(text: str) -> set[int]:
    """Numbers of the equations that a text names, with its ranges."""
    found: set[int] = set()
    for first, last in re.findall(r"Eq\. (\d+)(?:(?: to |-)(\d+))?", text):
        found |= set(range(int(first), int(last or first) + 1))
    for first, second in re.findall(r"Eq\. (\d+) and (\d+)", text):
        found |= {int(first), int(second)}
    return found


@pytest.mark.parametrize("number", EQUATIONS)
def test_every_equation_has_one_row(number):
    """One row each, with at least one place."""
    matching = [row for row in ROWS if row.part == f"Eq. {number}"]
    assert len(matching) == 1
    assert matching[0].places


def test_no_equation_that_the_paper_lacks():
    """It numbers eleven."""
    numbers = [int(row.part.removeprefix("Eq. ")) for row in ROWS if row.part.startswith("Eq. ")]
    assert numbers == list(EQUATIONS)


@pytest.mark.parametrize("part", PARTS)
def test_the_named_parts_are_there(part):
    """What the paper names without a number."""
    assert any(row.part == part and row.places for row in ROWS)


@pytest.mark.parametrize(("file", "name"), PLACES)
def test_the_place_exists(file, name):
    """The file is there and has that name."""
    assert (ROOT / file).is_file()
    node_of(file, name)


@pytest.mark.parametrize("number", EQUATIONS)
def test_the_first_place_says_its_equation(number):
    """Whoever follows the map arrives at a docstring that names the equation."""
    (row,) = (row for row in ROWS if row.part == f"Eq. {number}")
    node = node_of(*row.places[0])
    assert isinstance(node, ast.FunctionDef | ast.ClassDef)
    assert number in equations_in(ast.get_docstring(node) or "")


def test_a_name_that_is_not_there_is_noticed():
    """The look-up itself can fail."""
    for name in ("nothing", "GeometryStage.nothing", "GeometryStage.step.nothing"):
        with pytest.raises(LookupError):
            node_of("mgavatar/geometry/stage.py", name)
