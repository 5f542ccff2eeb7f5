"""Drawing a driven avatar: whose pose, from which camera, into which file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mgavatar.avatar import Avatar
from mgavatar.camera import Camera
from mgavatar.capture.vhap import FrameReader, camera_of_frame
from mgavatar.driving import Driving, ExpressionMode, driving_expression
from mgavatar.errors import DataError
from mgavatar.files import read_json
from mgavatar.head.body import Pose
from mgavatar.video import frame_writer, kind_of

HeadMotion = Literal["full", "neck", "none"]
Format = Literal["auto", "png", "exr", "mp4"]

ORBIT_DEGREES = 40.0
MAX_SIDE = 8192


def render_driving(
    avatar: Avatar,
    driving: Driving,
    *,
    out: Path,
    camera: str = "mean",
    head_motion: HeadMotion = "full",
    expression: ExpressionMode = "auto",
    format: Format = "auto",
    size: tuple[int, int] | None = None,
    frames: slice | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Draw an avatar in every pose of a driving sequence.

    Args:
        avatar: The avatar.
        driving: The motion.
        out: A name ending in ``.mp4`` or ``.gif``, else a folder of PNG or EXR files.
        camera: ``"mean"``, ``"train:<id>"``, ``"orbit"`` or the path of a ``.json``; see :func:`cameras_of`.
        head_motion: How much of the driven head's motion to take; see :func:`poses_of`.
        expression: What to do with the expression columns; see :func:`mgavatar.driving.driving_expression`.
        format: ``"auto"`` goes by the name of ``out``.
        size: Width and height [px]; the camera's own if None.
        frames: Which frames; all if None.
        progress: Called with the number of frames drawn and their total.

    Returns:
        Lines for the user: what of the driving sequence was not used.

    Raises:
        DataError: If ``out`` cannot be written there, the camera is unknown, or no frame is left.
    """
    kind = kind_of(out, format)
    poses = poses_of(avatar, driving, head_motion=head_motion, expression=expression, frames=frames)
    if not poses:
        raise DataError(f"{driving.path}: no frames are left of its {len(driving)}; choose other frames")
    cameras = cameras_of(avatar, camera, n_frames=len(poses), size=size)
    background = torch.zeros(3) if kind == "exr" else None
    with frame_writer(out, kind, fps=driving.fps) as add:
        for index, (pose, view) in enumerate(zip(poses, cameras, strict=True)):
            add(avatar.render(pose, view, background), view)
            if progress is not None:
                progress(index + 1, len(poses))
    return [*driving_notes(avatar, driving, expression=expression), *_view_notes(avatar, driving, poses, cameras)]


def _view_notes(avatar: Avatar, driving: Driving, poses: list[Pose], cameras: list[Camera]) -> list[str]:
    """A line if the driven head leaves the picture."""
    names = ("rotation", "neck", "translation")
    places = head_points(avatar, *(np.stack([getattr(pose, name).numpy() for pose in poses]) for name in names))
    outside = sum(not _sees(camera, place) for camera, place in zip(cameras, places, strict=True))
    if not outside:
        return []
    return [
        f"{driving.path}: the head is outside the picture in {outside} of {len(poses)} frames; "
        "--head-motion neck keeps it in place"
    ]


def _sees(camera: Camera, place: np.ndarray) -> bool:
    x, y, z = camera.K @ (camera.viewmat[:3, :3] @ place + camera.viewmat[:3, 3])
    return bool(z > 0 and 0 <= x < z * camera.width and 0 <= y < z * camera.height)


def driving_notes(avatar: Avatar, driving: Driving, *, expression: ExpressionMode = "auto") -> list[str]:
    """Lines for the user: what of a driving sequence an avatar does not use."""
    note = _expression(avatar, driving, expression)[1]
    return [*driving.notes, *([note] if note else [])]


def poses_of(
    avatar: Avatar,
    driving: Driving,
    *,
    head_motion: HeadMotion = "full",
    expression: ExpressionMode = "auto",
    frames: slice | None = None,
) -> list[Pose]:
    """The avatar's poses under a driving sequence.

    Rotations and expressions are taken as they are. ``"full"`` takes root and neck as driven, and moves the whole
    sequence, which comes from another place, so that the head is on average where it was in training. ``"neck"``
    keeps the shoulders where they were on average in training and turns the neck by what root and neck turn together,
    so that the head looks where the driven one does. ``"none"`` keeps root and neck at their means in training.

    Args:
        avatar: The avatar.
        driving: The motion.
        head_motion: As above.
        expression: What to do with the expression columns.
        frames: Which frames; all if None.

    Returns:
        Poses on the CPU. The means are those of all frames, whatever ``frames`` says.
    """
    mean = mean_pose(avatar)
    expr = _expression(avatar, driving, expression)[0]
    rotation, neck = driving.rotation, driving.neck_pose
    if head_motion == "full":
        translation = driving.translation + _shift(avatar, driving, mean)
    else:
        translation = np.broadcast_to(mean.translation.numpy(), driving.translation.shape)
        own_root = Rotation.from_rotvec(mean.rotation.numpy())
        if head_motion == "neck":
            turned = Rotation.from_rotvec(rotation) * Rotation.from_rotvec(neck)
            neck = (own_root.inv() * turned).as_rotvec()
        else:
            neck = np.broadcast_to(mean.neck.numpy(), neck.shape)
        rotation = np.broadcast_to(mean.rotation.numpy(), rotation.shape)
    columns = (expr, rotation, neck, driving.jaw_pose, driving.eyes_pose, translation)
    tensors = [
        torch.tensor(np.ascontiguousarray(column[frames or slice(None)]), dtype=torch.float32) for column in columns
    ]
    return [Pose(*row) for row in zip(*tensors, strict=True)]


def head_points(avatar: Avatar, rotation: np.ndarray, neck: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """A point inside the head, between neck joint and eyes, in each of T poses [m], shape [T, 3]."""
    head = avatar.head
    with torch.no_grad():
        joints = head.joints(head.canonical()).cpu().numpy().astype(np.float64)
    root, top = joints[0], joints[1]
    inside = (top + joints[3] + joints[4]) / 3.0
    turned = top + Rotation.from_rotvec(neck).apply(inside - top)
    return root + Rotation.from_rotvec(rotation).apply(turned - root) + translation


def _shift(avatar: Avatar, driving: Driving, mean: Pose) -> np.ndarray:
    """What moves the driven head's mean place to the avatar's own [m], shape [3]."""
    own = head_points(avatar, *(value.numpy()[None] for value in (mean.rotation, mean.neck, mean.translation)))
    driven = head_points(avatar, driving.rotation, driving.neck_pose, driving.translation)
    return (own.mean(axis=0) - driven.mean(axis=0)).astype(np.float32)


def mean_pose(avatar: Avatar) -> Pose:
    """Root, neck and translation averaged over the training timesteps; the rest is neutral. On the CPU."""
    rows = list(avatar.capture.train_timesteps)
    poses = {name: value.detach().cpu().numpy() for name, value in avatar.head.poses.items()}
    n_expr = avatar.head_model.n_expr
    return Pose(
        expr=torch.zeros(n_expr),
        rotation=_mean_rotation(poses["rotation"][rows]),
        neck=_mean_rotation(poses["neck"][rows]),
        jaw=torch.zeros(3),
        eyes=torch.zeros(6),
        translation=torch.from_numpy(poses["translation"][rows].mean(axis=0)),
    )


def _mean_rotation(vectors: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(Rotation.from_rotvec(vectors).mean().as_rotvec()).float()


def _expression(avatar: Avatar, driving: Driving, mode: ExpressionMode) -> tuple[np.ndarray, str | None]:
    model = avatar.head_model
    return driving_expression(
        driving, n_expr=model.n_expr, expr_basis=model.expr_basis, expr_names=model.expr_names, mode=mode
    )


def cameras_of(avatar: Avatar, camera: str, *, n_frames: int, size: tuple[int, int] | None = None) -> list[Camera]:
    """The camera of every frame.

    Args:
        avatar: The avatar, which knows its training cameras.
        camera: ``"mean"``, the training camera nearest to the middle of them all; ``"train:<id>"``; ``"orbit"``, one
            swing of the mean camera 40 degrees to both sides around the head; or the path of a ``.json`` with a frame
            of a VHAP transforms file: ``transform_matrix``, ``w``, ``h``, ``fl_x`` or ``camera_angle_x``. A file with
            ``frames`` has one of them, or as many as there are frames to draw.
        n_frames: Number of frames.
        size: Width and height [px] to fit the view into, or None.

    Returns:
        One camera a frame.

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
    """One swing of the mean camera to both sides of the head and back to its place."""
    phases = np.arange(n_frames) / n_frames
    return turned_cameras(avatar, avatar.capture.mean_camera(), ORBIT_DEGREES * np.sin(2.0 * math.pi * phases))


def turned_cameras(avatar: Avatar, camera: Camera, yaws: Iterable[float]) -> list[Camera]:
    """A camera carried rigidly around the upright axis of the head in its mean pose, by each yaw [degrees]."""
    pose = mean_pose(avatar)
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
        raise DataError(f"{path}: has {len(entries)} cameras for {n_frames} frames; give one, or one a frame")
    cameras = [_camera_of_entry(path, meta, entry, index, avatar) for index, entry in enumerate(entries)]
    return cameras * n_frames if len(cameras) == 1 else cameras


def _camera_of_entry(path: Path, meta: dict[str, Any], entry: dict[str, Any], index: int, avatar: Avatar) -> Camera:
    reader = FrameReader(path, meta, entry, str(index))
    if "transform_matrix" not in entry:
        raise DataError(f"{path}: frame {index} has no transform_matrix, camera to world in OpenGL axes")
    return camera_of_frame(reader, avatar.config.principal_point)


def _fitted(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same view inside another image size, its proportions kept: what is added at two sides is further scene."""
    width, height = size
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DataError(f"--size {width}x{height}: both sides must lie between 1 and {MAX_SIDE} pixels")
    factor = min(width / camera.width, height / camera.height)
    K = camera.K * np.array([[factor], [factor], [1.0]])
    K[0, 2] += (width - factor * camera.width) / 2
    K[1, 2] += (height - factor * camera.height) / 2
    return Camera(camera.viewmat, K, width, height)
