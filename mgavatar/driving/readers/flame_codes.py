"""FLAME parameters of single-image trackers and generators, under their own names.

EMOCA and DECA write ``expcode`` and ``posecode``, SMIRK ``expression_params``, ``pose_params`` and ``jaw_params``,
DiffPoseTalk and flame-head-tracker ``exp`` and ``pose``. Joints are rotation vectors. These trackers have no place of
the head in space: the translation is zero.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mgavatar.driving.motion import Driving, frame_rate, motion_of, rows_of
from mgavatar.driving.readers.vhap import concatenated, frame_order
from mgavatar.errors import DataError
from mgavatar.files import npz_names, read_npz

UNDERSTOOD = "EMOCA's, DECA's, SMIRK's and DiffPoseTalk's .npz"

EXPRESSIONS = ("expcode", "exp", "expression_params", "expression", "expressions", "exp_coeff")

JOINTS = {
    "rotation": ("rotation",),
    "jaw_pose": ("jaw_pose", "jaw_params", "jaw"),
    "neck_pose": ("neck_pose", "neck_params", "neck"),
    "eyes_pose": ("eyes_pose", "eye_pose", "eye_pose_params", "eyes"),
    "translation": ("translation", "transl", "trans"),
}

POSES = ("posecode", "pose", "pose_params", "global_pose", "global_orient")

POSE_PARTS: dict[int, dict[str, slice]] = {
    3: {"rotation": slice(0, 3)},
    6: {"rotation": slice(0, 3), "jaw_pose": slice(3, 6)},
    15: {
        "rotation": slice(0, 3),
        "neck_pose": slice(3, 6),
        "jaw_pose": slice(6, 9),
        "eyes_pose": slice(9, 15),
    },
}
"""Parts of a pose of so many numbers: the root; root and jaw; all five joints."""

SILENT_KEYS = frozenset({"shapecode", "shape", "shape_params", "betas", "fps"})

KEYS = frozenset({"expr", *EXPRESSIONS, *POSES, *(name for names in JOINTS.values() for name in names), "fps"})


def recognises(path: Path) -> bool:
    """Return True for a file with an expression or a pose under one of these names, or a folder of them."""
    if path.is_dir():
        files = _frame_files(path)
        return bool(files) and recognises(files[0])
    return bool(npz_names(path) & {*EXPRESSIONS, *POSES})


def read(path: Path) -> Driving:
    """Read such a file, or a folder with one file per frame; the errors are those of ``read_driving``."""
    if path.is_dir():
        return concatenated([read(file) for file in _frame_files(path)], path=path)
    content = read_npz(path, wanted=lambda key: key in KEYS)
    rows: dict[str, np.ndarray] = {}
    own: dict[str, str] = {}

    def take(key: str, name: str, values: np.ndarray) -> None:
        if key in rows:
            raise DataError(f"{path}: {own[key]} and {name} are both FLAME's {key}; keep one of them")
        rows[key], own[key] = values, name

    for name in sorted(set(content.arrays) - {"fps"}):
        values = rows_of(content.arrays[name], where=f"{path}: {name}")
        if name == "expr" or name in EXPRESSIONS:
            take("expr", name, values)
        elif name in POSES:
            for key, columns in _pose_parts(values, where=f"{path}: {name}").items():
                take(key, name, values[:, columns])
        else:
            key = next(key for key, names in JOINTS.items() if name in names)
            take(key, name, _joint(values, key, where=f"{path}: {name}"))
    return motion_of(
        rows,
        own_keys=own,
        path=path,
        fps=frame_rate(content.arrays.get("fps"), path=path),
        notes=tuple(_notes(path, own, set(content.ignored))),
    )


def _frame_files(path: Path) -> list[Path]:
    return sorted(path.glob("*.npz"), key=frame_order)


def _pose_parts(values: np.ndarray, *, where: str) -> dict[str, slice]:
    width = values.shape[1]
    if width not in POSE_PARTS:
        raise DataError(
            f"{where} has {width} numbers per frame; 3 (root), 6 (root, jaw) or 15 (root, neck, jaw, eyes) are needed"
        )
    return POSE_PARTS[width]


def _joint(values: np.ndarray, key: str, *, where: str) -> np.ndarray:
    """Return a joint's rows; one rotation of the eyes holds for both."""
    if key == "eyes_pose" and values.shape[1] == 3:
        return np.tile(values, 2)
    width = 6 if key == "eyes_pose" else 3
    if values.shape[1] != width:
        raise DataError(f"{where} has {values.shape[1]} numbers per frame, {width} are needed")
    return values


def _notes(path: Path, own: dict[str, str], ignored: set[str]) -> list[str]:
    taken = ", ".join(f"{name} as {key}" for key, name in own.items() if name != key)
    unused = ", ".join(sorted(ignored - SILENT_KEYS))
    notes = [f"{path}: FLAME's parameters under other names: {taken}"] if taken else []
    return [*notes, *([f"{path}: not used: {unused}"] if unused else [])]
