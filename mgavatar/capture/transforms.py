"""Frames of a NeRF-style transforms file, and their cameras."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from mgavatar.camera import Camera
from mgavatar.config import PrincipalPoint
from mgavatar.errors import DataError
from mgavatar.files import one_line, path_inside

MAX_PIXELS = 64_000_000

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


class FrameReader:
    """One frame of a transforms file: values of the frame, or else those at the top of the file.

    Attributes:
        path: The transforms file.
        meta: Values at the top of the file.
        values: Values of the frame.
        label: Name of the frame in messages.
        where: File and frame, with which messages begin.
    """

    def __init__(self, path: Path, meta: dict[str, Any], frame: dict[str, Any], label: str) -> None:
        self.path, self.meta, self.values, self.label = path, meta, frame, label
        self.where = f"{path}: frame {label}"

    def has(self, key: str) -> bool:
        """Return True if the frame or the top of the file has a value for a key."""
        return self.values.get(key) is not None or self.meta.get(key) is not None

    def number(self, key: str) -> float:
        """Return a finite number.

        Raises:
            DataError: If it is missing or something else.
        """
        value = self.values[key] if self.values.get(key) is not None else self.meta.get(key)
        if value is None:
            raise DataError(f"{self.where} has no {key}, and neither has the top of the file")
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:  # false for NaN
            raise DataError(f"{self.where}: {key} is {one_line(repr(value), limit=40)}, a finite number is needed")
        return float(value)

    def whole(self, key: str, *, low: int, high: int = 10**8) -> int:
        """Return a whole number from ``low`` to ``high``.

        Raises:
            DataError: If it is missing or something else.
        """
        value = self.number(key)
        if value != int(value) or not low <= value <= high:
            raise DataError(f"{self.where}: {key} is {value:g}, a whole number from {low} to {high} is needed")
        return int(value)

    def file(self, key: str) -> Path:
        """Return the path of an existing file in the capture's folder or in one beside it.

        Raises:
            DataError: If the entry is not such a file.
        """
        where = f"{self.where}: {key}" if key != "file_path" else self.where
        return path_inside(self.values.get(key), base=self.path.parent, allowed=self.path.parent.parent, where=where)


def camera_of_frame(reader: FrameReader, principal_point: PrincipalPoint) -> Camera:
    """Return the camera of a frame.

    Transforms files have camera to world in OpenGL axes (y up, z backwards), cameras have world to camera in OpenCV's.

    Args:
        reader: The frame.
        principal_point: Place of the principal point, as in ``read_capture``.

    Raises:
        DataError: If a value is missing or impossible.
    """
    width, height = (reader.whole(key, low=1, high=MAX_PIXELS) for key in ("w", "h"))
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
