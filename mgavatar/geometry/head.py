"""The personal head: identity, offsets and per-timestep parameters (Section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from mgavatar.capture.subject import HeadParams
from mgavatar.config import GeometryConfig
from mgavatar.geometry.refine_net import RefineNet
from mgavatar.head.body import Body, Pose, fitted


@dataclass(frozen=True, eq=False)
class PosedHead:
    """What one pose makes of the personal head; all shapes [V, 3], metres.

    Attributes:
        shaped: ``mu_bar``, the parametric identity.
        identity_offsets: ``delta mu_id``.
        pose_offsets: ``delta mu_pose``.
        verts: Posed vertices in world space.
    """

    shaped: Tensor
    identity_offsets: Tensor
    pose_offsets: Tensor
    verts: Tensor


class PersonalHead(nn.Module):
    """Learnable identity beta, offset networks, and theta, psi and translation of every timestep."""

    def __init__(self, body: Body, params: HeadParams, config: GeometryConfig) -> None:
        super().__init__()
        self.body = body
        device = body.device
        n_expr = body.model.n_expr
        start = fitted(params.shape, body.model.n_shape) if config.start_from_tracked_shape else 0.0 * params.shape
        self.betas = nn.Parameter(torch.from_numpy(fitted(np.asarray(start), body.model.n_shape)).to(device))
        tracked = {
            "expr": fitted(params.expr, n_expr),
            "rotation": params.rotation,
            "neck": params.neck_pose,
            "jaw": params.jaw_pose,
            "eyes": params.eyes_pose,
            "translation": params.translation,
        }
        self.poses = nn.ParameterDict(
            {
                name: nn.Parameter(torch.tensor(value, dtype=torch.float32, device=device))
                for name, value in tracked.items()
            }
        )
        template = torch.tensor(body.fine.v_template, device=device)
        self.refine = RefineNet(template, config).to(device)

    def pose(self, timestep: int) -> Pose:
        """Parameters of a timestep of the capture, as refined so far."""
        return Pose(
            *(self.poses[name][timestep] for name in ("expr", "rotation", "neck", "jaw", "eyes", "translation"))
        )

    def posed(self, pose: Pose) -> PosedHead:
        """Eq. 1 to 3, then expression, pose and skinning."""
        features = self.refine.encode()
        shaped = self.body.shaped(self.betas)
        identity = self.refine.identity_offsets(features)
        by_pose = self.refine.pose_offsets(features, torch.cat([pose.neck, pose.jaw, pose.eyes]))
        canonical = shaped + identity
        joints = self.body.joints(canonical)
        return PosedHead(shaped, identity, by_pose, self.body.posed(canonical + by_pose, pose, joints=joints))

    def canonical(self) -> Tensor:
        """``mu_c`` of Eq. 1: the neutral personal head [m], shape [V, 3]."""
        return self.body.shaped(self.betas) + self.refine.identity_offsets(self.refine.encode())
