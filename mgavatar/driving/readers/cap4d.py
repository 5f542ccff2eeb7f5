"""CAP4D: ``fit.npz``, FLAME posed by its joints and then moved as a whole about the origin (``rot``, ``tra``).

Its expressions are those of FLAME 2023 without a jaw, except the last one, which CAP4D replaces by a blink of its own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.driving.motion import Driving, frame_rate, motion_of, rows_of
from mgavatar.driving.rigid import OPENGL_TO_OPENCV, rotation_vectors
from mgavatar.errors import DataError
from mgavatar.files import float_array, npz_names, read_npz

UNDERSTOOD = "CAP4D's fit.npz"

WIDTHS = {"expr": None, "rot": 3, "tra": 3, "eye_rot": 3, "jaw_rot": 3}

BASIS = "flame2023_no_jaw"

N_EXPR = 65
"""Expressions of CAP4D's own fits; the last one of them is the blink."""


def recognises(path: Path) -> bool:
    """Return True for a file with ``expr``, ``rot`` and ``tra``."""
    return {"expr", "rot", "tra"} <= npz_names(path)


def read(path: Path) -> Driving:
    """Read such a file; the errors are those of ``read_driving``."""
    content = read_npz(path, wanted=lambda key: key in (*WIDTHS, "extr", "fps"))
    given = {
        key: rows_of(content.arrays[key], where=f"{path}: {key}", width=width)
        for key, width in WIDTHS.items()
        if key in content.arrays
    }
    notes = []
    expr = given["expr"].copy()
    if expr.shape[1] == N_EXPR:
        blink = np.abs(expr[:, -1]).max()
        expr[:, -1] = 0.0
        if blink > 0.01:
            notes.append(f"{path}: not used: expression {N_EXPR - 1}, up to {blink:.2g}, CAP4D's own blink")
    if "neck_rot" in content.ignored:
        notes.append(f"{path}: not used: neck_rot, which turns the shoulders under the head")
    turns, places = Rotation.from_rotvec(given["rot"]).as_matrix(), given["tra"].astype(np.float64)
    if "extr" in content.arrays:
        turns, places = _before_camera(turns, places, content.arrays["extr"], path=path)
    rows = {
        "expr": expr,
        "rotation": rotation_vectors(turns, where=f"{path}: rot").astype(np.float32),
        "translation": places.astype(np.float32),
    }
    if "eye_rot" in given:
        rows["eyes_pose"] = np.tile(given["eye_rot"], 2)
    if "jaw_rot" in given:
        rows["jaw_pose"] = given["jaw_rot"]
    return motion_of(
        rows,
        own_keys={"rotation": "rot", "translation": "tra", "eyes_pose": "eye_rot", "jaw_pose": "jaw_rot"},
        path=path,
        fps=frame_rate(content.arrays.get("fps"), path=path),
        expr_basis=BASIS,
        pivot="origin",
        notes=tuple(notes),
    )


def _before_camera(
    turns: np.ndarray, places: np.ndarray, extrinsics: np.ndarray, *, path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Return the head's motion in the axes of the first camera, in OpenGL's convention.

    CAP4D's cameras look at a world in OpenCV's axes, into which FLAME is turned by exchanging the signs of y and z.
    """
    cameras = float_array(extrinsics, where=f"{path}: extr").astype(np.float64)
    if cameras.ndim != 3 or cameras.shape[1:] != (4, 4):
        raise DataError(f"{path}: extr has shape {extrinsics.shape}, (C, 4, 4) is needed")
    camera = cameras[0]
    rotation_vectors(camera[None, :3, :3], where=f"{path}: extr")
    flip = np.diag(OPENGL_TO_OPENCV)
    turn, place = flip @ camera[:3, :3] @ flip, flip @ camera[:3, 3]
    return turn @ turns, places @ turn.T + place
