"""``tools/results_table.py``: the pages show what docs/results.json holds, and no page repeats its numbers."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import results_table as tool
from markdown_cells import cells_of
from trade_raster import fraction

from mgavatar.config import ACCURACY
from mgavatar.errors import DataError
from mgavatar.presets import preset_table

ROOT = Path(__file__).resolve().parents[1]
RESULTS = json.loads(tool.RESULTS.read_text("utf-8"))
REPEATED = [
    "docs/choices.md",
    "docs/formats.md",
    "docs/paper-map.md",
    "docs/performance.md",
    "docs/presets-and-budgets.md",
]
"""Pages beside the two that show the results; the lab's journal has numbers of its own."""


@pytest.mark.parametrize("page", tool.PAGES, ids=lambda page: page.name)
def test_the_page_shows_what_was_measured(page):
    """Its tables are those that the tool makes now: run ``python tools/results_table.py --write``."""
    text = page.read_text("utf-8")
    assert "<!-- results:begin" in text
    assert tool.filled(text, RESULTS, where=page.name) == text


def test_the_page_has_every_table():
    """The README's aside, no table is left out."""
    text = tool.PAGES[0].read_text("utf-8")
    assert re.findall(r"results:begin (\w+)", text) == [name for name in tool.TABLES if name != "readme"]


@pytest.mark.parametrize("name", REPEATED)
def test_no_score_stands_in_another_page(name):
    """A score in decibels stands in the results alone, so that a new measurement changes one place."""
    text = (ROOT / name).read_text("utf-8")
    scores = {f"{row[split]['psnr']:.2f}" for row in RESULTS["fits"]["rows"] for split in ("val", "test")}
    assert scores & set(re.findall(r"\d+\.\d+", text)) == set()


def test_a_table_known_by_hand():
    """Differences to the first row of the capture, spreads, cells that were not measured."""
    first = {
        "tables": ["comparison"], "capture": "a", "preset": "quick", "fits": 2, "commit": "c",
        "val": {"psnr": 30.0, "psnr_sd": 0.5, "ssim": 0.9}, "test": {"psnr": 28.0},
        "mm": {"face": 0.5}, "iterations": [1000, 20], "seconds": 1815,
    }  # fmt: skip
    second = first | {"preset": "quick,baseline", "val": {"psnr": 29.0}, "test": {"psnr": 28.5}}
    results = {"captures": {"a": {}}, "fits": {"rows": [first, second]}}
    _, *rows = cells_of(tool.table(results, "comparison"))
    assert rows[0][:5] == ["a", "`quick`", "2", "30.00 ± 0.50, 0.900", "28.00"]
    assert rows[0][5:] == ["0.50", "–", "–", "–", "–", "–", "1,000 + 20", "1,815", "–"]
    assert rows[1][3:5] == ["29.00 (-1.00)", "28.50 (+0.50)"]


def test_readme_rows():
    """One row per fit that the README shows, beside the baseline of the same capture and preset."""
    _, *cells = cells_of(tool.results_table(readme=True))
    rows = [row for row in RESULTS["fits"]["rows"] if "readme" in row["tables"]]
    assert len(cells) == len(rows)
    scan = next(row for row in cells if row[0].startswith("scan"))
    baseline = next(
        row for row in RESULTS["fits"]["rows"] if (row["capture"], row["preset"]) == ("scan", "quick,baseline")
    )
    assert f"{baseline['val']['psnr']:.1f} / {baseline['test']['psnr']:.1f}" in scan


def test_results_are_of_presets_and_levels_that_exist():
    """What is renamed in the program must be renamed in the results."""
    for row in RESULTS["fits"]["rows"]:
        preset_table(row["preset"])
        assert row["capture"] in RESULTS["captures"]
    levels = {row["level"]: (row["alpha_threshold"], row["stop"]) for row in RESULTS["accuracy"]["rows"]}
    assert levels == {name: tuple(fraction(value) for value in values) for name, values in ACCURACY.items()}


def test_writing_fills_the_pages(monkeypatch, tmp_path):
    """Text around the markers stays; a second run changes nothing."""
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- results:begin steps -->\nold\n<!-- results:end -->\nafter\n")
    monkeypatch.setattr(tool, "PAGES", (page,))
    monkeypatch.setattr(tool, "ROOT", tmp_path)
    assert tool.results_table(write=True) == "page.md: written"
    lines = page.read_text().splitlines()
    assert (lines[0], lines[-1]) == ("before", "after")
    assert tool.table(RESULTS, "steps") in page.read_text()
    assert "old" not in lines
    assert tool.results_table(write=True) == "all pages are up to date"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<!-- results:begin -->\n", "1 markers results:begin and 0 results:end"),
        ("<!-- results:end -->\n<!-- results:begin -->\n", "each needs the other"),
        ("<!-- results:begin nothing -->\n<!-- results:end -->\n", "there is no table nothing"),
    ],
)
def test_markers_that_cannot_be_filled(text, words):
    """One line that says what is wrong, instead of a page that silently keeps its old table."""
    with pytest.raises(DataError, match=words):
        tool.filled(text, RESULTS, where="page.md")
