"""Frames of a NeRF-style transforms file, and their cameras."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mgavatar.camera import Camera
from mgavatar.config import PrincipalPoint
from mgavatar.errors import DataError
from mgavatar.files import one_line, path_inside

MAX_PIXELS = 64_000_000

LARGEST_INDEX = 2**62
"""Serial numbers and time stamps in nanoseconds are less."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".PNG", ".JPG", ".JPEG")
"""Endings that are tried for images that a transforms file names without one, or with another."""

_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*", re.ASCII)

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


class LinkedFolders:
    """Folders outside a capture that links inside it may lead to.

    Whoever puts a capture on two disks links a folder: ``images``, or a sequence beside a UNION capture. Such links
    are followed. A link of a single file, or deeper down, is what a hostile archive would contain: it is followed on
    request alone.

    Attributes:
        allowed: Folder that the files must be in apart from that, already resolved.
        followed: Links that were followed, and where they lead.
    """

    def __init__(self, allowed: Path, *, follow_all: bool) -> None:
        self.allowed, self._follow_all = allowed, follow_all
        self.followed: dict[Path, Path] = {}
        self._known: dict[Path, Path | None] = {}

    def of(self, path: Path) -> tuple[Path, ...]:
        """Return the folders outside that a path, which has been normalised, may be in."""
        if self._follow_all:
            return (Path(path.anchor),)
        if not path.is_relative_to(self.allowed):
            return ()
        parts = path.relative_to(self.allowed).parts[:-1][:2]  # the sequence, and a folder in it
        folders = [self.allowed.joinpath(*parts[: count + 1]) for count in range(len(parts))]
        targets = [self._target(folder) for folder in folders]
        return tuple(target for target in targets if target is not None)

    def _target(self, folder: Path) -> Path | None:
        """Return the folder that a link leads to, or None if it is no link to a folder."""
        if folder not in self._known:
            leads = folder.is_symlink() and folder.is_dir()
            self._known[folder] = folder.resolve() if leads else None
            if leads and not folder.resolve().is_relative_to(self.allowed):
                self.followed[folder] = folder.resolve()
        return self._known[folder]


class FrameReader:
    """One frame of a transforms file: values of the frame, or else those at the top of the file.

    Attributes:
        path: The transforms file.
        meta: Values at the top of the file.
        values: Values of the frame.
        label: Name of the frame in messages.
        where: File and frame, with which messages begin.
    """

    def __init__(
        self,
        path: Path,
        meta: dict[str, Any],
        frame: dict[str, Any],
        label: str,
        *,
        links: LinkedFolders | None = None,
    ) -> None:
        self.path, self.meta, self.values, self.label = path, meta, frame, label
        self.links = links
        self.where = f"{path}: frame {label}"

    def has(self, key: str) -> bool:
        """Return True if the frame or the top of the file has a value for a key."""
        return self.values.get(key) is not None or self.meta.get(key) is not None

    def number(self, key: str) -> float:
        """Return a finite number, which may be written as text.

        Raises:
            DataError: If it is missing or something else.
        """
        value = self._given(key)
        if not isinstance(value, int | float) or not abs(value) < 1e9:  # false for NaN
            raise DataError(f"{self.where}: {key} is {_shown(value)}, a finite number is needed")
        return float(value)

    def whole(self, key: str, *, low: int, high: int = LARGEST_INDEX) -> int:
        """Return a whole number from ``low`` to ``high``, which may be written as text.

        Raises:
            DataError: If it is missing or something else.
        """
        value = self._given(key)
        is_whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())  # false for NaN
        if not is_whole or not low <= value <= high:
            needed = "a whole number" if high == LARGEST_INDEX else f"a whole number from {low} to {high}"
            raise DataError(f"{self.where}: {key} is {_shown(value)}, {needed} is needed")
        return int(value)

    def _given(self, key: str) -> Any:
        """Return a value; text that is a number as that number, and truth values as text."""
        value = self.values[key] if self.values.get(key) is not None else self.meta.get(key)
        if value is None:
            raise DataError(f"{self.where} has no {key}, and neither has the top of the file")
        if isinstance(value, str) and len(value) < 40 and _NUMBER.fullmatch(value):
            return int(value) if value.strip().lstrip("+-").isdigit() else float(value)
        return str(value).lower() if isinstance(value, bool) else value

    def file(self, key: str) -> Path:
        """Return the path of an existing file in the capture's folder or in one beside it.

        Raises:
            DataError: If the entry is not such a file.
        """
        where = f"{self.where}: {key}" if key != "file_path" else self.where
        base, allowed = self.path.parent, self.path.parent.parent
        entry = self.values.get(key)
        lexical = _lexical(entry, base)
        linked = self.links.of(lexical) if self.links is not None and lexical is not None else ()
        return path_inside(
            entry,
            base=base,
            allowed=allowed,
            where=where,
            linked=linked,
            remedy=", or give --follow-links if you trust its links" if self.links is not None else "",
        )

    def image(self, key: str) -> Path:
        """Return the path of an existing image, as :meth:`file`; its ending may be missing or another one.

        Raises:
            DataError: If there is no such file.
        """
        entry = self.values.get(key)
        try:
            return self.file(key)
        except DataError as error:
            for other in _other_endings(entry, self.path.parent, self.path.parent.parent):
                reader = FrameReader(self.path, self.meta, {key: other}, self.label, links=self.links)
                return reader.file(key)
            raise error


def _shown(value: object) -> str:
    return f"the text {one_line(repr(value), limit=40)}" if isinstance(value, str) else one_line(repr(value), limit=40)


def _lexical(entry: object, base: Path) -> Path | None:
    """Return the normalised path of an entry, without asking the file system; None if it is no path."""
    return Path(os.path.normpath(base / entry.replace("\\", "/"))) if isinstance(entry, str) else None


def _other_endings(entry: object, base: Path, allowed: Path) -> Iterator[str]:
    """Yield the entry with endings of images under which there is a file."""
    path = _lexical(entry, base)
    if path is None or not isinstance(entry, str) or "\0" in entry or not path.is_relative_to(allowed):
        return
    stem, ending = os.path.splitext(entry)
    stems = (entry, stem) if ending.lower() in (suffix.lower() for suffix in IMAGE_SUFFIXES) else (entry,)
    for candidate in (stem + suffix for stem in stems for suffix in IMAGE_SUFFIXES):
        try:
            found = os.path.isfile(os.path.normpath(base / candidate.replace("\\", "/")))
        except (OSError, ValueError):  # too long, or no text for a file's name
            return
        if found:
            yield candidate


def camera_of_frame(
    reader: FrameReader, principal_point: PrincipalPoint, *, size: tuple[int, int] | None = None
) -> Camera:
    """Return the camera of a frame.

    Transforms files have camera to world in OpenGL axes (y up, z backwards), cameras have world to camera in OpenCV's.

    Args:
        reader: The frame.
        principal_point: Place of the principal point, as in ``read_capture``.
        size: Width and height [px] if the frame does not state them.

    Raises:
        DataError: If a value is missing or impossible.
    """
    width, height = size or (reader.whole(key, low=1, high=MAX_PIXELS) for key in ("w", "h"))
    if width * height > MAX_PIXELS:
        raise DataError(f"{reader.where}: an image of {width}x{height} is too large")
    focal_x = _focal(reader, width)
    focal_y = reader.number("fl_y") if reader.has("fl_x") and reader.has("fl_y") else focal_x
    if not (focal_x > 0 and focal_y > 0):
        raise DataError(f"{reader.where}: a focal length of {focal_x:g}, {focal_y:g} px is not positive")
    cx, cy = width / 2, height / 2
    if principal_point != "center" and reader.has("cx") and reader.has("cy"):
        cx, cy = reader.number("cx"), reader.number("cy")
        cy = height - cy if principal_point == "opengl" else cy
    K = np.array([[focal_x, 0.0, cx], [0.0, focal_y, cy], [0.0, 0.0, 1.0]])
    return Camera(_viewmat(reader), K, width, height)


def _focal(reader: FrameReader, width: int) -> float:
    if reader.has("fl_x"):
        return reader.number("fl_x")
    angle = reader.number("camera_angle_x")
    if not 0.0 < angle < math.pi:
        raise DataError(f"{reader.where}: camera_angle_x is {angle:g}, an angle between 0 and pi is needed")
    return 0.5 * width / math.tan(0.5 * angle)


def _viewmat(reader: FrameReader) -> np.ndarray:
    try:
        pose = np.array(reader.values.get("transform_matrix"), np.float64)
    except (ValueError, TypeError, OverflowError):
        pose = np.zeros(0)
    if pose.shape != (4, 4):
        raise DataError(f"{reader.where}: transform_matrix must be 4x4 numbers, camera to world")
    if not np.all(np.isfinite(pose)):
        raise DataError(f"{reader.where}: transform_matrix holds NaN or infinity; remove the frame or track it again")
    rotation = pose[:3, :3]
    bounded = np.abs(pose).max() < 1e6  # before products that would overflow
    rigid = bounded and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    if not rigid or not np.allclose(pose[3], [0.0, 0.0, 0.0, 1.0], atol=1e-6):
        raise DataError(f"{reader.where}: transform_matrix is not a rotation and a translation")
    return np.linalg.inv(pose @ OPENGL_TO_OPENCV)
