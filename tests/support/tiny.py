"""A tiny subject that can be fitted in a second: a ball with an atlas, seen by three cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ball_head import ball_head
from captures import write_capture
from PIL import Image

from mgavatar.camera import Camera
from mgavatar.capture.read import read_capture
from mgavatar.capture.subject import Subject
from mgavatar.config import (
    AppearanceConfig,
    ColorNetConfig,
    DensityConfig,
    FitConfig,
    GeometryConfig,
    OffsetNetConfig,
    ResolvedConfig,
    resolve,
)
from mgavatar.fitting.stage import Stage
from mgavatar.fitting.views import Views
from mgavatar.geometry.head import PersonalHead
from mgavatar.head.body import Body
from mgavatar.head.model import HeadModel
from mgavatar.kernels.ray_cast import camera_rays, ray_cast

SIZE = (40, 40)
WHITE = torch.ones(3)
"""Its background."""

STRETCH = np.array([1.35, 1.2, 1.1], np.float32)
"""What the truth has that the template lacks: no identity coefficient can express it."""


def tiny_head() -> HeadModel:
    """The ball with a texture triangle of its own for every face, so that nothing overlaps."""
    ball = ball_head()
    n_faces = len(ball.faces)
    side = int(np.ceil(np.sqrt(n_faces)))
    cell = np.stack([np.arange(n_faces) % side, np.arange(n_faces) // side], 1)[:, None]
    corners = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]])
    vt = ((cell + corners) / side).reshape(-1, 2).astype(np.float32)
    return replace(ball, vt=vt, ft=np.arange(3 * n_faces, dtype=np.int32).reshape(-1, 3))


def tiny_config(*, geometry: dict[str, Any] | None = None, appearance: dict[str, Any] | None = None) -> FitConfig:
    """Few iterations and small networks, with density control at work."""
    g: dict[str, Any] = {
        "iterations": 12, "triplane_resolution": 16, "triplane_channels": 4, "hidden": 16, "lr_pose": 1e-4,
        "surface_shift": 1.0,
    }  # fmt: skip
    a: dict[str, Any] = {
        "iterations": 12,
        "density": DensityConfig(start=4, stop=8, every=4, gradient=1e-5, max_gaussians=600),
        "color_net": ColorNetConfig(levels=3, max_resolution=64, log2_table_size=10, hidden=16),
        "offset_net": OffsetNetConfig(resolution=32, channels=8, lr=1e-3),
    }
    return FitConfig(
        log_every=4,
        geometry=GeometryConfig(**g | (geometry or {})),
        appearance=AppearanceConfig(**a | (appearance or {})),
    )


def tiny_resolved(**sections: Any) -> ResolvedConfig:
    """The same with every ``auto`` decided, for what is built without a plan."""
    return resolve(tiny_config(**sections), {"geometry.subdivisions": 1})


def write_tiny_capture(root: Path, *, n_timesteps: int = 4) -> Path:
    """A capture whose images show the stretched ball in the poses that its parameters say."""
    write_capture(root, n_timesteps=n_timesteps, size=SIZE, n_shape=4, n_expr=3)
    subject = read_capture(root)
    body = Body(tiny_head(), subdivisions=1)
    neutral = body.shaped(torch.tensor(subject.params.shape)) * torch.tensor(STRETCH)
    for split in subject.frames.values():
        for frame in split:
            pose = subject.params.pose(frame.timestep, n_expr=body.model.n_expr)
            verts = body.posed(neutral, pose, joints=body.joints(neutral))
            pixels, mask = _picture(verts, neutral, body.faces, frame.camera)
            Image.fromarray(pixels).save(frame.image_path)
            assert frame.mask_path is not None
            Image.fromarray(mask).save(frame.mask_path)
    return root


def tiny_subject(root: Path) -> Subject:
    """The same, read back."""
    return read_capture(write_tiny_capture(root))


def tiny_personal_head(subject: Subject, config: FitConfig) -> PersonalHead:
    """Its personal head before a fit, with the same numbers at every call."""
    torch.manual_seed(0)
    return PersonalHead(Body(tiny_head(), subdivisions=1), subject.params, config.geometry)


def run(stage: Stage, views: Views, iterations: int) -> list[dict[str, float]]:
    """Steps of a stage, views in turn; the terms of every step."""
    steps = []
    for iteration in range(iterations):
        view = iteration % len(views.images)
        target = views.target(view, WHITE, WHITE)
        steps.append(stage.step(views.cameras[view], views.timesteps[view], target, WHITE))
    return steps


def _picture(
    verts: torch.Tensor, neutral: torch.Tensor, faces: torch.Tensor, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Ray-traced, not splatted: colours by place on the neutral head, on white."""
    view, K = (torch.tensor(matrix, dtype=torch.float32) for matrix in (camera.viewmat, camera.K))
    origins, directions = camera_rays(view, K, camera.width, camera.height)
    face_ids = ray_cast(verts, faces, origins, directions)[1]
    hit = face_ids >= 0
    place = neutral[faces[face_ids.clamp(min=0).long()].long()].mean(1)
    colors = torch.where(hit[:, None], (0.5 + 3.0 * place).clamp(0.0, 0.9), 1.0)
    image = (255.0 * colors).round().byte().numpy().reshape(camera.height, camera.width, 3)
    return image, np.where(hit.numpy(), 255, 0).astype(np.uint8).reshape(camera.height, camera.width)
