"""Captures in the layout of VHAP and GaussianAvatars, the native one, also as UNION of sequences beside it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mgavatar.camera import Camera
from mgavatar.capture.subject import BACKGROUNDS, SPLITS, Frame, Split, Subject
from mgavatar.capture.transforms import FrameReader, camera_of_frame
from mgavatar.config import Background, PrincipalPoint
from mgavatar.errors import DataError
from mgavatar.files import float_array, one_line, read_json, read_npz
from mgavatar.head.params import POSE_WIDTHS, HeadParams

PARAM_WIDTHS: dict[str, int | None] = {"expr": None, **POSE_WIDTHS}

MAX_PARAM_BYTES = 64 << 20

MARK = "transforms_train.json"

log = logging.getLogger("mgavatar")


def recognises(root: Path) -> bool:
    """Return True if a folder has the transforms file of a training split."""
    return (root / MARK).exists()


def read(root: Path, *, background: Background, principal_point: PrincipalPoint) -> Subject:
    """Read a capture in this layout; arguments, result and errors are those of ``read_capture``."""
    entries = {split: list(_split_entries(root, split, principal_point)) for split in SPLITS}
    _check_duplicates(entries, root)
    params_of = _params_of_timesteps(entries, root)
    timesteps = sorted(params_of)
    row_of = {timestep: row for row, timestep in enumerate(timesteps)}
    return Subject(
        root=root,
        frames={split: tuple(entry.frame(row_of) for entry in entries[split]) for split in SPLITS},
        params=_read_params([params_of[timestep] for timestep in timesteps]),
        timestep_ids=tuple(timesteps),
        background=np.array(BACKGROUNDS[background], np.float32),
        ground_truth=next(iter(sorted((root / "ground_truth").glob("*.npz"))), None),
    )


@dataclass(frozen=True)
class _Entry:
    """A frame as its JSON file states it, with its paths found."""

    split: Split
    label: str
    image_path: Path
    mask_path: Path | None
    params_path: Path
    camera: Camera
    camera_id: int
    timestep_id: int

    def frame(self, row_of: dict[int, int]) -> Frame:
        return Frame(self.image_path, self.mask_path, self.camera, self.camera_id, row_of[self.timestep_id])


def _split_entries(root: Path, split: Split, principal_point: PrincipalPoint) -> Iterator[_Entry]:
    path = root / f"transforms_{split}.json"
    if split != "train" and not path.exists():
        return
    meta = read_json(path)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or (split == "train" and not frames):
        raise DataError(f"{path}: no list of frames; it must be {{'frames': [...]}} as VHAP writes it")
    off_centre = 0
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise DataError(f"{path}: frame {index} is no object")
        reader = FrameReader(path, meta, frame, one_line(frame.get("file_path") or index, limit=80))
        off_centre += _is_off_centre(reader)
        yield _entry(reader, split=split, principal_point=principal_point)
    if off_centre and principal_point == "center":
        log.warning(
            "%s: the principal point of %d frames is more than 1 %% off the image centre; it is put into the centre, "
            "as GaussianAvatars does; --principal-point opencv or opengl takes it from the file",
            path,
            off_centre,
        )


def _entry(reader: FrameReader, *, split: Split, principal_point: PrincipalPoint) -> _Entry:
    if "file_path" not in reader.values:
        raise DataError(f"{reader.where} has no file_path")
    if reader.values.get("flame_param_path") is None:
        raise DataError(f"{reader.where} has no flame_param_path; export the capture with its tracked parameters")
    return _Entry(
        split=split,
        label=reader.label,
        image_path=reader.file("file_path"),
        mask_path=reader.file("fg_mask_path") if reader.values.get("fg_mask_path") else None,
        params_path=reader.file("flame_param_path"),
        camera=camera_of_frame(reader, principal_point),
        camera_id=reader.whole("camera_index", low=0) if "camera_index" in reader.values else 0,
        timestep_id=reader.whole("timestep_index", low=0),
    )


def _is_off_centre(reader: FrameReader) -> bool:
    if not all(reader.has(key) for key in ("cx", "cy", "w", "h")):
        return False
    cx, cy, width, height = (reader.number(key) for key in ("cx", "cy", "w", "h"))
    return max(abs(cx - width / 2), abs(cy - height / 2)) > 0.01 * width


def _check_duplicates(entries: dict[Split, list[_Entry]], root: Path) -> None:
    """Refuse a split that has an image twice.

    Splits may share images: INSTA's exports have the last frames of ``test`` as ``val``, and images of ``train`` are
    left out where the others are scored.
    """
    for split, own in entries.items():
        seen: dict[tuple[int, int], _Entry] = {}
        for entry in own:
            first = seen.setdefault((entry.timestep_id, entry.camera_id), entry)
            if first is not entry:
                raise DataError(
                    f"{root / f'transforms_{split}.json'}: frame {entry.label} is timestep {entry.timestep_id} of "
                    f"camera {entry.camera_id}, and so is {first.label}; remove one of them, or tell their cameras "
                    "apart by camera_index"
                )


def _params_of_timesteps(entries: dict[Split, list[_Entry]], root: Path) -> dict[int, Path]:
    """Return the parameter file of each timestep, of which there is one."""
    params_of: dict[int, Path] = {}
    for entry in (entry for split in SPLITS for entry in entries[split]):
        path = params_of.setdefault(entry.timestep_id, entry.params_path)
        if path != entry.params_path:
            raise DataError(
                f"{root / f'transforms_{entry.split}.json'}: frame {entry.label} has {entry.params_path.name}, but "
                f"timestep {entry.timestep_id} has {path.name} elsewhere; a timestep has one flame_param_path"
            )
    return params_of


def _read_params(paths: list[Path]) -> HeadParams:
    """Parameters of all timesteps; widths and identity must agree, the offset is that of the first one."""
    wanted = {*PARAM_WIDTHS, "shape"}
    first = read_npz(paths[0], wanted=lambda key: key in wanted | {"static_offset"}, max_bytes=MAX_PARAM_BYTES).arrays
    shape = _row(first, "shape", None, path=paths[0])
    rows: dict[str, list[np.ndarray]] = {key: [] for key in PARAM_WIDTHS}
    for path in paths:
        arrays = read_npz(path, wanted=lambda key: key in wanted, max_bytes=MAX_PARAM_BYTES).arrays
        for key, width in PARAM_WIDTHS.items():
            rows[key].append(_row(arrays, key, width, path=path))
        _check_agrees(rows["expr"][0], rows["expr"][-1], "expr", path, paths[0])
        own_shape = _row(arrays, "shape", None, path=path)
        _check_agrees(shape, own_shape, "shape", path, paths[0])
        if not np.allclose(shape, own_shape, rtol=1e-3, atol=1e-4):
            raise DataError(f"{path}: shape differs from that of {paths[0]}; one subject has one identity")
    stacked = {key: np.stack(values) for key, values in rows.items()}
    return HeadParams(shape=shape, static_offset=_static_offset(first, path=paths[0]), **stacked)


def _row(arrays: dict[str, np.ndarray], key: str, width: int | None, *, path: Path) -> np.ndarray:
    """One timestep's value of a parameter, flat: VHAP writes (1, n)."""
    if key not in arrays:
        raise DataError(f"{path}: no {key}; VHAP's parameters are shape, {', '.join(PARAM_WIDTHS)}")
    value = float_array(arrays[key], where=f"{path}: {key}")
    if value.size != max(value.shape, default=0) or (width is not None and value.size != width):
        needed = "n" if width is None else width
        raise DataError(f"{path}: {key} has shape {value.shape}, (1, {needed}) is needed: one timestep a file")
    return value.reshape(-1)


def _check_agrees(first: np.ndarray, value: np.ndarray, key: str, path: Path, first_path: Path) -> None:
    if len(value) != len(first):
        raise DataError(
            f"{path}: {key} has {len(value)} coefficients, but {first_path} has {len(first)}; all files need the same"
        )


def _static_offset(arrays: dict[str, np.ndarray], *, path: Path) -> np.ndarray | None:
    if "static_offset" not in arrays:
        return None
    offset = float_array(arrays["static_offset"], where=f"{path}: static_offset")
    if offset.shape[-1:] != (3,) or offset.ndim > 3 or (offset.ndim == 3 and len(offset) != 1):
        raise DataError(f"{path}: static_offset has shape {offset.shape}, (1, V, 3) is needed")
    return offset.reshape(-1, 3)
