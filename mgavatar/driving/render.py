"""Drawing a driven avatar into a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.camera import Camera
from mgavatar.config import background_color
from mgavatar.driving.cameras import cameras_of
from mgavatar.driving.expression_map import ExpressionMap
from mgavatar.driving.motion import Driving
from mgavatar.driving.retarget import ExpressionMode, HeadMotion, driving_notes, head_points, poses_of
from mgavatar.driving.writers import FileKind, Format, frame_writer, kind_of
from mgavatar.errors import DataError
from mgavatar.files import one_line
from mgavatar.head.params import Pose


def render(
    avatar: Avatar,
    driving: Driving,
    *,
    out: Path | str,
    camera: str = "mean",
    head_motion: HeadMotion = "full",
    expression: ExpressionMode = "auto",
    expression_map: ExpressionMap | None = None,
    format: Format = "auto",
    size: tuple[int, int] | None = None,
    frames: slice | None = None,
    background: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Draw an avatar in every pose of a driving sequence, into a video or a folder of images.

    Args:
        avatar: The avatar.
        driving: The motion.
        out: A name ending in ``.mp4`` or ``.gif``, else a folder of PNG or EXR files.
        camera: ``"mean"``, ``"train:<id>"``, ``"orbit"`` or the path of a ``.json``; see :func:`cameras_of`.
        head_motion: How much of the driven head's motion to take; see :func:`poses_of`.
        expression: What to do with the expression columns; see :func:`mgavatar.driving.driving_expression`.
        expression_map: Map from ARKit's blendshapes to the avatar's head; by default that of its names.
        format: ``"auto"`` goes by the name of ``out``.
        size: Width and height [px]; the camera's own if None.
        frames: Frames to draw; all if None.
        background: ``"white"``, ``"black"``, ``"R,G,B"`` or ``"transparent"``; the capture's own if None.
        overwrite: Replace a file of the same kind that is there already.
        progress: Called with the number of frames drawn and their total.

    Returns:
        Lines for the user: what of the driving sequence was not used.

    Raises:
        DataError: If ``out`` cannot be written there or cannot have the background, the camera is unknown, or no frame
            is left.
    """
    out = Path(out)
    kind = kind_of(out, format, overwrite=overwrite)
    behind = backdrop(out, kind, background)
    poses = poses_of(
        avatar,
        driving,
        head_motion=head_motion,
        expression=expression,
        expression_map=expression_map,
        frames=frames,
    )
    if not poses:
        raise DataError(f"{driving.path}: no frames are left of its {len(driving)}; choose other frames")
    cameras = cameras_of(avatar, camera, n_frames=len(poses), size=size)
    with frame_writer(out, kind, fps=driving.fps, transparent=background == "transparent") as add:
        for index, (pose, view) in enumerate(zip(poses, cameras, strict=True)):
            add(avatar.render(pose, view, behind), view)
            if progress is not None:
                progress(index + 1, len(poses))
    notes = driving_notes(avatar, driving, expression=expression, expression_map=expression_map)
    return [*notes, *_view_notes(avatar, driving, poses, cameras)]


def backdrop(out: Path, kind: FileKind, background: str | None) -> Tensor | None:
    """Return the colour to draw frames over, shape [3]: black for those that keep alpha; None for the capture's own.

    Args:
        out: The file or folder.
        kind: Its kind.
        background: As in :func:`render`.

    Raises:
        DataError: If there is no such background, or files of this kind cannot have it.
    """
    if background == "transparent" and kind in ("mp4", "gif"):
        raise DataError(f"{out}: a .{kind} cannot be transparent; give --out a folder, for PNG or EXR with alpha")
    if kind == "exr":
        if background not in (None, "transparent"):
            raise DataError(f"{out}: EXR has alpha and no background; leave --background out")
        return torch.zeros(3)
    if background is None:
        return None
    if background == "transparent":
        return torch.zeros(3)
    try:
        return torch.tensor(background_color(background))
    except ValueError as error:
        raise DataError(f"--background {one_line(background, limit=40)}: {error}, or transparent") from error


def _view_notes(avatar: Avatar, driving: Driving, poses: list[Pose], cameras: list[Camera]) -> list[str]:
    """Return a line if the driven head leaves the picture."""
    names = ("rotation", "neck_pose", "translation")
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
