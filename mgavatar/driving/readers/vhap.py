"""Motion in VHAP's keys: a file, a folder with one file per frame, a capture, or a UNION of captures.

GaussianAvatars' ``flame_param.npz`` has the same keys.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgavatar.driving.motion import Driving, frame_rate, motion_of, rows_of
from mgavatar.errors import DataError
from mgavatar.files import npz_names, one_line, path_inside, read_json, read_npz
from mgavatar.head.params import MOTION_KEYS, POSE_WIDTHS

UNDERSTOOD = "VHAP's and GaussianAvatars' .npz, and captures"

TEXT_KEYS = ("expr_basis", "expr_names", "fps")

SILENT_KEYS = frozenset({"shape", "static_offset", "dynamic_offset", "timestep_id", "n_processed_frames"})
"""Keys of VHAP's own files that say nothing about motion; others that are not read are mentioned."""

CANONICAL = "canonical_flame_param.npz"
"""VHAP's neutral head with an open mouth, in the folder of every capture: no motion."""

FOREIGN_KEYS = frozenset({"rotation_matrices"})
"""Keys of files that share some of VHAP's keys and give them another meaning."""


def recognises(path: Path) -> bool:
    """Return True for such a file or folder."""
    if path.is_dir():
        return bool(_frame_files(path)) or _is_capture(path)
    names = npz_names(path)
    return bool(names & set(MOTION_KEYS)) and not names & FOREIGN_KEYS


def read(path: Path) -> Driving:
    """Read motion in VHAP's keys; the errors are those of ``read_driving``."""
    if not path.is_dir():
        return read_file(path)
    files = _frame_files(path) or _named_files(path)
    if not files:
        raise DataError(
            f"{path}: a capture whose transforms files name no flame_param_path, so there is no motion "
            f"({CANONICAL} is a neutral head); give the flame_param folder of one sequence"
        )
    return concatenated([read_file(file) for file in files], path=path)


def frame_order(file: Path) -> tuple[int, str]:
    """Return the key by which files of single frames are sorted: their number, which may be unpadded."""
    return (int(file.stem) if file.stem.isdecimal() else -1, file.name)


def _frame_files(path: Path) -> list[Path]:
    """Return the files of single frames, or none if the folder's files are not in VHAP's keys."""
    folder = path / "flame_param" if (path / "flame_param").is_dir() else path
    files = sorted((file for file in folder.glob("*.npz") if file.name != CANONICAL), key=frame_order)
    return files if files and recognises(files[0]) else []


def _is_capture(path: Path) -> bool:
    return (path / CANONICAL).is_file() or any(path.glob("transforms*.json"))


def _named_files(path: Path) -> list[Path]:
    """Return the parameter files that a capture's transforms name, by timestep; those of a UNION lie beside it."""
    root = path.resolve()
    found: dict[int, Path] = {}
    for name in ("train", "val", "test"):
        transforms = root / f"transforms_{name}.json"
        if not transforms.exists():
            continue
        for frame in _frames(read_json(transforms)):
            timestep, entry = frame.get("timestep_index"), frame.get("flame_param_path")
            if entry is None or isinstance(timestep, bool) or not isinstance(timestep, int):
                continue
            if timestep not in found:
                where = f"{transforms}: timestep {timestep}: flame_param_path"
                found[timestep] = path_inside(entry, base=root, allowed=root.parent, where=where)
    return [found[timestep] for timestep in sorted(found)]


def _frames(meta: Any) -> Iterable[dict[str, Any]]:
    frames = meta.get("frames") if isinstance(meta, dict) else None
    return [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []


def read_file(path: Path) -> Driving:
    """Read one file of any number of frames.

    Raises:
        DataError: If it is damaged, or has no key of VHAP's.
    """
    content = read_npz(path, wanted=lambda key: key in (*MOTION_KEYS, *TEXT_KEYS))
    given = {key: _rows(content.arrays[key], key, path=path) for key in MOTION_KEYS if key in content.arrays}
    if not given:
        raise DataError(f"{path}: no motion in this file; it needs one of {', '.join(MOTION_KEYS)}")
    unused = sorted(set(content.ignored) - SILENT_KEYS)
    expr = given.get("expr")
    return motion_of(
        given,
        fps=frame_rate(content.arrays.get("fps"), path=path),
        expr_basis=_basis(content.arrays.get("expr_basis"), path=path),
        expr_names=_names(content.arrays.get("expr_names"), 0 if expr is None else expr.shape[1], path=path),
        path=path,
        notes=(f"{path}: not used: {', '.join(unused)}",) if unused else (),
    )


def _rows(value: np.ndarray, key: str, *, path: Path) -> np.ndarray:
    return rows_of(value, where=f"{path}: {key}", width=POSE_WIDTHS.get(key))


def _basis(value: np.ndarray | None, *, path: Path) -> str | None:
    if value is None:
        return None
    if value.size != 1 or value.dtype.kind != "U":
        raise DataError(f"{path}: expr_basis must be one word, such as flame2023")
    name = one_line(value.item(), limit=60)
    return None if name in ("", "unknown") else name


def _names(value: np.ndarray | None, n_columns: int, *, path: Path) -> tuple[str, ...]:
    if value is None:
        return ()
    if value.shape != (n_columns,) or value.dtype.kind != "U":
        raise DataError(f"{path}: expr_names has shape {value.shape}, but expr has {n_columns} columns to name")
    return tuple(one_line(name, limit=60) for name in value)


def concatenated(parts: list[Driving], *, path: Path) -> Driving:
    """Return one sequence of single frames, in their order.

    Raises:
        DataError: If a part has several frames, or parts differ in the number or the meaning of expressions.
    """
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
