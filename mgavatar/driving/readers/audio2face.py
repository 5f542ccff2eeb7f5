"""Audio2Face-3D: blendshapes from sound, as CSV with times in seconds or as JSON of Omniverse.

Any other table with a column per blendshape of ARKit is read as well; without times it has 30 frames per second.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mgavatar.driving.arkit import FEWEST_NAMES, Weights, arkit_motion, arkit_name, n_arkit_names
from mgavatar.driving.motion import Driving, frame_rate
from mgavatar.driving.tables import json_content, json_numbers, read_table, table_header
from mgavatar.errors import DataError

UNDERSTOOD = "Audio2Face-3D CSV and JSON"

TIME_COLUMNS = ("timecode", "time", "timestamp", "time_code", "seconds")

INDEX_COLUMNS = ("", "frame", "index", "frame_index")


def recognises(path: Path) -> bool:
    """Return True for a table with ARKit's names, or an object with ``facsNames`` and ``weightMat``."""
    if n_arkit_names(table_header(path)) >= FEWEST_NAMES:
        return True
    content = json_content(path)
    return isinstance(content, dict) and n_arkit_names(_facs_names(content)) >= FEWEST_NAMES and "weightMat" in content


def read(path: Path) -> Driving:
    """Read such a file; the errors are those of ``read_driving``."""
    content = json_content(path)
    weights = _of_table(path) if content is None else _of_json(content, path=path)
    return arkit_motion(weights, path=path)


def _facs_names(content: dict[str, Any]) -> list[str]:
    names = content.get("facsNames")
    return names if isinstance(names, list) and all(isinstance(name, str) for name in names) else []


def _of_table(path: Path) -> Weights:
    table = read_table(path)
    known = [index for index, name in enumerate(table.header) if arkit_name(name) is not None]
    time = next((index for index, name in enumerate(table.header) if name.lower() in TIME_COLUMNS), None)
    left = [
        name
        for index, name in enumerate(table.header)
        if index not in (*known, time) and name.lower() not in INDEX_COLUMNS
    ]
    return Weights(
        [table.header[column] for column in known],
        table.numbers(known),
        times=None if time is None else table.numbers([time])[:, 0],
        notes=(f"{path}: not used: {', '.join(left[:5])}{', …' if len(left) > 5 else ''}",) if left else (),
    )


def _of_json(content: dict[str, Any], *, path: Path) -> Weights:
    names, matrix = _facs_names(content), content["weightMat"]
    if not isinstance(matrix, list) or not all(isinstance(row, list) and len(row) == len(names) for row in matrix):
        raise DataError(f"{path}: weightMat must be a list of rows of {len(names)} numbers, one per facsNames")
    values = [json_numbers(row, where=f"{path}: weightMat, row {index}") for index, row in enumerate(matrix)]
    rate = content.get("exportFps")
    return Weights(
        names,
        np.array(values, np.float64).reshape(len(values), len(names)),
        fps=None if rate is None else frame_rate(json_numbers([rate], where=f"{path}: exportFps"), path=path),
    )
