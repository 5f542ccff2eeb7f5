"""Motion that drives an avatar: FLAME parameters of T frames, whatever file they come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mgavatar.errors import DataError
from mgavatar.files import float_array
from mgavatar.head.params import MOTION_KEYS, POSE_WIDTHS, HeadParams

DEFAULT_FPS = 25.0

MAX_FRAMES = 1_000_000

Pivot = Literal["root", "origin"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Driving(HeadParams):
    """Motion from a file, with its frame rate and the meaning of its expression columns.

    Parameters that the file lacks are zero, and expression coefficients are as many as the file has.

    Attributes:
        fps: Frames per second, 25 if the file does not say.
        expr_basis: Basis of the expression columns, if the file names it; ``"arkit"`` for ARKit's blendshapes.
        expr_names: Names of the expression columns, or an empty tuple.
        pivot: Point about which ``rotation`` turns: FLAME's root joint, or the origin of the head model's axes, as in
            trackers that pose FLAME first and then move it as a whole.
        path: The file or folder.
        notes: What was not used, assumed or mended, one line each, for the user.
    """

    fps: float = DEFAULT_FPS
    expr_basis: str | None = None
    expr_names: tuple[str, ...] = ()
    pivot: Pivot = "root"
    path: Path
    notes: tuple[str, ...] = ()


def motion_of(
    rows: Mapping[str, np.ndarray],
    *,
    path: Path,
    own_keys: Mapping[str, str] | None = None,
    fps: float = DEFAULT_FPS,
    expr_basis: str | None = None,
    expr_names: tuple[str, ...] = (),
    pivot: Pivot = "root",
    notes: tuple[str, ...] = (),
) -> Driving:
    """Put the parameters of a file together: one row holds for all frames, and missing ones are zero.

    Where lengths differ by one frame, the longer ones lose their last: trackers often write one pose more than
    expressions.

    Args:
        rows: Parameters by their names in ``MOTION_KEYS``, shape [T, n] or [1, n] each, float32.
        path: The file.
        own_keys: Names of the parameters in the file, for messages.
        fps: Frames per second.
        expr_basis: As in :class:`Driving`.
        expr_names: As in :class:`Driving`.
        pivot: As in :class:`Driving`.
        notes: As in :class:`Driving`.

    Raises:
        DataError: If lengths differ by more than one frame.
    """
    own = {key: (own_keys or {}).get(key, key) for key in MOTION_KEYS}
    lengths = {own[key]: len(value) for key, value in rows.items() if len(value) != 1}
    n_frames = min(lengths.values(), default=1)
    longest = max(lengths.values(), default=1)
    if longest - n_frames > 1:
        odd = next(name for name, n in lengths.items() if n != longest)
        first = next(name for name, n in lengths.items() if n == longest)
        raise DataError(f"{path}: {odd} has {lengths[odd]} frames but {first} has {longest}; they must be as many")
    if longest != n_frames:
        longer = ", ".join(name for name, n in lengths.items() if n == longest)
        notes = (*notes, f"{path}: the last of {longest} frames is left out, which only {longer} has")
    full = {
        key: np.repeat(value, n_frames, axis=0) if len(value) == 1 else value[:n_frames] for key, value in rows.items()
    }
    empty = {key: np.zeros((n_frames, POSE_WIDTHS.get(key, 0)), np.float32) for key in MOTION_KEYS if key not in full}
    return Driving(
        **full,
        **empty,
        fps=fps,
        expr_basis=expr_basis,
        expr_names=expr_names,
        pivot=pivot,
        path=path,
        notes=notes,
    )


def rows_of(value: np.ndarray, *, where: str, width: int | None = None) -> np.ndarray:
    """Return a parameter of all frames from the shapes that trackers write.

    Args:
        value: Shape [T, n], [n], [T, 1, n] or [1, T, n].
        where: Begins the message: the file and the key.
        width: The only n that is possible; None takes any.

    Returns:
        Shape [T, n], float32.

    Raises:
        DataError: If it has another shape, or holds something other than finite numbers.
    """
    rows = float_array(value, where=where)
    if rows.ndim == 3 and 1 in rows.shape[:2]:
        rows = rows.squeeze(1 if rows.shape[1] == 1 else 0)
    rows = rows.reshape(1, -1) if rows.ndim < 2 else rows
    if rows.ndim != 2 or (width is not None and rows.shape[1] != width) or not 1 <= len(rows) <= MAX_FRAMES:
        matrices = ": rotation vectors, no matrices" if value.shape[-2:] == (3, 3) and width == 3 else ""
        raise DataError(f"{where} has shape {value.shape}, (T, {'n' if width is None else width}) is needed{matrices}")
    return rows


def frame_rate(value: np.ndarray | float | None, *, path: Path, default: float = DEFAULT_FPS) -> float:
    """Return the frame rate that a file states.

    Args:
        value: The file's number, or None if it has none.
        path: The file.
        default: Rate of a file without one.

    Raises:
        DataError: If it is not one number of frames per second.
    """
    if value is None:
        return default
    rate = float_array(np.asarray(value), where=f"{path}: fps")
    if rate.size != 1 or not 0.0 < rate.item() <= 10_000.0:
        raise DataError(f"{path}: fps must be one positive number of frames per second")
    return float(rate.item())
