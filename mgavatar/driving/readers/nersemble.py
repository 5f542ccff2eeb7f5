"""Tracking of the NeRSemble benchmark, version 2: ``flame2023_tracking_v2.npz``.

FLAME is posed by its joints and then moved as a whole about the origin, with a scale. ``rotation`` holds Euler angles,
not rotation vectors; ``rotation_matrices`` is read instead.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mgavatar.driving.motion import Driving, motion_of, rows_of
from mgavatar.driving.rigid import rotation_vectors
from mgavatar.errors import DataError
from mgavatar.files import float_array, npz_names, read_npz

UNDERSTOOD = "the NeRSemble benchmark's tracking"

WIDTHS = {"expression": None, "translation": 3, "jaw": 3, "neck": 3, "eyes": 6}

OWN_KEYS = {
    "expression": "expr",
    "translation": "translation",
    "jaw": "jaw_pose",
    "neck": "neck_pose",
    "eyes": "eyes_pose",
}

BASIS = "flame2023"


def recognises(path: Path) -> bool:
    """Return True for a file with ``rotation_matrices`` and ``expression``."""
    return {"rotation_matrices", "expression"} <= npz_names(path)


def read(path: Path) -> Driving:
    """Read such a file; the errors are those of ``read_driving``."""
    arrays = read_npz(path, wanted=lambda key: key in (*WIDTHS, "rotation_matrices", "scale")).arrays
    rows = {
        OWN_KEYS[key]: rows_of(arrays[key], where=f"{path}: {key}", width=width)
        for key, width in WIDTHS.items()
        if key in arrays
    }
    matrices = float_array(arrays["rotation_matrices"], where=f"{path}: rotation_matrices").astype(np.float64)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 3):
        raise DataError(f"{path}: rotation_matrices has shape {matrices.shape}, (T, 3, 3) is needed")
    rows["rotation"] = rotation_vectors(matrices, where=f"{path}: rotation_matrices").astype(np.float32)
    scale = float_array(arrays["scale"], where=f"{path}: scale").ravel() if "scale" in arrays else np.ones(1)
    if scale.size != 1 or not 0.01 < scale[0] < 100.0:
        raise DataError(f"{path}: scale must be one positive number")
    if "translation" in rows:
        rows["translation"] = rows["translation"] / scale[0]  # in the size of the avatar's head
    own = {own: key for key, own in OWN_KEYS.items()} | {"rotation": "rotation_matrices"}
    return motion_of(rows, own_keys=own, path=path, expr_basis=BASIS, pivot="origin")
