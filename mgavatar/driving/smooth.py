"""Smoothing of jittery motion, without delay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from mgavatar.driving.motion import Driving
from mgavatar.head.params import POSE_WIDTHS

WINDOW = 0.3
"""Length of the window in which a cubic is fitted [s]: lids and lips keep their speed, what is faster goes."""

FEWEST_FRAMES = 5

JOINTS = ("rotation", "neck_pose", "jaw_pose", "eyes_pose")


def smoothed(driving: Driving) -> tuple[Driving, str]:
    """Return motion whose jitter is removed, and a line that says how much it was.

    A cubic is fitted around each frame (Savitzky-Golay), which has no delay and keeps peaks. Rotations are smoothed as
    quaternions on the unit sphere.

    Args:
        driving: The motion.
    """
    n_frames = len(driving)
    half = max(round(0.5 * WINDOW * driving.fps), 2)
    window = min(2 * half + 1, n_frames - 1 + n_frames % 2)  # odd, and no longer than the sequence
    if window < FEWEST_FRAMES:
        return driving, f"{driving.path}: {n_frames} frames are too few to smooth"
    rows = {key: _filtered(getattr(driving, key), window) for key in ("expr", "translation")}
    for key in JOINTS:
        vectors = getattr(driving, key)
        joints = [_on_the_sphere(vectors[:, k : k + 3], window) for k in range(0, POSE_WIDTHS[key], 3)]
        rows[key] = np.concatenate(joints, axis=1)
    smooth = replace(driving, **{key: value.astype(np.float32) for key, value in rows.items()})  # type: ignore[arg-type]
    return smooth, _report(driving, smooth)


def _filtered(values: np.ndarray, window: int) -> np.ndarray:
    if not values.size:
        return values
    return savgol_filter(values.astype(np.float64), window, polyorder=3, axis=0, mode="interp")


def _on_the_sphere(vectors: np.ndarray, window: int) -> np.ndarray:
    """Return smoothed rotation vectors, shape [T, 3]; where nothing turns they stay as they are."""
    if not vectors.any():
        return vectors
    quaternions = Rotation.from_rotvec(vectors).as_quat()
    # q and -q are the same rotation: each is taken on the side of the one before it.
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(signs)[:, None]
    return Rotation.from_quat(_filtered(quaternions, window)).as_rotvec()


def _report(before: Driving, after: Driving) -> str:
    """Return a line with the jitter that went away, the root mean square of the differences."""
    turns = []
    for key in JOINTS:
        for k in range(0, POSE_WIDTHS[key], 3):
            old, new = (Rotation.from_rotvec(getattr(motion, key)[:, k : k + 3]) for motion in (before, after))
            turns.append((old.inv() * new).magnitude())
    degrees = np.degrees(_rms(np.sum(np.square(turns), axis=0)))
    millimetres = 1e3 * _rms(np.sum((before.translation - after.translation) ** 2, axis=1))
    size = float(np.abs(before.expr).max(initial=0.0))
    share = _rms(np.mean((before.expr - after.expr) ** 2, axis=1)) / size if size else 0.0
    return (
        f"{before.path}: smoothed: {degrees:.2g} degrees, {millimetres:.2g} mm and {share:.2%} of the largest "
        "expression of jitter are removed"
    )


def _rms(squares: np.ndarray) -> float:
    return float(np.sqrt(np.mean(squares)))
