"""Time stamps of recorded motion, and frames at regular times from irregular ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mgavatar.driving.motion import MAX_FRAMES, Driving, Pivot, motion_of
from mgavatar.errors import DataError

COMMON_RATES = (24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 90.0, 120.0)

SNAP = 0.02
"""A measured rate within this part of a common one is that one: time stamps are often rounded to milliseconds."""

REGULAR = 0.25
"""Largest distance of a time stamp from its regular time, in frames, at which frames are kept as they are."""

LARGEST = 1e6
"""Largest weight, coefficient or distance that is taken for one."""

DEFAULT_ARKIT_FPS = 30.0


@dataclass(frozen=True)
class Track:
    """Recorded frames.

    Attributes:
        times: Time of each frame [s], shape [T]; None at regular times.
        values: Shape [T, N]; a row of NaN is a frame without values.
        rotations: Rotation vectors [rad] by their names, shape [T, 3] each.
        fps: Frames per second, once they are regular.
        notes: Lines for the user.
    """

    times: np.ndarray | None
    values: np.ndarray
    rotations: dict[str, np.ndarray] = field(default_factory=dict)
    fps: float = DEFAULT_ARKIT_FPS
    notes: tuple[str, ...] = ()


def at_regular_times(track: Track, *, fps: float | None, path: Path) -> Track:
    """Return frames at regular times, from the first time stamp to the last.

    Values are interpolated linearly and rotations on the sphere. Frames without values are filled from their
    neighbours. Frames whose time does not advance are left out.

    Args:
        track: Recorded frames.
        fps: Frames per second, or None if the time stamps say it.
        path: The file, for messages.

    Returns:
        Frames at regular times, without times.

    Raises:
        DataError: If there are no frames with values, if values or times are not finite, or if the time stamps are no
            times in seconds.
    """
    n_frames = len(track.values)
    found = ~np.isnan(track.values).all(axis=1) if track.values.shape[1] else np.ones(n_frames, bool)
    if not found.any():
        raise DataError(f"{path}: no frame with values" if n_frames else f"{path}: no frames")
    for rows in (track.values[found], *(rows[found] for rows in track.rotations.values())):
        if not np.isfinite(rows).all():
            raise DataError(f"{path}: frames hold NaN, infinity or empty cells; remove these frames")
        if np.abs(rows).max(initial=0.0) > LARGEST:
            raise DataError(f"{path}: frames hold numbers up to {np.abs(rows).max():.3g}, which are no motion")
    notes = [f"{path}: {n_frames - found.sum()} of {n_frames} frames have no face; they are filled from the others"]
    times, keep, rate, more = _clock(track.times, n_frames, fps=fps, path=path)
    notes = [*(notes if not found.all() else []), *more]
    places = times[keep] * rate  # in frames
    n_regular = round(float(places[-1])) + 1
    if n_regular > min(MAX_FRAMES, 4 * n_frames + 3600):
        raise DataError(
            f"{path}: {n_frames} frames span {times[keep][-1]:.6g} s at {rate:g} per second; cut the recording "
            "where it pauses"
        )
    regular = n_regular == len(places) and np.abs(places - np.arange(n_regular)).max() < REGULAR
    if not regular:
        gap = np.diff(places).max() / rate
        notes.append(
            f"{path}: {n_frames} frames at irregular times, up to {gap:.3g} s apart, are resampled to {n_regular} "
            f"at {rate:g} per second"
        )
    goal = places if regular else np.arange(n_regular, dtype=np.float64)
    known = keep & found
    values = _interpolated(times[known] * rate, track.values[known], goal)
    rotations = {name: _turned(times[known] * rate, rows[known], goal) for name, rows in track.rotations.items()}
    return Track(None, values, rotations, rate, tuple(notes))


def _clock(
    times: np.ndarray | None, n_frames: int, *, fps: float | None, path: Path
) -> tuple[np.ndarray, np.ndarray, float, list[str]]:
    """Return times from zero [s], which frames advance in time, and the rate, with lines for the user."""
    if times is None:
        rate = fps or DEFAULT_ARKIT_FPS
        assumed = f"{path}: says no frame rate, {rate:g} per second are assumed; --fps sets another"
        return np.arange(n_frames) / rate, np.ones(n_frames, bool), rate, [] if fps else [assumed]
    if not np.isfinite(times).all() or np.abs(times).max() > 1e9:
        raise DataError(f"{path}: time stamps hold NaN, infinity or numbers that are no times in seconds")
    times = times - times[0]
    latest = np.maximum.accumulate(times)
    keep = np.concatenate([[True], times[1:] > latest[:-1]])
    notes = []
    if not keep.all():
        notes.append(f"{path}: {n_frames - keep.sum()} frames are left out, because their time does not advance")
    steps = np.diff(times[keep])
    rate = fps or (_rate(float(np.median(steps))) if len(steps) else DEFAULT_ARKIT_FPS)
    if not 0.1 <= rate <= 1000.0:
        raise DataError(f"{path}: time stamps are {1.0 / rate:.3g} s apart, which is no frame rate; are they seconds?")
    return times, keep, rate, notes


def _rate(step: float) -> float:
    """Return the frame rate of a time step [s], the common one if it is close to one."""
    rate = 1.0 / step
    nearest = min(COMMON_RATES, key=lambda common: abs(rate / common - 1.0))
    return nearest if abs(rate / nearest - 1.0) < SNAP else round(rate, 3)


def _interpolated(at: np.ndarray, values: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return rows between rows; before the first and after the last there are these."""
    if len(at) == len(goal) and np.array_equal(at, goal):
        return values
    right = np.clip(np.searchsorted(at, goal), 1, max(len(at) - 1, 1))
    if len(at) == 1:
        return np.repeat(values, len(goal), axis=0)
    span = at[right] - at[right - 1]
    share = np.clip((goal - at[right - 1]) / span, 0.0, 1.0)[:, None]
    return (1.0 - share) * values[right - 1] + share * values[right]


def _turned(at: np.ndarray, vectors: np.ndarray, goal: np.ndarray) -> np.ndarray:
    if len(at) == len(goal) and np.array_equal(at, goal):
        return vectors
    if len(at) == 1:
        return np.repeat(vectors, len(goal), axis=0)
    return Slerp(at, Rotation.from_rotvec(vectors))(np.clip(goal, at[0], at[-1])).as_rotvec()


def numbered_motion(
    numbers: np.ndarray,
    rows: dict[str, np.ndarray],
    *,
    path: Path,
    fps: float,
    pivot: Pivot,
    notes: tuple[str, ...] = (),
) -> Driving:
    """Return the motion of numbered frames; frames that are missing among them are filled from their neighbours.

    Args:
        numbers: Numbers of the frames, ascending, shape [T].
        rows: Parameters by their names in ``MOTION_KEYS``, shape [T, n] each; all of them may be absent but ``expr``.
        path: The file or folder.
        fps: Frames per second.
        pivot: As in ``Driving``.
        notes: As in ``Driving``.

    Raises:
        DataError: If numbers lie so far apart that they do not count frames.
    """
    turns = {
        f"{key} {joint}": rows[key][:, 3 * joint : 3 * joint + 3]
        for key in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")
        if key in rows
        for joint in range(rows[key].shape[1] // 3)
    }
    n_expr = rows["expr"].shape[1]
    values = np.concatenate([rows["expr"], rows.get("translation", np.zeros((len(numbers), 3)))], axis=1)
    track = at_regular_times(Track(numbers / fps, values, turns), fps=fps, path=path)
    filled = {"expr": track.values[:, :n_expr], "translation": track.values[:, n_expr:]}
    for name, vectors in track.rotations.items():
        filled.setdefault(name.split()[0], np.zeros((len(vectors), 0)))
        filled[name.split()[0]] = np.concatenate([filled[name.split()[0]], vectors], axis=1)
    missing = len(track.values) - len(numbers)
    more = (f"{path}: {missing} frames are missing; they are filled from their neighbours",) if missing else ()
    plain = {key: np.ascontiguousarray(value, np.float32) for key, value in filled.items()}
    return motion_of(plain, path=path, fps=fps, pivot=pivot, notes=(*notes, *more))
