"""The avatar: a fitted person in memory, drawn in any pose from any camera."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from mgavatar.appearance.model import Appearance
from mgavatar.avatar_file import AvatarParts, read_avatar, write_avatar
from mgavatar.camera import Camera
from mgavatar.capture.info import CaptureInfo
from mgavatar.config import FitConfig
from mgavatar.gaussians import Gaussians, draw
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.head.model import HeadModel
from mgavatar.head.params import Pose
from mgavatar.kernels.rasterize import Rendering


class Avatar:
    """A fitted head with its appearance; before the appearance stage, its vertex-bound Gaussians.

    Attributes:
        head: The personal head; its ``poses`` are the capture's, as refined.
        vertex_gaussians: The geometry stage's Gaussians.
        appearance: The appearance, or None.
        capture: What the avatar was fitted to.
        config: How.
    """

    def __init__(
        self, vertex_gaussians: VertexGaussians, appearance: Appearance | None, capture: CaptureInfo, config: FitConfig
    ) -> None:
        self.vertex_gaussians = vertex_gaussians
        self.head: PersonalHead = vertex_gaussians.head
        self.appearance = appearance
        self.capture = capture
        self.config = config

    @property
    def head_model(self) -> HeadModel:
        return self.head.body.model

    @property
    def device(self) -> torch.device:
        return self.head.body.device

    @property
    def n_gaussians(self) -> int:
        return self.head.body.n_verts if self.appearance is None else len(self.appearance.gaussians)

    @torch.no_grad()
    def verts(self, pose: Pose) -> Tensor:
        """The personal mesh in a pose [m], shape [V, 3]."""
        return self.head.posed(pose.to(self.device)).verts

    @torch.no_grad()
    def gaussians(self, pose: Pose, camera: Camera) -> Gaussians:
        """World-space Gaussians in a pose as a camera sees them."""
        pose = pose.to(self.device)
        if self.appearance is None:
            return self.vertex_gaussians.bound(self.head.posed(pose), camera)
        return self.appearance(self.appearance.frozen.posed(pose), camera)[0]

    @torch.no_grad()
    def render(self, pose: Pose, camera: Camera, background: Tensor | None = None) -> Rendering:
        """Draw the avatar in a pose; the capture's background by default."""
        if background is None:
            background = torch.tensor(self.capture.background)
        return draw(
            self.gaussians(pose, camera), camera, background=background.to(self.device), config=self.config.raster
        )

    def save(self, path: Path) -> None:
        """Write ``avatar.pt``: tensors and plain types, read back with ``weights_only=True``. Atomic."""
        write_avatar(path, AvatarParts(self.vertex_gaussians, self.appearance, self.capture, self.config))

    @staticmethod
    def load(path: Path, *, device: torch.device | str = "cpu") -> Avatar:
        """Read and check an avatar file.

        Raises:
            DataError: If the file is missing, is not an avatar, or does not hold together.
        """
        parts = read_avatar(path, device=device)
        return Avatar(parts.vertex_gaussians, parts.appearance, parts.capture, parts.config)
