"""Folders of ``.frame`` files: metrical-tracker, on which INSTA and others build, and Pixel3DMM.

Rotations of six numbers are the first two rows of a matrix. metrical-tracker keeps the head still and moves the camera
(``opencv``); Pixel3DMM poses FLAME by its joints and then moves it as a whole about the origin (``R``, ``t``).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.driving.motion import DEFAULT_FPS, Driving
from mgavatar.driving.rigid import of_two_rows, rotation_vectors, seen_by_camera
from mgavatar.driving.tables import opening
from mgavatar.driving.timeline import numbered_motion
from mgavatar.errors import DataError
from mgavatar.files import float_array, npz_names, one_line
from mgavatar.head.flame_pickle import read_torch_archive

UNDERSTOOD = "folders of .frame files of metrical-tracker and Pixel3DMM"

_NUMBER = re.compile(r"\d+")


def recognises(path: Path) -> bool:
    """Return True for a folder with ``.frame`` files or a ``checkpoint`` folder of them, or for one such file."""
    if path.is_dir():
        return bool(_files(path))
    return path.suffix == ".frame" and opening(path, n_bytes=4).startswith(b"PK") and _has_pickle(path)


def _has_pickle(path: Path) -> bool:
    return any(name.rpartition("/")[2] == "data.pkl" for name in npz_names(path))


def _files(path: Path) -> dict[int, Path]:
    """Return the files of a folder by the numbers in their names, in order."""
    folder = path / "checkpoint" if (path / "checkpoint").is_dir() else path
    numbers = {file: _NUMBER.findall(file.stem) for file in folder.glob("*.frame")}
    known = {int(found[-1]): file for file, found in numbers.items() if found and len(found[-1]) < 10}
    return dict(sorted(known.items()))


def read(path: Path) -> Driving:
    """Read such a folder or file; the errors are those of ``read_driving``."""
    files = _files(path) if path.is_dir() else {0: path}
    frames = [_frame(file) for file in files.values()]
    for frame, file in zip(frames, files.values(), strict=True):
        if frame.keys() != frames[0].keys() or frame["expr"].shape != frames[0]["expr"].shape:
            raise DataError(f"{file}: holds other parameters than {next(iter(files.values()))}")
    rows = {key: np.stack([frame[key] for frame in frames]) for key in frames[0]}
    eyelids = rows.pop("eyelids", None)
    notes = []
    if eyelids is not None and np.abs(eyelids).max() > 0.01:
        notes.append(f"{path}: not used: eyelids, up to {np.abs(eyelids).max():.2g}, for which FLAME has no parameter")
    return numbered_motion(np.array(list(files)), rows, path=path, fps=DEFAULT_FPS, pivot="origin", notes=tuple(notes))


def _frame(path: Path) -> dict[str, np.ndarray]:
    """Return the parameters of one file: flat, rotations as vectors."""
    content = read_torch_archive(path)
    flame = content.get("flame")
    if not isinstance(flame, dict) or "exp" not in flame:
        raise DataError(f"{path}: no flame with exp; trackers' frames have them, this has {_listed(content)}")
    out = {"expr": _floats(flame, "exp", None, path)}
    for key, name, parts in (("jaw_pose", "jaw", 1), ("neck_pose", "neck", 1), ("eyes_pose", "eyes", 2)):
        if name in flame:
            six = _floats(flame, name, 6 * parts, path).reshape(parts, 6)
            # Joints 3 and 4 of FLAME, in this order, whatever the tracker calls left and right.
            out[key] = of_two_rows(six, where=f"{path}: {name}").ravel()
    if "eyelids" in flame:
        out["eyelids"] = _floats(flame, "eyelids", 2, path)
    turn, place = _moved(content, flame, path)
    out["rotation"] = rotation_vectors(turn[None], where=f"{path}: the head's rotation")[0]
    return out | {"translation": place}


def _moved(content: dict[str, Any], flame: dict[str, Any], path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation of the head about its origin and its translation, in the axes of the camera."""
    opencv = content.get("opencv")
    if isinstance(opencv, dict):
        seen = _floats(opencv, "R", 9, path).reshape(1, 3, 3)
        turns, places = seen_by_camera(seen, _floats(opencv, "t", 3, path)[None])
        return turns[0], places[0]
    if "t" not in flame:
        return np.eye(3), np.zeros(3)
    place = _floats(flame, "t", 3, path)
    if "R_rotation_matrix" in flame:
        turn = _floats(flame, "R_rotation_matrix", 9, path).reshape(3, 3)
    else:
        turn = Rotation.from_rotvec(of_two_rows(_floats(flame, "R", 6, path)[None], where=f"{path}: R")[0]).as_matrix()
    camera = content.get("camera")
    name = next((key for key in camera if key.startswith("R_base_")), None) if isinstance(camera, dict) else None
    if name is None or not isinstance(camera, dict):
        return turn, place
    base = _floats(camera, name, 9, path).reshape(3, 3)
    return base @ turn, base @ place + _floats(camera, name.replace("R_", "t_", 1), 3, path)


def _floats(table: dict[str, Any], key: str, size: int | None, path: Path) -> np.ndarray:
    """Return an entry as flat float64."""
    value = table.get(key)
    if not isinstance(value, np.ndarray | int | float):
        raise DataError(f"{path}: no numbers {one_line(key, limit=40)}")
    array = float_array(np.asarray(value), where=f"{path}: {one_line(key, limit=40)}").reshape(-1)
    if len(array) > 10_000 or (size is not None and len(array) != size):
        raise DataError(f"{path}: {key} has {len(array)} numbers, {size if size is not None else 'fewer'} are needed")
    return array.astype(np.float64)


def _listed(content: dict[str, Any]) -> str:
    return ", ".join(one_line(key, limit=30) for key in list(content)[:8]) or "nothing"
