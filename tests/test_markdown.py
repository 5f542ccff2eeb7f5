"""The one writer of Markdown tables."""

from __future__ import annotations

import pytest

from mgavatar.reporting.markdown import markdown_table


def test_columns_are_padded_to_one_width():
    """A table known by hand."""
    assert markdown_table(["a", "kernel"], [["skinning", "1"], ["", "2.5"]]) == (
        "| a        | kernel |\n"
        "| -------- | ------ |\n"
        "| skinning | 1      |\n"
        "|          | 2.5    |"
    )  # fmt: skip


def test_a_table_without_rows_is_its_header():
    """Narrow columns get the three dashes that GitHub needs."""
    assert markdown_table(["a"], []) == "| a   |\n| --- |"


def test_a_bar_in_a_cell_does_not_open_a_column():
    """Its line has as many unescaped bars as the others."""
    first, _, row = markdown_table(["a", "b"], [["x|y", "z"]]).splitlines()
    assert r"x\|y" in row
    assert row.count("|") - row.count(r"\|") == first.count("|")


def test_a_ragged_row_is_refused():
    """The message names the row."""
    with pytest.raises(ValueError, match=r"2 columns but a row has 1 cells: \['only'\]"):
        markdown_table(["a", "b"], [["only"]])
