"""The avatar: a fitted person in memory, drawn in any pose from any camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mgavatar.appearance.model import Appearance
from mgavatar.avatar_file import AvatarParts, read_avatar, write_avatar
from mgavatar.camera import Camera
from mgavatar.capture.info import CaptureInfo
from mgavatar.config import ResolvedConfig
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
        capture: The capture that the avatar was fitted to, without its images.
        config: The configuration of the fit.
    """

    def __init__(
        self,
        vertex_gaussians: VertexGaussians,
        appearance: Appearance | None,
        capture: CaptureInfo,
        config: ResolvedConfig,
    ) -> None:
        """Put the parts together; see :meth:`load` for a file, and :func:`mgavatar.fit` for a capture."""
        self.vertex_gaussians = vertex_gaussians
        self.head: PersonalHead = vertex_gaussians.head
        self.appearance = appearance
        self.capture = capture
        self.config = config

    @property
    def head_model(self) -> HeadModel:
        """Return the head model that the capture was tracked with."""
        return self.head.body.model

    @property
    def device(self) -> torch.device:
        """Return the device of all tensors."""
        return self.head.body.device

    @property
    def n_gaussians(self) -> int:
        """Return the number of Gaussians."""
        return self.head.body.n_verts if self.appearance is None else len(self.appearance.gaussians)

    def mean_pose(self) -> Pose:
        """Return root, neck and translation averaged over the training timesteps, with a neutral face; on the CPU."""
        rows = list(self.capture.train_timesteps)
        poses = {name: value.detach().cpu().numpy() for name, value in self.head.poses.items()}
        return Pose(
            expr=torch.zeros(self.head_model.n_expr),
            rotation=_mean_rotation(poses["rotation"][rows]),
            neck_pose=_mean_rotation(poses["neck_pose"][rows]),
            jaw_pose=torch.zeros(3),
            eyes_pose=torch.zeros(6),
            translation=torch.from_numpy(poses["translation"][rows].mean(axis=0)),
        )

    def verts(self, pose: Pose, *, grad: bool = False) -> Tensor:
        """Return the personal mesh in a pose [m], shape [V, 3]; its faces are ``head.body.faces``.

        Args:
            pose: The pose, on any device.
            grad: Keep the gradient to the pose.
        """
        with torch.set_grad_enabled(grad):
            return self.head.posed(pose.to(self.device)).verts

    def gaussians(self, pose: Pose, camera: Camera, *, grad: bool = False) -> Gaussians:
        """Return the world-space Gaussians in a pose, coloured as a camera sees them.

        Args:
            pose: The pose, on any device.
            camera: The camera, on which colours depend.
            grad: Keep the gradient to the pose. Colours depend on the pose through OffsetNet; the view direction of
                Eq. 9 has no gradient.
        """
        with torch.set_grad_enabled(grad):
            pose = pose.to(self.device)
            if self.appearance is None:
                return self.vertex_gaussians.bound(self.head.posed(pose), camera)
            posed = self.appearance.frozen.posed(pose, maps_grad=grad)
            return self.appearance(posed, camera)[0]

    def render(
        self,
        pose: Pose,
        camera: Camera,
        background: Tensor | None = None,
        *,
        grad: bool = False,
        viewmat: Tensor | None = None,
    ) -> Rendering:
        """Draw the avatar in a pose.

        Args:
            pose: The pose, on any device.
            camera: The camera.
            background: RGB in 0..1, shape [3]; the capture's by default.
            grad: Keep the gradient to the pose, the expression, ``background`` and ``viewmat``.
            viewmat: World to camera in place of the camera's own, shape [4, 4], for example with a gradient.

        Returns:
            Image in 0..1, coverage and depth, on the avatar's device; see :class:`Rendering`.
        """
        if background is None:
            background = torch.tensor(self.capture.background)
        with torch.set_grad_enabled(grad):
            gaussians = self.gaussians(pose, camera, grad=grad)
            return draw(
                gaussians,
                camera,
                background=background.to(self.device),
                config=self.config.raster,
                viewmat=None if viewmat is None else viewmat.to(self.device),
            )

    def freeze(self) -> None:
        """Exclude all parameters of the avatar from gradients."""
        parts = [self.vertex_gaussians] + ([self.appearance] if self.appearance is not None else [])
        for part in parts:
            part.requires_grad_(False)

    def save(self, path: Path | str) -> None:
        """Write the avatar as tensors and plain types, read back with ``weights_only=True``; whole or not at all.

        Raises:
            DataError: If the file cannot be written.
        """
        write_avatar(Path(path), AvatarParts(self.vertex_gaussians, self.appearance, self.capture, self.config))

    @staticmethod
    def load(path: Path | str, *, device: torch.device | str = "cpu") -> Avatar:
        """Read and check an avatar file, or the ``avatar.pt`` of a fit's folder.

        Args:
            path: The file or the folder; files of every format since ``mgavatar/2`` are read.
            device: Device of all tensors.

        Raises:
            DataError: If the file is missing, is not an avatar, or its contents contradict each other.
        """
        path = Path(path)
        parts = read_avatar(path / "avatar.pt" if path.is_dir() else path, device=device)
        return Avatar(parts.vertex_gaussians, parts.appearance, parts.capture, parts.config)


def _mean_rotation(vectors: np.ndarray) -> Tensor:
    """Return the mean of rotation vectors [rad], shape [3]."""
    return torch.from_numpy(Rotation.from_rotvec(vectors).mean().as_rotvec()).float()
