"""Motion that drives an avatar: FLAME parameters of T frames, from one file or from a folder with one per frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mgavatar.errors import DataError
from mgavatar.files import float_array, one_line, read_npz
from mgavatar.head.params import MOTION_KEYS, POSE_WIDTHS, HeadParams

TEXT_KEYS = ("expr_basis", "expr_names", "fps")

SILENT_KEYS = frozenset({"shape", "static_offset", "dynamic_offset", "timestep_id", "n_processed_frames"})
"""Keys of VHAP's own files that say nothing about motion; others that are not read are mentioned."""

DEFAULT_FPS = 25.0

MAX_FRAMES = 1_000_000


@dataclass(frozen=True, eq=False, kw_only=True)
class Driving(HeadParams):
    """Motion from a file, with its frame rate and the meaning of its expression columns.

    Parameters that the file lacks are zero, and expression coefficients are as many as the file has.

    Attributes:
        fps: Frames per second, 25 if the file does not say.
        expr_basis: Basis of the expression columns, if the file names it.
        expr_names: Names of the expression columns, or an empty tuple.
        path: The file or folder.
        notes: Arrays that were not used, one line each, for the user.
    """

    fps: float = DEFAULT_FPS
    expr_basis: str | None = None
    expr_names: tuple[str, ...] = ()
    path: Path
    notes: tuple[str, ...] = ()


def read_driving(path: Path | str) -> Driving:
    """Read a driving sequence in VHAP's keys.

    Missing keys are zero and identity is not read. An array of one row holds for all frames. A folder is read as one
    frame a file, in the order of their numbers; a capture's folder as its ``flame_param``.

    Args:
        path: A ``.npz`` file, or a folder of them.

    Returns:
        The motion.

    Raises:
        DataError: If there is no motion in it, or arrays are damaged, not finite, or of different lengths.
    """
    path = Path(path)
    if not path.is_dir():
        return _read_file(path)
    folder = path / "flame_param" if (path / "flame_param").is_dir() else path
    files = sorted(folder.glob("*.npz"), key=_frame_order)
    if not files:
        raise DataError(f"{path}: no .npz files in this folder; one file, or one per frame as in VHAP's flame_param/")
    return _concatenated([_read_file(file) for file in files], path=path)


def _frame_order(file: Path) -> tuple[int, str]:
    return (int(file.stem) if file.stem.isdecimal() else -1, file.name)


def _read_file(path: Path) -> Driving:
    if path.suffix.lower() != ".npz":
        raise DataError(f"{path}: {'not a .npz file' if path.exists() else 'no such file'}; driving files are .npz")
    content = read_npz(path, wanted=lambda key: key in (*MOTION_KEYS, *TEXT_KEYS))
    given = {key: _rows(content.arrays[key], key, path=path) for key in MOTION_KEYS if key in content.arrays}
    if not given:
        raise DataError(f"{path}: no motion in this file; it needs one of {', '.join(MOTION_KEYS)}")
    n_frames = max(len(rows) for rows in given.values())
    longest = next(key for key, rows in given.items() if len(rows) == n_frames)
    for key, rows in given.items():
        if len(rows) not in (1, n_frames):
            raise DataError(f"{path}: {key} has {len(rows)} frames but {longest} has {n_frames}; they must be as many")
    full = {key: np.repeat(rows, n_frames, axis=0) if len(rows) == 1 else rows for key, rows in given.items()}
    empty = {key: np.zeros((n_frames, POSE_WIDTHS.get(key, 0)), np.float32) for key in MOTION_KEYS if key not in full}
    unused = sorted(set(content.ignored) - SILENT_KEYS)
    return Driving(
        **full,
        **empty,
        fps=_fps(content.arrays.get("fps"), path=path),
        expr_basis=_basis(content.arrays.get("expr_basis"), path=path),
        expr_names=_names(content.arrays.get("expr_names"), full.get("expr"), path=path),
        path=path,
        notes=(f"{path}: not used: {', '.join(unused)}",) if unused else (),
    )


def _rows(value: np.ndarray, key: str, *, path: Path) -> np.ndarray:
    """Return a parameter of all frames as float32 [T, n], from that shape, (n,), (T, 1, n) or (1, T, n)."""
    rows = float_array(value, where=f"{path}: {key}")
    if rows.ndim == 3 and 1 in rows.shape[:2]:
        rows = rows.squeeze(1 if rows.shape[1] == 1 else 0)
    rows = rows.reshape(1, -1) if rows.ndim < 2 else rows
    width = POSE_WIDTHS.get(key, rows.shape[-1])
    if rows.ndim != 2 or rows.shape[1] != width or not 1 <= len(rows) <= MAX_FRAMES:
        needed = f"(T, {width})" if key in POSE_WIDTHS else "(T, n)"
        kind = " rotation vectors" if key.endswith("_pose") or key == "rotation" else ""
        raise DataError(f"{path}: {key} has shape {value.shape}, {needed}{kind} is needed")
    return rows


def _fps(value: np.ndarray | None, *, path: Path) -> float:
    if value is None:
        return DEFAULT_FPS
    rate = float_array(value, where=f"{path}: fps")
    if rate.size != 1 or not 0.0 < rate.item() <= 10_000.0:
        raise DataError(f"{path}: fps must be one positive number of frames per second")
    return float(rate.item())


def _basis(value: np.ndarray | None, *, path: Path) -> str | None:
    if value is None:
        return None
    if value.size != 1 or value.dtype.kind != "U":
        raise DataError(f"{path}: expr_basis must be one word, such as flame2023")
    name = one_line(value.item(), limit=60)
    return None if name in ("", "unknown") else name


def _names(value: np.ndarray | None, expr: np.ndarray | None, *, path: Path) -> tuple[str, ...]:
    if value is None:
        return ()
    n_columns = 0 if expr is None else expr.shape[1]
    if value.shape != (n_columns,) or value.dtype.kind != "U":
        raise DataError(f"{path}: expr_names has shape {value.shape}, but expr has {n_columns} columns to name")
    return tuple(one_line(name, limit=60) for name in value)


def _concatenated(parts: list[Driving], *, path: Path) -> Driving:
    """One sequence of single frames."""
    first = parts[0]
    for part in parts:
        if len(part) != 1:
            raise DataError(f"{part.path}: has {len(part)} frames; in a folder each file is one frame")
        if part.expr.shape != first.expr.shape:
            raise DataError(
                f"{part.path}: expr has {part.expr.shape[1]} coefficients, but {first.path} has {first.expr.shape[1]}; "
                "all frames need the same"
            )
        if (part.expr_basis, part.expr_names) != (first.expr_basis, first.expr_names):
            raise DataError(f"{part.path}: expr_basis or expr_names differ from those of {first.path}")
    rows = {key: np.concatenate([getattr(part, key) for part in parts]) for key in MOTION_KEYS}
    return replace(first, path=path, **rows)  # type: ignore[arg-type]
