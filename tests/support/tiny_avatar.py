"""An avatar small enough for tests: a ball with a Gaussian at each vertex, on a capture of a few small images."""

from __future__ import annotations

from pathlib import Path

import torch
from ball_head import ball_head
from captures import write_capture

from mgavatar.avatar import Avatar
from mgavatar.capture.info import CaptureInfo
from mgavatar.capture.read import read_capture
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, GeometryConfig, resolve
from mgavatar.gaussians import SH_C0
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.head.body import Body
from mgavatar.head.model import HeadModel

COLOR = (0.8, 0.5, 0.3)


def tiny_avatar(root: Path, *, model: HeadModel | None = None, **capture: object) -> tuple[Avatar, Subject]:
    """Write a capture below ``root`` and make an avatar of it that was never trained; its ball has one colour."""
    subject = read_capture(write_capture(root / "capture", **capture))  # type: ignore[arg-type]
    return avatar_on(subject, ball_head() if model is None else model), subject


def avatar_on(subject: Subject, model: HeadModel) -> Avatar:
    """An avatar at the start of its fit."""
    torch.manual_seed(0)
    geometry = GeometryConfig(subdivisions=0, hidden=8, triplane_resolution=8, triplane_channels=2)
    config = resolve(FitConfig(geometry=geometry))
    gaussians = VertexGaussians(PersonalHead(Body(model, subdivisions=0), subject.params, geometry), config)
    with torch.no_grad():
        gaussians.log_scales.fill_(-3.5)
        gaussians.colors.copy_(((torch.tensor(COLOR) - 0.5) / SH_C0).expand_as(gaussians.colors))
    for parameter in gaussians.parameters():
        parameter.requires_grad_(False)
    return Avatar(gaussians, None, CaptureInfo.of(subject), config)
