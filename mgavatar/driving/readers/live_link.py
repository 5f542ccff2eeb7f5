"""Live Link Face: the CSV files of Epic's app for ARKit's face tracking on a phone.

Blendshapes have ARKit's names in PascalCase, in any order. Angles of head and eyes are yaw, pitch and roll in ARKit's
axes, which are FLAME's (x to the subject's left, y up, z forward): yaw turns to the subject's left, pitch looks down,
roll leans to the subject's right shoulder.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.driving.arkit import FEWEST_NAMES, Weights, arkit_motion, arkit_name, n_arkit_names
from mgavatar.driving.motion import Driving
from mgavatar.driving.tables import Table, opening, read_table, table_header
from mgavatar.errors import DataError
from mgavatar.files import one_line

UNDERSTOOD = "Live Link Face CSV"

TIMECODE = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})[:;](\d{1,3}(?:\.\d+)?)")
"""Hours, minutes, seconds, and frames with their fraction."""

TIMECODE_RATES = (24, 25, 30, 60, 120)

DEFAULT_RATE = 60
"""Rate of the app unless the user sets another; used where a short recording does not show it."""

LARGEST_RADIANS = 1.75
"""Angles above this are degrees: no tracked head turns by 100 degrees."""

DAY = 86400.0

ANGLES = ("yaw", "pitch", "roll")


def recognises(path: Path) -> bool:
    """Return True for a table with ARKit's names and a column of time codes."""
    header = table_header(path)
    if n_arkit_names(header) < FEWEST_NAMES or "timecode" not in (cell.lower() for cell in header):
        return False
    first = opening(path).split(b"\n", 2)[1].decode("utf-8", errors="replace")
    return "blendshapecount" in (cell.lower() for cell in header) or ":" in first


def read(path: Path) -> Driving:
    """Read such a file; the errors are those of ``read_driving``."""
    table = read_table(path)
    columns = [index for index, name in enumerate(table.header) if arkit_name(name) is not None]
    values = table.numbers(columns)
    values[_lost(table)] = np.nan
    times, notes = _times(table)
    angles, more = _rotations(table)
    weights = Weights(
        [table.header[column] for column in columns],
        values,
        times,
        head=angles.get("head"),
        eyes=np.hstack([angles["lefteye"], angles["righteye"]]) if "lefteye" in angles else None,
        notes=(*notes, *more),
    )
    return arkit_motion(weights, path=path)


def _column(table: Table, name: str) -> int | None:
    return next((index for index, cell in enumerate(table.header) if cell.lower().replace("_", "") == name), None)


def _lost(table: Table) -> np.ndarray:
    """Return which rows say that they have no blendshapes, as the app writes where it lost the face."""
    column = _column(table, "blendshapecount")
    return np.array([column is not None and row[column : column + 1] == ["0"] for row in table.rows])


def _times(table: Table) -> tuple[np.ndarray, list[str]]:
    """Return the time of each row [s], which goes on across midnight, and lines for the user."""
    column = next(index for index, name in enumerate(table.header) if name.lower() == "timecode")
    parts = np.zeros((len(table.rows), 4))
    for index, row in enumerate(table.rows):
        cell = row[column].strip() if column < len(row) else ""
        found = TIMECODE.fullmatch(cell)
        if found is None:
            shown = one_line(repr(cell), limit=40)
            raise DataError(f"{table.path}: row {index + 2}, Timecode: {shown} is not a time code HH:MM:SS:FF.sub")
        parts[index] = [float(part) for part in found.groups()]
    rate, note = _timecode_rate(parts[:, 3], path=table.path)
    times = parts[:, :3] @ [3600.0, 60.0, 1.0] + parts[:, 3] / rate
    # A step back of more than half a day is midnight.
    times[1:] += DAY * np.cumsum(np.diff(times) < -DAY / 2)
    return times, note


def _timecode_rate(frames: np.ndarray, *, path: Path) -> tuple[int, list[str]]:
    """Return the rate at which the frames of the time codes count: they start again at every second."""
    whole = np.floor(frames)
    starts_again = bool(np.any(np.diff(whole) < 0))
    largest = int(whole.max())
    if largest >= TIMECODE_RATES[-1]:
        raise DataError(f"{path}: time codes count {largest} frames in a second, at most 119 are possible")
    if starts_again or largest >= 30:
        return next(rate for rate in TIMECODE_RATES if rate > largest), []
    note = f"{path}: shorter than a second, so its time codes do not show their rate; {DEFAULT_RATE} is assumed"
    return DEFAULT_RATE, [note] if len(frames) > 1 else []


def _rotations(table: Table) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return rotation vectors [rad] of head and eyes where the table has their angles, and the unit assumed."""
    found = {}
    for part in ("head", "lefteye", "righteye"):
        columns = [_column(table, part + angle) for angle in ANGLES]
        given = [column for column in columns if column is not None]
        if len(given) == len(ANGLES):
            found[part] = table.numbers(given)
    if ("lefteye" in found) != ("righteye" in found):  # one eye alone is no gaze
        found = {part: angles for part, angles in found.items() if part == "head"}
    largest = max((float(np.nanmax(np.abs(angles), initial=0.0)) for angles in found.values()), default=0.0)
    if largest == 0.0:
        return {}, []
    degrees = largest > LARGEST_RADIANS
    unit = "degrees" if degrees else "radians"
    # Yaw first, then pitch and roll in the turned axes. Rows without values stay NaN.
    rotations = {}
    for part, angles in found.items():
        rotations[part] = np.full_like(angles, np.nan)
        known = np.isfinite(angles).all(axis=1)
        if known.any():
            rotations[part][known] = Rotation.from_euler("YXZ", angles[known], degrees=degrees).as_rotvec()
    return rotations, [f"{table.path}: angles of head and eyes reach {largest:.3g}; they are taken as {unit}"]
