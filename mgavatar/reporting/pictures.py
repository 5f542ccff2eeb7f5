"""Pictures that show what a fit did: beside the capture, as a mesh, and driven."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.camera import Camera
from mgavatar.capture.images import read_images
from mgavatar.capture.subject import Frame, Subject
from mgavatar.driving.cameras import turned_cameras
from mgavatar.driving.writers import to_bytes
from mgavatar.head.params import Pose
from mgavatar.kernels.mesh_geometry import vertex_normals
from mgavatar.kernels.ray_cast import RayMesh, camera_rays
from mgavatar.scoring.evaluate import evaluation_pose, spread
from mgavatar.scoring.geometry import tracked_shape

ERROR_GAIN = 4
SIDE_DEGREES = 60.0
STRIP_FRAMES = 8

_PANEL_HEIGHT = 480
_STRIP_HEIGHT = 300
_GAP = 6
_BACK = (0.32, 0.10, 0.10)
"""Colour of faces that are seen from behind."""
_PIXEL_SAMPLES = ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))


def comparison(avatar: Avatar, subject: Subject, frame: Frame) -> np.ndarray:
    """Draw a frame of the capture, the avatar, and their absolute difference times ``ERROR_GAIN`` side by side.

    Returns:
        Pixels, shape [H, W, 3], uint8.
    """
    target = read_images([frame], threads=1)[0].float() / 255.0
    pose = evaluation_pose(avatar, subject, frame.timestep)
    image = avatar.render(pose, frame.camera).image.clamp(0.0, 1.0).cpu()
    panels = (target, image, ERROR_GAIN * (image - target).abs())
    return beside([at_most(to_bytes(panel), _PANEL_HEIGHT) for panel in panels])


def mesh_comparison(avatar: Avatar, subject: Subject, truth: tuple[Tensor, Tensor] | None) -> np.ndarray:
    """Draw the parametric head, the fitted mesh and, if it is known, the true surface, from the front and the side.

    Colours show normals. The pose is that of the first training timestep.

    Args:
        avatar: The avatar.
        subject: The capture.
        truth: Vertices [m] and faces of the true surface at that timestep, or None.

    Returns:
        Pixels, shape [H, W, 3], uint8.
    """
    timestep = first_timestep(subject)
    faces = avatar.head.body.faces
    meshes = [(start_verts(avatar, subject, timestep), faces)]
    meshes.append((avatar.verts(evaluation_pose(avatar, subject, timestep)), faces))
    if truth is not None:
        meshes.append((truth[0].to(avatar.device), truth[1].to(avatar.device, torch.int32)))
    view = _of_height(avatar.capture.mean_camera(), _PANEL_HEIGHT)
    views = turned_cameras(avatar, view, (0.0, SIDE_DEGREES))
    rows = [beside([normal_picture(*mesh, camera) for mesh in meshes]) for camera in views]
    gap = np.full((_GAP, rows[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([rows[0], gap, rows[1]])


def first_timestep(subject: Subject) -> int:
    """Return the first timestep with a training image."""
    return min(frame.timestep for frame in subject.frames["train"])


@torch.no_grad()
def start_verts(avatar: Avatar, subject: Subject, timestep: int) -> Tensor:
    """Return the parametric head in the tracked pose, with which the fit began [m], shape [V, 3]."""
    body, shaped = avatar.head.body, tracked_shape(avatar)
    pose = subject.params.pose(timestep, n_expr=avatar.head_model.n_expr).to(avatar.device)
    return body.posed(shaped, pose, joints=avatar.head.joints(shaped))


def normal_picture(verts: Tensor, faces: Tensor, camera: Camera) -> np.ndarray:
    """Draw a mesh on white, coloured by its smooth normals in camera axes, with four rays per pixel.

    Returns:
        Pixels, shape [H, W, 3], uint8.
    """
    device = verts.device
    samples = torch.tensor(_PIXEL_SAMPLES)
    viewmat = torch.from_numpy(camera.viewmat).to(device)
    origins, directions = camera_rays(
        viewmat, torch.from_numpy(camera.K).to(device), camera.width, camera.height, offsets=samples
    )
    _, face_ids, weights = RayMesh(verts, faces).cast(origins, directions)
    hit = face_ids >= 0
    corners = faces.long()[face_ids.clamp(min=0).long()]
    normals = vertex_normals(verts, faces)
    smooth = torch.nn.functional.normalize((normals[corners] * weights[:, :, None]).sum(1), dim=1)
    in_camera = smooth @ viewmat[:3, :3].T.float() * torch.tensor([1.0, -1.0, -1.0], device=device)
    colors = (0.5 + 0.5 * in_camera).where(in_camera[:, 2:] > 0, torch.tensor(_BACK, device=device))
    a, b, c = verts[corners].unbind(1)
    behind = (torch.cross(b - a, c - a, dim=1) * directions).sum(1) > 0
    colors = colors.where(~behind[:, None], torch.tensor(_BACK, device=device))
    colors = colors.where(hit[:, None], 1.0).reshape(camera.height, camera.width, len(samples), 3).mean(2)
    return to_bytes(colors.permute(2, 0, 1))


def strip(avatar: Avatar, subject: Subject, driving: Sequence[Pose] | None) -> np.ndarray:
    """Draw up to eight poses side by side: of a driving sequence, or else of the capture's held-out timesteps.

    The view is the front; fewer poses are shown from several sides each.

    Returns:
        Pixels, shape [H, W, 3], uint8.
    """
    poses = list(driving) if driving is not None else _held_out_poses(avatar, subject)
    poses = list(spread(poses, STRIP_FRAMES))
    n_views = max(1, STRIP_FRAMES // len(poses))
    view = _of_height(avatar.capture.mean_camera(), _STRIP_HEIGHT)
    yaws = np.linspace(-30.0, 30.0, n_views) if n_views > 1 else [0.0]
    cameras = turned_cameras(avatar, view, yaws)
    return beside([to_bytes(avatar.render(pose, camera).image) for pose in poses for camera in cameras])


def _held_out_poses(avatar: Avatar, subject: Subject) -> list[Pose]:
    frames = subject.frames["test"] or subject.frames["train"]
    return [evaluation_pose(avatar, subject, t) for t in sorted({frame.timestep for frame in frames})]


def _of_height(camera: Camera, height: int) -> Camera:
    """Return the same view, no higher than ``height`` [px]."""
    if camera.height <= height:
        return camera
    return camera.scaled(max(1, round(camera.width * height / camera.height)), height)


def at_most(pixels: np.ndarray, height: int) -> np.ndarray:
    """Return a picture, reduced to ``height`` [px] if it is higher."""
    if len(pixels) <= height:
        return pixels
    width = max(1, math.ceil(pixels.shape[1] * height / len(pixels)))
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.LANCZOS))


def beside(panels: Sequence[np.ndarray]) -> np.ndarray:
    """Join panels of one height in a row with white gaps."""
    gap = np.full((len(panels[0]), _GAP, 3), 255, np.uint8)
    row = [panels[0]]
    for panel in panels[1:]:
        row += [gap, panel]
    return np.concatenate(row, axis=1)
