"""Cameras to draw an avatar from: the capture's own, an orbit, or those of a file."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.avatar import Avatar
from mgavatar.camera import Camera
from mgavatar.capture.transforms import FrameReader, camera_of_frame
from mgavatar.errors import DataError
from mgavatar.files import read_json

ORBIT_DEGREES = 40.0

MAX_SIDE = 8192


def cameras_of(avatar: Avatar, camera: str, *, n_frames: int, size: tuple[int, int] | None = None) -> list[Camera]:
    """Return the camera of every frame.

    Args:
        avatar: Avatar with its training cameras.
        camera: ``"mean"``, the training camera nearest to the middle of them all; ``"train:<id>"``; ``"orbit"``, one
            swing of the mean camera 40 degrees to both sides around the head; or the path of a ``.json`` with a frame
            of a VHAP transforms file: ``transform_matrix``, ``w``, ``h``, ``fl_x`` or ``camera_angle_x``. A file with
            ``frames`` has one of them, or as many as there are frames to draw.
        n_frames: Number of frames.
        size: Width and height [px] to fit the view into, or None.

    Returns:
        One camera per frame.

    Raises:
        DataError: If there is no such camera.
    """
    if camera == "mean":
        cameras = [avatar.capture.mean_camera()] * n_frames
    elif camera == "orbit":
        cameras = _orbit(avatar, n_frames)
    elif camera.startswith("train:"):
        cameras = [_train_camera(avatar, camera)] * n_frames
    elif camera.lower().endswith(".json"):
        cameras = _cameras_of_file(Path(camera), n_frames, avatar)
    else:
        raise DataError(f"no camera '{camera}'; there are {_choices(avatar)}")
    return cameras if size is None else [_fitted(view, size) for view in cameras]


def _choices(avatar: Avatar) -> str:
    ids = sorted(avatar.capture.cameras)
    shown = ", ".join(f"train:{index}" for index in ids[:20]) + (f", … train:{ids[-1]}" if len(ids) > 20 else "")
    return f"mean, orbit, {shown}, and the path of a .json"


def _train_camera(avatar: Avatar, name: str) -> Camera:
    index = name.removeprefix("train:")
    if not index.isdecimal() or int(index) not in avatar.capture.cameras:
        raise DataError(f"no camera '{name}'; there are {_choices(avatar)}")
    return avatar.capture.cameras[int(index)]


def _orbit(avatar: Avatar, n_frames: int) -> list[Camera]:
    """Return one swing of the mean camera to both sides of the head and back to its place."""
    phases = np.arange(n_frames) / n_frames
    return turned_cameras(avatar, avatar.capture.mean_camera(), ORBIT_DEGREES * np.sin(2.0 * math.pi * phases))


def turned_cameras(avatar: Avatar, camera: Camera, yaws: Iterable[float]) -> list[Camera]:
    """Turn a camera rigidly about the upright axis of the head in its mean pose, by each of the yaws [deg]."""
    pose = avatar.mean_pose()
    center = avatar.verts(pose).mean(dim=0).cpu().numpy().astype(np.float64)
    up = Rotation.from_rotvec(pose.rotation.numpy()).apply([0.0, 1.0, 0.0])
    cameras = []
    for yaw in yaws:
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(-math.radians(yaw) * up).as_matrix()
        turn[:3, 3] = center - turn[:3, :3] @ center
        cameras.append(replace(camera, viewmat=camera.viewmat @ turn))
    return cameras


def _cameras_of_file(path: Path, n_frames: int, avatar: Avatar) -> list[Camera]:
    meta = read_json(path)
    if not isinstance(meta, dict):
        raise DataError(f"{path}: no camera in it; it needs transform_matrix, w, h and fl_x, as in a transforms file")
    entries = meta.get("frames", [meta])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{path}: frames must be a list of objects, as in a transforms file")
    if len(entries) not in (1, n_frames):
        raise DataError(f"{path}: has {len(entries)} cameras for {n_frames} frames; give one, or one per frame")
    cameras = [_camera_of_entry(path, meta, entry, index, avatar) for index, entry in enumerate(entries)]
    return cameras * n_frames if len(cameras) == 1 else cameras


def _camera_of_entry(path: Path, meta: dict[str, Any], entry: dict[str, Any], index: int, avatar: Avatar) -> Camera:
    reader = FrameReader(path, meta, entry, str(index))
    if "transform_matrix" not in entry:
        raise DataError(f"{path}: frame {index} has no transform_matrix, camera to world in OpenGL axes")
    return camera_of_frame(reader, avatar.config.principal_point)


def _fitted(camera: Camera, size: tuple[int, int]) -> Camera:
    """Fit a view into another image size; its proportions stay, and two sides show more of the scene."""
    width, height = size
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DataError(f"--size {width}x{height}: both sides must lie between 1 and {MAX_SIDE} pixels")
    factor = min(width / camera.width, height / camera.height)
    K = camera.K * np.array([[factor], [factor], [1.0]])
    K[0, 2] += (width - factor * camera.width) / 2
    K[1, 2] += (height - factor * camera.height) / 2
    return Camera(camera.viewmat, K, width, height)
