"""The geometry stage: vertex-bound Gaussians pull the mesh onto the images (Section 3.1, Eq. 4 to 7)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mgavatar.camera import Camera
from mgavatar.config import ImageLossConfig, ResolvedConfig
from mgavatar.geometry.head import PosedHead
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.kernels.laplacian import laplacian
from mgavatar.losses import image_loss


def offset_loss(posed: PosedHead, scales: Tensor) -> Tensor:
    """Compute Eq. 5: squared lengths of the offsets, and squared scales, averaged over vertices [m^2]."""
    identity, by_pose = posed.identity_offsets, posed.pose_offsets
    return identity.square().sum(1).mean() + by_pose.square().sum(1).mean() + scales.square().mean()


def laplacian_loss(gaussians: VertexGaussians, posed: PosedHead, scales: Tensor) -> Tensor:
    """Compute Eq. 6, averaged over vertices [m^2]."""
    # The Laplacian is linear: its difference between refined and parametric mesh is the Laplacian of the offsets.
    matrix = gaussians.head.body.laplacian
    offsets = torch.cat([posed.identity_offsets, posed.identity_offsets + posed.pose_offsets, scales[:, None]], 1)
    return laplacian(matrix, offsets).square().sum(1).mean()


class GeometryStage:
    """The stage that fits the mesh with vertex-bound Gaussians, one optimizer step at a time.

    Attributes:
        gaussians: The Gaussians on the personal head.
        iterations: Configured iterations of the schedule.
        position: Place in the schedule of the rates, in configured iterations.
        decay: Factor of all rates per configured iteration.
    """

    name = "geometry"

    def __init__(self, gaussians: VertexGaussians, config: ResolvedConfig) -> None:
        self.gaussians = gaussians
        self.config = config
        self.iterations = config.geometry.iterations
        self.position = 0.0
        g, head = config.geometry, gaussians.head
        poses = head.poses
        groups = [
            {"params": head.refine.networks(), "lr": g.lr_refine},
            {"params": [head.refine.planes], "lr": g.lr_triplane},
            {"params": [head.betas], "lr": g.lr_shape},
            {"params": [poses["expr"]], "lr": g.lr_expr},
            {"params": [poses[name] for name in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")], "lr": g.lr_pose},
            {"params": [poses["translation"]], "lr": g.lr_translation},
            {"params": [gaussians.log_scales], "lr": g.lr_scale},
            {"params": [gaussians.colors], "lr": g.lr_color},
        ]
        # Adam's usual epsilon of 1e-8 would stop Gaussians that cover few pixels, whose gradients are as small.
        self.optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)
        self.decay = g.lr_final_factor ** (1.0 / max(1, g.iterations))

    def step(
        self, camera: Camera, timestep: int, target: Tensor, background: Tensor, schedule_step: float = 1.0
    ) -> dict[str, float]:
        """Take one optimizer step on Eq. 7, as in :meth:`mgavatar.fitting.stage.Stage.step`."""
        g = self.config.geometry
        head = self.gaussians.head
        posed = head.posed(head.pose(timestep))
        scales = self.gaussians.scales(posed)
        image = self.gaussians.render(posed, camera, background, scales=scales).image
        image_term = image_loss(image, target, self.image_weights())
        offset_term = g.lambda_offset * offset_loss(posed, scales)
        laplacian_term = g.lambda_laplacian * laplacian_loss(self.gaussians, posed, scales)
        loss = image_term + offset_term + laplacian_term
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        # Rates fall with the schedule, not with the steps: a budget makes steps shorter or longer than an iteration.
        for group in self.optimizer.param_groups:
            group["lr"] *= self.decay**schedule_step
        self.position += schedule_step
        if not bool(torch.isfinite(posed.verts).all()):  # such Gaussians are not drawn: no other term shows it
            loss = loss * torch.nan
        # One transfer from the device for all terms: each would wait for it on its own.
        terms = torch.stack([loss, image_term, offset_term, laplacian_term]).detach().tolist()
        return dict(zip(("loss", "image", "offset", "laplacian"), terms, strict=True)) | {"gaussians": len(scales)}

    def image_weights(self) -> ImageLossConfig:
        """Return the weights of Eq. 4 now: they go linearly from those of ``loss`` to those of ``geometry.ssim``."""
        start, end = self.config.loss, self.config.geometry.ssim
        if end is None:
            return start
        done = min(1.0, self.position / max(1, self.iterations))
        return ImageLossConfig(
            color=(1.0 - done) * start.color + done * (1.0 - end), ssim=(1.0 - done) * start.ssim + done * end
        )

    def state_dict(self) -> dict[str, object]:
        """Return everything that a later process needs to go on."""
        return {
            "gaussians": self.gaussians.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "position": self.position,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from the state of a stage with the same configuration."""
        self.gaussians.load_state_dict(state["gaussians"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.position = state["position"]
