"""Tables in text files, and the beginnings of files, read with bounds."""

from __future__ import annotations

import csv
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mgavatar.errors import DataError
from mgavatar.files import GIBIBYTE, one_line, read_bytes, read_json

MAX_COLUMNS = 1000

MAX_TABLE_BYTES = GIBIBYTE // 4


def opening(path: Path, *, n_bytes: int = 65536) -> bytes:
    """Return the first bytes of a file, or none if it cannot be read."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(n_bytes)
    except OSError:
        return b""


@dataclass(frozen=True)
class Table:
    """A table of text cells.

    Attributes:
        path: The file.
        header: Names of the columns, without blanks around them.
        rows: Cells of each row.
        decimal_comma: True if numbers have a comma, as in semicolon tables of many spreadsheets.
    """

    path: Path
    header: list[str]
    rows: list[list[str]]
    decimal_comma: bool

    def numbers(self, columns: Sequence[int]) -> np.ndarray:
        """Return columns as numbers, shape [T, n]; a row whose cells are all empty or absent is NaN.

        Raises:
            DataError: If a cell is no number; the message names row and column.
        """
        out = np.full((len(self.rows), len(columns)), np.nan)
        for index, row in enumerate(self.rows):
            cells = [row[column].strip() if column < len(row) else "" for column in columns]
            if any(cells):
                out[index] = [self._number(cell, index, column) for cell, column in zip(cells, columns, strict=True)]
        return out

    def _number(self, cell: str, index: int, column: int) -> float:
        plain = cell.replace(",", ".") if self.decimal_comma else cell
        try:
            if "_" not in plain:  # Python takes 1_000 for a number
                return float(plain)
        except ValueError:
            pass
        shown = one_line(repr(cell), limit=40)
        name = one_line(self.header[column], limit=40) or f"column {column + 1}"
        raise DataError(f"{self.path}: row {index + 2}, {name}: {shown} is not a number")


def table_header(path: Path) -> list[str]:
    """Return the names of a table's columns, or none if the file has no line of several cells."""
    start = opening(path)
    line, _, rest = start.partition(b"\n")
    if not rest or b"\0" in line:
        return []
    text = line.decode("utf-8-sig", errors="replace").strip()
    cells = [cell.strip() for cell in _cells(text, _delimiter(text))]
    return cells if 2 <= len(cells) <= MAX_COLUMNS else []


def read_table(path: Path) -> Table:
    """Read a table whose first line names its columns; cells are separated by commas, semicolons or tabs.

    Raises:
        DataError: If the file is too long, is not text, or has no rows.
    """
    data = read_bytes(path, max_bytes=MAX_TABLE_BYTES)
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is not text in UTF-8 ({one_line(error.reason)})") from error
    delimiter = _delimiter(lines[0]) if lines else ","
    try:
        rows = [row for row in csv.reader(lines, delimiter=delimiter) if any(row)]
    except csv.Error as error:
        raise DataError(f"{path}: is not a table of comma-separated values ({one_line(error)})") from error
    if len(rows) < 2:
        raise DataError(f"{path}: no rows below its first line")
    header = [cell.strip() for cell in rows[0]]
    return Table(path, header, rows[1:], decimal_comma=delimiter == ";")


def _delimiter(line: str) -> str:
    return max((",", ";", "\t"), key=line.count)


def _cells(line: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:
        return []


def json_content(path: Path) -> Any:
    """Return the value of a JSON file, or None if it is none; the last one is kept, for the readers that look in turn.

    Do not change what is returned.
    """
    start = opening(path, n_bytes=64).removeprefix(b"\xef\xbb\xbf").lstrip()
    if start[:1] not in (b"{", b"["):
        return None
    try:
        stat = path.stat()
        return _json_of(path, stat.st_mtime_ns, stat.st_size)
    except (DataError, OSError):
        return None


@functools.lru_cache(maxsize=1)
def _json_of(path: Path, mtime_ns: int, size: int) -> Any:
    return read_json(path)


def json_numbers(values: list[Any], *, where: str) -> np.ndarray:
    """Return a list of JSON numbers as float64.

    Raises:
        DataError: If one of them is something else; text and true are no numbers.
    """
    if not {*map(type, values)} <= {int, float}:
        wrong = next(value for value in values if type(value) not in (int, float))
        raise DataError(f"{where}: {one_line(repr(wrong), limit=40)} is not a number")
    try:
        return np.array(values, np.float64)
    except OverflowError as error:
        raise DataError(f"{where}: a number is too large") from error


def json_times(values: list[Any], *, where: str) -> np.ndarray | None:
    """Return time stamps as float64, or None if there are none or some of them are no numbers.

    Raises:
        DataError: If a number is too large.
    """
    if not values or not {*map(type, values)} <= {int, float}:
        return None
    return json_numbers(values, where=where)
