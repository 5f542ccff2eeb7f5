"""Docstrings: every public function has one, it begins with a verb, and none begins with a question."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FOLDERS = ("mgavatar", "kernels", "tools")

VERBS = frozenset(
    """
    Accumulate Adapt Add Advance Align Allocate Allow Announce Append Apply Arrange Ask Assemble Assign Average
    Bake Benchmark Bind Blend Bound Build
    Cache Calibrate Call Carry Cast Check Chart Choose Clamp Classify Clear Clip Clone Close Collect Combine Compare
    Compile Complete Composite Compute Configure Continue Convert Convolve Copy Count Create Crop Cut
    Decay Decide Decode Decorate Delete Densify Derive Describe Detach Detect Display Divide Draw Drive Drop
    Embed Encode End Ensure Estimate Evaluate Exclude Exit Expand Export Express Extend Extract
    Fetch Fill Filter Find Finish Fit Flatten Flush Forget Format Freeze
    Gather Generate Get Give Grow Guess
    Handle Hash Hide Hold
    Ignore Import Initialize Insert Install Integrate Interpolate Intersect Invert Iterate
    Join
    Keep
    Launch Lay Let Limit List Load Locate Log Look
    Make Map Mark Mask Match Measure Merge Mirror Move Multiply
    Name Normalize Note
    Open Order
    Pack Pad Parse Pass Perform Pick Place Plan Plot Pose Predict Prepare Print Process Project Propagate Prune
    Put
    Raise Rasterize Ray-trace Read Rebuild Recognize Record Reduce Refine Refuse Register Regress Release Remove
    Rename Render Repeat Replace Report Request Rescale Reset Resize Resolve Restore Resume Retarget Return
    Reverse Rotate Round Run
    Sample Save Scale Scan Scatter Schedule Score Search Seed Select Send Set Shade Shape Share Shift Show Shuffle
    Simulate Skin Skip Smooth Solve Sort Split Spread Stack Start State Step Stop Store Subdivide Subsample
    Subtract Sum Sweep Switch Sync
    Take Tell Test Time Trace Track Train Transform Triangulate Trim Truncate Try Turn
    Undo Unpack Unproject Update Use
    Validate Verify Visit
    Wait Walk Warn Weight Wrap Write
    Yield
    Zero
    """.split()  # noqa: SIM905  shorter to read than a list
)
"""Verbs with which a docstring may begin; add to them."""

QUESTIONS = frozenset({"What", "Whether", "How", "Where", "Of"})
ARTICLES = frozenset({"A", "An", "The"})

Function = ast.FunctionDef | ast.AsyncFunctionDef


def sources() -> list[str]:
    """List the source files of the project, relative to its root."""
    paths = [path.relative_to(ROOT) for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    return [path.as_posix() for path in paths if path.parts[:2] != ("mgavatar", "kernels")]  # a link to kernels/


def public_functions(tree: ast.Module) -> Iterator[tuple[str, Function]]:
    """Yield the public functions of a module and the public methods of its public classes."""
    for node in tree.body:
        if isinstance(node, Function) and not node.name.startswith("_"):
            yield node.name, node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for member in node.body:
                if isinstance(member, Function) and not member.name.startswith("_"):
                    yield f"{node.name}.{member.name}", member


def faults(source: str) -> list[str]:
    """List the public functions of a source whose docstring is missing or does not begin with a verb."""
    found = []
    for name, function in public_functions(ast.parse(source)):
        docstring = ast.get_docstring(function)
        if docstring is None:
            found.append(f"{function.lineno}: {name} has no docstring")
        elif (word := docstring.split()[0].rstrip(",;:.")) not in VERBS:
            found.append(f"{function.lineno}: {name} begins with {word!r}, not with a verb that VERBS has")
    return found


def riddles(source: str) -> list[str]:
    """List the docstrings, private ones too, that begin with a question word; those of functions, with an article."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, Function | ast.ClassDef | ast.Module) and (docstring := ast.get_docstring(node)):
            refused = QUESTIONS | ARTICLES if isinstance(node, Function) else QUESTIONS
            if (word := docstring.split()[0]) in refused:
                found.append(f"{getattr(node, 'name', 'the module')} begins with {word!r}")
    return found


@pytest.mark.parametrize("path", sources())
def test_docstrings_begin_with_a_verb(path: str) -> None:
    source = (ROOT / path).read_text(encoding="utf-8")
    assert not faults(source), path
    assert not riddles(source), path


@pytest.mark.parametrize("begin", ["What", "Whether", "How", "Where", "Of", "A", "An", "The", "Returns", "Largest"])
def test_other_beginnings_are_found(begin: str) -> None:
    source = f'class Thing:\n    @property\n    def size(self) -> int:\n        """{begin} it is."""\n'
    assert faults(source) == [f"3: Thing.size begins with {begin!r}, not with a verb that VERBS has"]


def test_a_missing_docstring_is_found() -> None:
    source = "def draw() -> None:\n    def inner() -> None: ...\n\ndef _hidden() -> None: ...\n"
    assert faults(source) == ["1: draw has no docstring"]
    assert not faults('async def draw() -> None:\n    """Draw."""\n')


def test_riddles_are_found_in_private_and_in_other_docstrings() -> None:
    source = (
        '"""What it does."""\n\nclass _Thing:\n    """The thing."""\n\n    def _size(self):\n        """The size."""\n'
    )
    assert riddles(source) == ["the module begins with 'What'", "_size begins with 'The'"]
