"""Captures in the layout of VHAP and GaussianAvatars, the native one, also as UNION of sequences beside it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mgavatar.camera import Camera
from mgavatar.capture.failures import Failures
from mgavatar.capture.mattes import images_with_mattes
from mgavatar.capture.pixels import image_size
from mgavatar.capture.subject import SPLITS, Frame, Split, Subject
from mgavatar.capture.transforms import FrameReader, LinkedFolders, camera_of_frame
from mgavatar.config import PrincipalPoint
from mgavatar.errors import DataError
from mgavatar.files import float_array, one_line, read_json, read_npz
from mgavatar.head.params import POSE_WIDTHS, HeadParams

PARAM_WIDTHS: dict[str, int | None] = {"expr": None, **POSE_WIDTHS}

MAX_PARAM_BYTES = 64 << 20

OTHER_PERSON_RMS, OTHER_PERSON_RELATIVE = 0.3, 0.9
"""Difference of two identities, per coefficient and relative to the longer of them, above which they are two people.

Coefficients are in standard deviations: two strangers with coefficients of length L differ by about 1.4 L."""

MARK = "transforms_train.json"

log = logging.getLogger("mgavatar")


def recognises(root: Path) -> bool:
    """Return True if a folder has the transforms file of a training split."""
    return (root / MARK).exists()


def read(
    root: Path,
    *,
    background: tuple[float, float, float],
    principal_point: PrincipalPoint,
    skip_bad: bool,
    follow_links: bool,
) -> Subject:
    """Read a capture in this layout; arguments, result and errors are those of ``read_capture``."""
    links = LinkedFolders(root.parent, follow_all=follow_links)
    failures = Failures(root, skip=skip_bad)
    entries = {split: list(_split_entries(root, split, principal_point, links, failures)) for split in SPLITS}
    failures.settle(sum(len(own) for own in entries.values()), "frames")
    for link, target in links.followed.items():
        log.info("%s: is a link to %s, which is followed", link, target)
    _check_duplicates(entries, root)
    _warn_of_off_centre(entries, root, principal_point)
    params_of = _params_of_timesteps(entries, root)
    # Splits name timesteps by the capture's own numbers, with gaps; rows of the parameters are counted from 0.
    params, timesteps = _read_params(params_of, failures)
    row_of = {timestep: row for row, timestep in enumerate(timesteps)}
    kept = {split: [entry for entry in own if entry.timestep_id in row_of] for split, own in entries.items()}
    if not kept["train"]:
        raise DataError(f"{root / MARK}: no training frame can be used")
    mattes = images_with_mattes(
        (entry.image_path, entry.camera) for own in kept.values() for entry in own if entry.mask_path is None
    )
    return Subject(
        root=root,
        frames={split: tuple(entry.frame(row_of, background, mattes) for entry in kept[split]) for split in SPLITS},
        params=params,
        timestep_ids=tuple(timesteps),
        background=np.array(background, np.float32),
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
    is_off_centre: bool

    def frame(self, row_of: dict[int, int], background: tuple[float, float, float], mattes: frozenset[Path]) -> Frame:
        own_matte = self.image_path if self.image_path in mattes else None
        return Frame(
            image_path=self.image_path,
            mask_path=self.mask_path or own_matte,
            camera=self.camera,
            camera_id=self.camera_id,
            timestep=row_of[self.timestep_id],
            background=background,
        )


def _split_entries(
    root: Path, split: Split, principal_point: PrincipalPoint, links: LinkedFolders, failures: Failures
) -> Iterator[_Entry]:
    path = root / f"transforms_{split}.json"
    if split != "train" and not path.exists():
        return
    meta = read_json(path)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or (split == "train" and not frames):
        raise DataError(f"{path}: no list of frames; it must be {{'frames': [...]}} as VHAP writes it")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise DataError(f"{path}: frame {index} is no object")
        reader = FrameReader(path, meta, frame, one_line(frame.get("file_path") or index, limit=80), links=links)
        try:
            yield _entry(reader, split=split, principal_point=principal_point)
        except DataError as error:
            failures.found[f"{split} {reader.label}"] = error


def _entry(reader: FrameReader, *, split: Split, principal_point: PrincipalPoint) -> _Entry:
    if "file_path" not in reader.values:
        raise DataError(f"{reader.where} has no file_path")
    if reader.values.get("flame_param_path") is None:
        raise DataError(f"{reader.where} has no flame_param_path; export the capture with its tracked parameters")
    image_path = reader.image("file_path")
    # As in captures for NeRF, whose readers take the size from the images.
    size = None if reader.has("w") and reader.has("h") else image_size(image_path)
    camera = camera_of_frame(reader, principal_point, size=size)
    return _Entry(
        split=split,
        label=reader.label,
        image_path=image_path,
        mask_path=reader.image("fg_mask_path") if reader.values.get("fg_mask_path") else None,
        params_path=reader.file("flame_param_path"),
        camera=camera,
        camera_id=reader.whole("camera_index", low=0) if reader.has("camera_index") else 0,
        timestep_id=reader.whole("timestep_index", low=0),
        is_off_centre=_is_off_centre(reader, camera),
    )


def _is_off_centre(reader: FrameReader, camera: Camera) -> bool:
    if not (reader.has("cx") and reader.has("cy")):
        return False
    away = max(abs(reader.number("cx") - camera.width / 2), abs(reader.number("cy") - camera.height / 2))
    return away > 0.01 * camera.width


def _warn_of_off_centre(entries: dict[Split, list[_Entry]], root: Path, principal_point: PrincipalPoint) -> None:
    for split, own in entries.items():
        count = sum(entry.is_off_centre for entry in own)
        if count and principal_point == "center":
            log.warning(
                "%s: the principal point of %d frames is more than 1 %% off the image centre; it is put into the "
                "centre, as GaussianAvatars does; --principal-point opencv or opengl takes it from the file",
                root / f"transforms_{split}.json",
                count,
            )


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


def _read_params(params_of: dict[int, Path], failures: Failures) -> tuple[HeadParams, list[int]]:
    """Read the parameters of all timesteps, and return them with the timesteps that could be read.

    Numbers of coefficients must agree. Identity and offset are those of the first timestep: sequences that were
    tracked one by one differ a little, and GaussianAvatars takes the first of them too.
    """
    read: dict[int, _Params] = {}
    for timestep in sorted(params_of):
        path = params_of[timestep]
        try:
            own = _params_of(path)
            first = next(iter(read.values()), own)
            for key in ("expr", "shape"):
                _check_agrees(first.rows[key], own.rows[key], key, path, first.path)
        except DataError as error:
            failures.found[f"timestep {timestep}"] = error
        else:
            read[timestep] = own
    failures.settle(len(read), "timesteps")
    first = next(iter(read.values()))
    _check_identities(list(read.values()))
    stacked = {key: np.stack([own.rows[key] for own in read.values()]) for key in PARAM_WIDTHS}
    offset = read_npz(first.path, wanted=lambda key: key == "static_offset", max_bytes=MAX_PARAM_BYTES).arrays
    params = HeadParams(shape=first.rows["shape"], static_offset=_static_offset(offset, path=first.path), **stacked)
    return params, list(read)


@dataclass(frozen=True)
class _Params:
    """Parameters of one timestep, flat, and their file."""

    path: Path
    rows: dict[str, np.ndarray]


def _params_of(path: Path) -> _Params:
    widths = {"shape": None, **PARAM_WIDTHS}
    arrays = read_npz(path, wanted=lambda key: key in widths, max_bytes=MAX_PARAM_BYTES).arrays
    return _Params(path, {key: _row(arrays, key, width, path=path) for key, width in widths.items()})


def _check_identities(params: list[_Params]) -> None:
    """Say how much the identities of sequences differ; refuse those of two people."""
    shapes = np.stack([own.rows["shape"] for own in params]).astype(np.float64)
    if not shapes.size:
        return
    away = shapes - shapes[0]
    worst = int(np.argmax((away**2).sum(1)))
    rms = float(np.sqrt((away[worst] ** 2).mean()))
    relative = float(np.linalg.norm(away[worst])) / max(*np.linalg.norm(shapes[[0, worst]], axis=1), 1e-12)
    if np.allclose(shapes[0], shapes[worst], rtol=1e-3, atol=1e-4):
        return
    size = f"by {rms:.2g} rms per coefficient, {100.0 * relative:.0f} % of its length"
    if rms > OTHER_PERSON_RMS and relative > OTHER_PERSON_RELATIVE:
        raise DataError(
            f"{params[worst].path}: shape differs from that of {params[0].path} {size}: these are two people; one "
            "subject has one identity"
        )
    differing = int((np.abs(away).max(axis=1) > 1e-4).sum())
    log.warning(
        "%s: shape of %d of %d timesteps differs from that of the first, %s, up to %s; as in sequences that were "
        "tracked one by one. The first is used for all, as GaussianAvatars does",
        params[0].path.parent.parent,
        differing,
        len(params),
        params[0].path,
        size,
    )


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
