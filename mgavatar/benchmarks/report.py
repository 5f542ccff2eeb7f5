"""JSON files of what a benchmark measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mgavatar.errors import DataError
from mgavatar.files import atomic_write


def check_report_path(path: Path | None) -> None:
    """Refuse a path that ``write_report`` could not write to, before minutes of measurement.

    Raises:
        DataError: If ``path`` is a folder, or lies in none.
    """
    if path is None:
        return
    if path.is_dir():
        raise DataError(f"{path}: is a folder; give the path of a .json file")
    if not path.parent.is_dir():
        raise DataError(f"{path}: its folder does not exist; make it, or give another path")


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write ``report`` as indented JSON; atomic.

    Raises:
        DataError: If the file cannot be written.
    """
    with atomic_write(path) as file:
        file.write((json.dumps(report, indent=2) + "\n").encode())
