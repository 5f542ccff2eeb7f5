"""Folders of flame-head-tracker: one ``{i}.npz`` per frame, unpadded, without the frames in which it found no face.

Each file has megabytes of pictures; only the parameters are read. The head stands still and the camera moves: ``cam``
is camera to world in OpenGL's axes, three Euler angles (R = Rz(c2) Ry(c0) Rx(c1)) and the camera's place.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.driving.motion import DEFAULT_FPS, Driving, rows_of
from mgavatar.driving.timeline import numbered_motion
from mgavatar.errors import DataError
from mgavatar.files import npz_names, read_npz

UNDERSTOOD = "folders of flame-head-tracker"

WIDTHS = {"exp": None, "jaw_pose": 3, "neck_pose": 3, "eye_pose": 6, "cam": 6}

OWN_KEYS = {"exp": "expr", "jaw_pose": "jaw_pose", "neck_pose": "neck_pose", "eye_pose": "eyes_pose"}

MAX_BYTES = 64 << 20


def recognises(path: Path) -> bool:
    """Return True for a folder of numbered files with ``exp`` and ``cam``, or for one such file."""
    files = list(_files(path).values())
    return bool(files) and {"exp", "cam"} <= npz_names(files[0])


def _files(path: Path) -> dict[int, Path]:
    if not path.is_dir():
        return {0: path}
    numbered = {int(file.stem): file for file in path.glob("*.npz") if file.stem.isdecimal() and len(file.stem) < 10}
    return dict(sorted(numbered.items()))


def read(path: Path) -> Driving:
    """Read such a folder or file; the errors are those of ``read_driving``."""
    files = _files(path)
    frames = [_frame(file) for file in files.values()]
    first = next(iter(files.values()))
    for frame, file in zip(frames, files.values(), strict=True):
        if frame.keys() != frames[0].keys() or frame["exp"].shape != frames[0]["exp"].shape:
            raise DataError(f"{file}: holds other parameters than {first}")
    stacked = {key: np.stack([frame[key] for frame in frames]).astype(np.float64) for key in frames[0]}
    rows = {own: stacked[key] for key, own in OWN_KEYS.items() if key in stacked}
    cam = stacked["cam"]
    # The head's axes in the camera's are the inverse of the camera in the world.
    camera = Rotation.from_euler("xyz", cam[:, [1, 0, 2]])
    rows["rotation"] = camera.inv().as_rotvec()
    rows["translation"] = -camera.inv().apply(cam[:, 3:])
    return numbered_motion(np.array(list(files)), rows, path=path, fps=DEFAULT_FPS, pivot="origin")


def _frame(path: Path) -> dict[str, np.ndarray]:
    arrays = read_npz(path, wanted=lambda key: key in WIDTHS, max_bytes=MAX_BYTES).arrays
    frame = {}
    for key, value in arrays.items():
        rows = rows_of(value, where=f"{path}: {key}", width=WIDTHS[key])
        if len(rows) != 1:
            raise DataError(f"{path}: {key} has {len(rows)} frames; in a folder each file is one frame")
        frame[key] = rows[0]
    if "exp" not in frame or "cam" not in frame:
        raise DataError(f"{path}: no exp or no cam; flame-head-tracker's frames have both")
    return frame
