"""MediaPipe's FaceLandmarker: its results, frame by frame, as programs dump them to JSON.

There is no format of its own. A frame is a list of categories (``category_name``, ``score``), or an object that holds
one beside the time and ``facial_transformation_matrixes``; the names of the Python and of the JavaScript interface
are both read. A file is one JSON value, or one per line. The matrix takes MediaPipe's canonical face, whose axes are
FLAME's, to the axes of a camera that looks along -z, so that its rotation is that of the head against the camera.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.driving.arkit import FEWEST_NAMES, Weights, arkit_motion, arkit_name, n_arkit_names
from mgavatar.driving.motion import Driving, frame_rate
from mgavatar.driving.tables import MAX_TABLE_BYTES, json_content, json_numbers, json_times, opening
from mgavatar.errors import DataError
from mgavatar.files import one_line, read_bytes

UNDERSTOOD = "MediaPipe FaceLandmarker JSON"

NEUTRAL = "_neutral"
"""MediaPipe's first category, which is no blendshape."""

FRAMES = ("frames", "results", "data")

BLENDSHAPES = ("face_blendshapes", "faceBlendshapes", "blendshapes", "categories", "blendshape_scores")

MATRICES = (
    "facial_transformation_matrixes",
    "facialTransformationMatrixes",
    "facial_transformation_matrix",
    "transformation_matrix",
    "matrix",
)

NAMES = ("category_name", "categoryName", "name")

TIMES = {"timestamp_ms": 1e-3, "timestampMs": 1e-3, "timestamp_us": 1e-6, "time": 1.0, "time_s": 1.0, "timestamp": None}
"""Keys of a frame's time and their units [s]; a bare ``timestamp`` is one of them, by its steps."""


def recognises(path: Path) -> bool:
    """Return True for JSON in which a frame has scores of ARKit's names."""
    frames = _frames(_content(path, limit=MAX_TABLE_BYTES))
    return any(n_arkit_names(list(_scores(frame) or {})) >= FEWEST_NAMES for frame in frames)


def read(path: Path) -> Driving:
    """Read such a file; the errors are those of ``read_driving``."""
    content = _content(path, limit=MAX_TABLE_BYTES)
    frames = _frames(content)
    scores = [_scores(frame) or {} for frame in frames]
    names = sorted({name for frame in scores for name in frame if name != NEUTRAL})
    values = np.full((len(frames), len(names)), np.nan)
    for index, frame in enumerate(scores):
        if frame:
            given = [frame.get(name, 0.0) for name in names]
            values[index] = json_numbers(given, where=f"{path}: frame {index}: scores")
    rate = content.get("fps") if isinstance(content, dict) else None
    weights = Weights(
        names,
        values,
        times=_times(frames, path=path),
        fps=None if rate is None else frame_rate(json_numbers([rate], where=f"{path}: fps"), path=path),
        head=_head(frames, ~np.isnan(values).all(axis=1), path=path),
    )
    return arkit_motion(weights, path=path)


def _content(path: Path, *, limit: int) -> Any:
    """Return the JSON value, or the list of the values of all lines; None if the file is neither."""
    content = json_content(path)
    start = opening(path, n_bytes=64).lstrip()
    if content is not None or start[:1] not in (b"{", b"["):
        return content
    try:
        lines = read_bytes(path, max_bytes=limit).splitlines()
        return [json.loads(line) for line in lines if line.strip()]
    except (ValueError, RecursionError, DataError):
        return None


def _frames(content: Any) -> list[Any]:
    """Return the list of frames, or none if there is nothing like one."""
    if isinstance(content, dict):
        for key in FRAMES:
            if isinstance(content.get(key), list):
                return content[key]
        return [content] if any(key in content for key in BLENDSHAPES) else []
    if not isinstance(content, list):
        return []
    return [content] if _categories(content) else content  # the result of a single image


def _scores(value: Any) -> dict[str, Any] | None:
    """Return the scores by name of the first face in a frame, or None if it has none."""
    for _ in range(5):  # results hold lists of faces, which hold categories, in more than one way
        if isinstance(value, dict):
            inner = next((value[key] for key in BLENDSHAPES if key in value), None)
            if inner is None:
                return {name: score for name, score in value.items() if arkit_name(name) is not None} or None
            value = inner
        elif isinstance(value, list) and value:
            named = _categories(value)
            if named:
                return named
            value = value[0]
        else:
            return None
    return None


def _categories(value: list[Any]) -> dict[str, Any]:
    """Return the scores of a list of categories by their names; none if it is something else."""
    first = value[0] if value and isinstance(value[0], dict) else {}
    key = next((key for key in NAMES if isinstance(first.get(key), str)), None)
    if key is None or "score" not in first:
        return {}
    return {
        entry[key]: entry["score"]
        for entry in value
        if isinstance(entry, dict) and isinstance(entry.get(key), str) and "score" in entry
    }


def _times(frames: list[Any], *, path: Path) -> np.ndarray | None:
    """Return the time of each frame [s], or None if not all frames have one."""
    for key, unit in TIMES.items():
        given = [frame.get(key) if isinstance(frame, dict) else None for frame in frames]
        times = json_times(given, where=f"{path}: {key}")
        if times is not None:
            return times * (unit or _unit(times))
    return None


def _unit(times: np.ndarray) -> float:
    """Return the unit of bare time stamps [s]: steps of a video are 0.008 to 0.2 s, so units lie far apart."""
    step = float(np.median(np.abs(np.diff(times)))) if len(times) > 1 else 0.0
    return 1.0 if step < 1.0 else 1e-3 if step < 1000.0 else 1e-6


def _head(frames: list[Any], found: np.ndarray, *, path: Path) -> np.ndarray | None:
    """Return rotation vectors of the head [rad], shape [T, 3], or None if no frame has a matrix."""
    given = [_matrix_entry(frame) for frame in frames]
    if not any(entry is not None for entry in given):
        return None
    known = np.flatnonzero(found)
    where = [f"{path}: frame {index}: facial transformation matrix" for index in known]
    numbers = [_sixteen(given[index], where=place) for index, place in zip(known, where, strict=True)]
    matrices = np.array(numbers, np.float64).reshape(-1, 4, 4)
    # The place of the head belongs into the last column: matrices that have it in the last row are column after column.
    flipped = (np.abs(matrices[:, :3, 3]) < 1e-8).all(axis=1) & (np.abs(matrices[:, 3, :3]) > 1e-8).any(axis=1)
    matrices[flipped] = matrices[flipped].transpose(0, 2, 1)
    turns = matrices[:, :3, :3]
    bounded = np.isfinite(matrices).all(axis=(1, 2)) & (np.abs(turns).max(axis=(1, 2)) < 1e3)
    turns = np.where(bounded[:, None, None], turns, 0.0)
    wrong = np.linalg.det(turns) < 1e-6
    if wrong.any():
        raise DataError(f"{where[int(np.argmax(wrong))]} is no rotation and translation")
    out = np.full((len(frames), 3), np.nan)
    out[known] = Rotation.from_matrix(turns).as_rotvec()
    return out


def _matrix_entry(frame: Any) -> Any:
    if not isinstance(frame, dict):
        return None
    entry = next((frame[key] for key in MATRICES if frame.get(key) is not None), None)
    return None if isinstance(entry, list) and not entry else entry


def _sixteen(entry: Any, *, where: str) -> np.ndarray:
    """Return the numbers of a 4x4 matrix from its rows, from a list of matrices, or from JavaScript's ``data``."""
    if isinstance(entry, list) and len(entry) == 1:
        entry = entry[0]
    numbers = entry.get("data") if isinstance(entry, dict) else entry
    if isinstance(numbers, list) and len(numbers) == 4 and all(isinstance(row, list) for row in numbers):
        numbers = [number for row in numbers for number in row]
    if not isinstance(numbers, list) or len(numbers) != 16:
        raise DataError(f"{where} is {one_line(repr(entry), limit=40)}, 4x4 numbers are needed")
    return json_numbers(numbers, where=where)
