"""Tables in Markdown that are readable in a terminal too."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

_NARROWEST = 3
"""Dashes that GitHub wants below a heading."""


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table whose columns are padded to one width.

    Args:
        header: Title of each column.
        rows: Cells of each row, as many as there are titles. Vertical bars are escaped.

    Returns:
        Lines joined by newlines, without one at the end.

    Raises:
        ValueError: If a row has more or fewer cells than ``header``.
    """
    lines = [[cell.replace("|", r"\|") for cell in line] for line in (header, *rows)]
    for line in lines:
        if len(line) != len(header):
            raise ValueError(f"table has {len(header)} columns but a row has {len(line)} cells: {line}")
    widths = [max(_NARROWEST, *map(len, column)) for column in zip(*lines, strict=True)]
    padded = [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]
    padded.insert(1, ["-" * width for width in widths])
    return "\n".join(f"| {' | '.join(line)} |" for line in padded)
