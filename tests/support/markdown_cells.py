"""Read the tables that the tools write."""

from __future__ import annotations


def cells_of(text: str) -> list[list[str]]:
    """Return the cells of all table rows in a text, headers included, without padding and separator lines."""
    lines = [line for line in text.splitlines() if line.startswith("|") and set(line) - set("|- ")]
    return [[cell.strip() for cell in line.strip().strip("|").split(" | ")] for line in lines]
