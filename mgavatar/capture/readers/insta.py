"""Captures of INSTA and of metrical-tracker, on which RGBAvatar, FlashAvatar, GaussianBlendshapes and FATE build too.

The tracker writes a ``checkpoint/NNNNN.frame`` for each image: FLAME parameters of a head that stands still, and a
camera that moves around it. INSTA adds ``transforms_*.json``, of which only the splits are read: the camera of a
``.frame`` is the one that belongs to its parameters.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.camera import Camera
from mgavatar.capture.failures import Failures
from mgavatar.capture.mattes import images_with_mattes
from mgavatar.capture.subject import SPLITS, Frame, Split, Subject
from mgavatar.capture.transforms import FrameReader, LinkedFolders
from mgavatar.config import PrincipalPoint
from mgavatar.errors import DataError
from mgavatar.files import float_array, one_line, path_inside, read_json
from mgavatar.head.flame_pickle import read_torch_archive
from mgavatar.head.params import HeadParams

MARK = "checkpoint/*.frame"

TEST_FRAMES = 350
"""Last frames that the field holds out; of shorter videos, the last 30 %."""

_NUMBER = re.compile(r"\d+")

log = logging.getLogger("mgavatar")


def recognises(root: Path) -> bool:
    """Return True if a folder has frames of metrical-tracker or expressions of INSTA, and no parameters of VHAP's."""
    if (root / "flame_param").exists() or (root / "canonical_flame_param.npz").exists():
        return False
    return (root / "flame/exp").is_dir() or any((root / "checkpoint").glob("*.frame"))


def read(
    root: Path,
    *,
    background: tuple[float, float, float],
    principal_point: PrincipalPoint,
    skip_bad: bool,
    follow_links: bool,
) -> Subject:
    """Read a capture in this layout; arguments, result and errors are those of ``read_capture``.

    The principal point is that of the tracker, whatever ``principal_point`` says.
    """
    failures = Failures(root, skip=skip_bad)
    links = LinkedFolders(root.parent, follow_all=follow_links)
    splits = _splits(root, links)
    tracked = _tracked(root, {number for own in splits.values() for number in own}, failures)
    if not any(number in tracked for number in splits["train"]):
        raise DataError(f"{root / 'checkpoint'}: no .frame of a training image can be used")
    log.info("%s: INSTA or metrical-tracker: %d tracked frames, cameras from them", root, len(tracked))
    _say_what_is_not_used(root, tracked)
    numbers = sorted(tracked)
    row_of = {number: row for row, number in enumerate(numbers)}
    entries: dict[Split, list[tuple[Path, _Tracked, int]]] = {
        split: [(path, tracked[n], row_of[n]) for n, path in splits[split].items() if n in row_of] for split in SPLITS
    }
    mattes = images_with_mattes((path, own.camera) for rows in entries.values() for path, own, _ in rows)
    frames: dict[Split, tuple[Frame, ...]] = {
        split: tuple(
            Frame(path, path if path in mattes else None, own.camera, 0, row, background)
            for path, own, row in entries[split]
        )
        for split in SPLITS
    }
    first = tracked[numbers[0]]
    rows = {key: np.stack([tracked[number].rows[key] for number in numbers]) for key in first.rows}
    still = np.zeros((len(numbers), 3), np.float32)
    params = HeadParams(shape=first.shape, rotation=still, neck_pose=still, translation=still, **rows)
    return Subject(root, frames, params, tuple(numbers), np.array(background, np.float32), None)


@dataclass(frozen=True)
class _Tracked:
    """Contents of a ``.frame``.

    Attributes:
        camera: World is the head's space.
        shape: Identity, shape [S].
        rows: ``expr``, ``jaw_pose`` and ``eyes_pose``, flat.
        eyelids: Largest coefficient of the tracker's own eyelids, which FLAME lacks.
    """

    camera: Camera
    shape: np.ndarray
    rows: dict[str, np.ndarray]
    eyelids: float


def _splits(root: Path, links: LinkedFolders) -> dict[Split, dict[int, Path]]:
    """Return the images of each split by the numbers in their names."""
    if (root / "transforms_train.json").exists():
        return {split: _split_of_file(root / f"transforms_{split}.json", links) for split in SPLITS}
    images = {}
    folder = next((root / name for name in ("images", "matted", "imgs") if (root / name).is_dir()), root / "images")
    for path in sorted(folder.glob("*")):
        if path.suffix.lower() in (".png", ".jpg", ".jpeg") and (number := _number_of(path.stem)) is not None:
            where = str(folder)
            images[number] = path_inside(
                str(path.relative_to(root)), base=root, allowed=root.parent, where=where, linked=links.of(path)
            )
    if not images:
        raise DataError(f"{folder}: no images beside checkpoint/*.frame; copy the tracker's input frames here")
    numbers = sorted(images)
    held_out = min(TEST_FRAMES, int(0.3 * len(numbers)))
    log.info("%s: no transforms_train.json: the last %d of %d frames are test", root, held_out, len(numbers))
    train = numbers[: len(numbers) - held_out]
    test = numbers[len(train) :]
    return {"train": {n: images[n] for n in train}, "val": {}, "test": {n: images[n] for n in test}}


def _split_of_file(path: Path, links: LinkedFolders) -> dict[int, Path]:
    if not path.exists():
        return {}
    meta = read_json(path)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(f"{path}: no list of frames; it must be {{'frames': [...]}} as INSTA writes it")
    images = {}
    for index, frame in enumerate(frames):
        reader = FrameReader(path, meta, frame, one_line(frame.get("file_path") or index, limit=80), links=links)
        image = reader.image("file_path")
        number = _number_of(image.stem)
        if number is None:
            raise DataError(f"{reader.where}: has no number in its name that would tell its .frame")
        images[number] = image
    return images


def _number_of(stem: str) -> int | None:
    """Return the last number in a name."""
    found = _NUMBER.findall(stem)
    return int(found[-1]) if found and len(found[-1]) < 18 else None


def _tracked(root: Path, wanted: set[int], failures: Failures) -> dict[int, _Tracked]:
    """Read the frames that have images."""
    files = {}
    for path in (root / "checkpoint").glob("*.frame"):
        if (number := _number_of(path.stem)) is not None:
            files[number] = path
    if not files:
        raise DataError(
            f"{root}: an INSTA capture without checkpoint/*.frame: flame/exp has expressions, but no jaw, eyes and "
            "identity; copy the checkpoint folder of metrical-tracker here"
        )
    tracked: dict[int, _Tracked] = {}
    for number in sorted(wanted):
        try:
            if number not in files:
                raise DataError(f"{root / 'checkpoint'}: no .frame of image {number}")
            tracked[number] = _read_frame(files[number])
        except DataError as error:
            failures.found[f"frame {number}"] = error
    failures.settle(len(tracked), "frames")
    return tracked


def _read_frame(path: Path) -> _Tracked:
    content = read_torch_archive(path)
    flame, opencv = (_table(content, key, path) for key in ("flame", "opencv"))
    R = _floats(opencv, "R", 9, path).reshape(3, 3)
    K = _floats(opencv, "K", 9, path).reshape(3, 3)
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0 or not (K[0, 0] > 0 and K[1, 1] > 0):
        raise DataError(f"{path}: opencv has no rotation R or no focal length in K")
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, _floats(opencv, "t", 3, path)
    height, width = (int(value) for value in _floats(content, "img_size", 2, path))
    if not (0 < width <= 65_536 and 0 < height <= 65_536):
        raise DataError(f"{path}: img_size is {height} x {width}")
    eyes = _floats(flame, "eyes", 12, path)
    eyelids = float(np.abs(_floats(flame, "eyelids", None, path)).max(initial=0.0)) if "eyelids" in flame else 0.0
    rows = {
        "expr": _floats(flame, "exp", None, path),
        "jaw_pose": rotation_vector(_floats(flame, "jaw", 6, path), path=path),
        # The first one turns FLAME's joint 3 and the second one joint 4, whatever the tracker calls them.
        "eyes_pose": np.concatenate([rotation_vector(half, path=path) for half in (eyes[:6], eyes[6:])]),
    }
    narrow = {key: value.astype(np.float32) for key, value in rows.items()}
    shape = _floats(flame, "shape", None, path).astype(np.float32)
    return _Tracked(Camera(viewmat, K, width, height), shape, narrow, eyelids)


def rotation_vector(six: np.ndarray, *, path: Path) -> np.ndarray:
    """Return the rotation vector of a rotation that is stored as the first two rows of its matrix.

    Args:
        six: The rows, one after the other, shape [6]; they need not be orthonormal.
        path: File that the message names.

    Raises:
        DataError: If they are parallel or zero.
    """
    first, second = six[:3], six[3:]
    x = first / max(float(np.linalg.norm(first)), 1e-12)
    across = second - (x @ second) * x
    length = float(np.linalg.norm(across))
    if np.linalg.norm(first) < 1e-6 or length < 1e-6:
        raise DataError(f"{path}: a rotation of six numbers has rows that are parallel or zero")
    y = across / length
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)])).as_rotvec()


def _table(content: dict[str, Any], key: str, path: Path) -> dict[str, Any]:
    value = content.get(key)
    if not isinstance(value, dict):
        has = ", ".join(one_line(name, limit=30) for name in list(content)[:8])
        raise DataError(f"{path}: no {key}; frames of metrical-tracker have flame, opencv and img_size, this has {has}")
    return value


def _floats(table: dict[str, Any], key: str, size: int | None, path: Path) -> np.ndarray:
    """Return an entry as flat float64."""
    if key not in table:
        raise DataError(f"{path}: no {key}")
    value = float_array(np.asarray(table[key]), where=f"{path}: {key}")
    if (size is not None and value.size != size) or value.size > 10_000:
        raise DataError(
            f"{path}: {key} has shape {value.shape}, {size if size is not None else 'few'} numbers are needed"
        )
    if np.abs(value).max(initial=0.0) > 1e6:
        raise DataError(f"{path}: {key} reaches {np.abs(value).max():.3g}, which cannot be")
    return value.reshape(-1).astype(np.float64)


def _say_what_is_not_used(root: Path, tracked: dict[int, _Tracked]) -> None:
    eyelids = max(own.eyelids for own in tracked.values())
    if eyelids > 0.0:
        log.info("%s: eyelids, up to %.2g, are not used: FLAME has no such shapes", root, eyelids)
