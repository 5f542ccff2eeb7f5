"""The personal head: identity, offsets and per-timestep parameters (Section 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from mgavatar.config import ResolvedGeometryConfig
from mgavatar.geometry.refine_net import RefineNet
from mgavatar.head.body import Body
from mgavatar.head.params import MOTION_KEYS, HeadParams, Pose, pad_or_truncate


@dataclass(frozen=True, eq=False)
class PosedHead:
    """The personal head in one pose; all shapes [V, 3], metres.

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
    """Learnable identity beta, offset networks, and pose, expression and translation of every timestep.

    Attributes:
        body: The subdivided head model.
        betas: Identity coefficients, shape [n_shape].
        poses: FLAME's parameters of all T timesteps by their names, shapes as in
            :class:`~mgavatar.head.params.HeadParams`.
        refine: RefineNet.
        tracked_offsets: The tracker's vertex offsets on the base mesh [m], shape [V_base, 3]; empty if unused.
        tracked_joints: Rest joints of the tracker's own head [m], shape [5, 3].
    """

    tracked_offsets: Tensor
    tracked_joints: Tensor

    def __init__(
        self,
        body: Body,
        params: HeadParams,
        config: ResolvedGeometryConfig,
        *,
        train_rows: Sequence[int] | None = None,
    ) -> None:
        """Start at the tracked parameters, with offsets of zero.

        Args:
            body: The subdivided head model.
            params: Tracked parameters of all timesteps.
            config: Configuration of the geometry stage.
            train_rows: Timesteps whose mean pose has no pose offsets; all if None.
        """
        super().__init__()
        self.body = body
        self.config = config
        device = body.device
        betas = pad_or_truncate(params.shape, body.model.n_shape)
        self.betas = nn.Parameter(
            torch.from_numpy(betas if config.start_from_tracked_shape else 0.0 * betas).to(device)
        )
        self.poses = nn.ParameterDict()
        for name in MOTION_KEYS:
            tracked = getattr(params, name)
            if name == "expr":
                tracked = pad_or_truncate(tracked, body.model.n_expr)
            self.poses[name] = nn.Parameter(torch.tensor(tracked, dtype=torch.float32, device=device))
        self.learn_poses()
        # Not persistent: both follow from the tracked parameters, which an avatar file has.
        known = _base_offsets(params.static_offset, len(body.v_template)) if config.tracked_offsets else None
        offsets = torch.zeros(0, 3) if known is None else torch.from_numpy(known)
        self.register_buffer("tracked_offsets", offsets.to(device), persistent=False)
        with torch.no_grad():
            self.register_buffer("tracked_joints", body.joints(self._tracked_shape(params)), persistent=False)
        mean_pose = mean_joint_pose(params, rows=train_rows)
        self.refine = RefineNet(torch.tensor(body.fine.v_template), config, mean_pose=mean_pose).to(device)

    def learn_poses(self) -> None:
        """Let the parameters of all timesteps learn; jaw and eyes only if ``learn_jaw`` and ``learn_eyes`` are set."""
        self.poses.requires_grad_(True)
        self.poses["jaw_pose"].requires_grad_(self.config.learn_jaw)
        self.poses["eyes_pose"].requires_grad_(self.config.learn_eyes)

    def pose(self, timestep: int) -> Pose:
        """Return the refined parameters of a timestep of the capture."""
        return Pose(**{name: self.poses[name][timestep] for name in MOTION_KEYS})

    def shaped(self) -> Tensor:
        """Return the parametric identity ``mu_bar`` [m], shape [V, 3], with the tracker's offsets if they are used."""
        shaped = self.body.shaped(self.betas)
        return shaped + self.body.carry(self.tracked_offsets) if len(self.tracked_offsets) else shaped

    def posed(self, pose: Pose) -> PosedHead:
        """Compute Eq. 1 to 3: offsets, then expression, pose and skinning."""
        features = self.refine.encode()
        shaped = self.shaped()
        identity = self.refine.identity_offsets(features)
        by_pose = self.refine.pose_offsets(features, torch.cat([pose.neck_pose, pose.jaw_pose, pose.eyes_pose]))
        canonical = shaped + identity
        # Joints come from the canonical head alone: they would wander with the pose if pose offsets moved them.
        joints = self.joints(canonical)
        return PosedHead(shaped, identity, by_pose, self.body.posed(canonical + by_pose, pose, joints=joints))

    def _tracked_shape(self, params: HeadParams) -> Tensor:
        """Return the tracker's own neutral head [m], shape [V, 3], with its offsets if it has some."""
        betas = torch.from_numpy(pad_or_truncate(params.shape, self.body.model.n_shape)).to(self.body.device)
        offsets = _base_offsets(params.static_offset, len(self.body.v_template))
        shaped = self.body.shaped(betas)
        return shaped if offsets is None else shaped + self.body.carry(torch.from_numpy(offsets).to(shaped))

    def joints(self, canonical: Tensor) -> Tensor:
        """Return the rest joints [m], shape [5, 3]: of the refined head, or of the tracked one (``config.joints``)."""
        return self.body.joints(canonical) if self.config.joints == "refined" else self.tracked_joints

    def canonical(self) -> Tensor:
        """Return the neutral personal head ``mu_c`` of Eq. 1 [m], shape [V, 3]."""
        return self.shaped() + self.refine.identity_offsets(self.refine.encode())


def mean_joint_pose(params: HeadParams, *, rows: Sequence[int] | None) -> Tensor:
    """Return the mean rotation vectors of neck, jaw and eyes [rad] over some frames, or over all, shape [12]."""
    poses = np.concatenate([params.neck_pose, params.jaw_pose, params.eyes_pose], axis=1)
    chosen = poses if rows is None else poses[list(rows)]
    return torch.from_numpy(chosen.mean(axis=0).astype(np.float32))


def _base_offsets(static_offset: np.ndarray | None, n_verts: int) -> np.ndarray | None:
    """Return the tracker's offset of each vertex of the head model [m], shape [n_verts, 3]; zero where it has none."""
    if static_offset is None:
        return None
    offsets = np.zeros((n_verts, 3), np.float32)
    # VHAP adds teeth to FLAME and may have more vertices than the head model, or fewer; the first ones are FLAME's own.
    n = min(n_verts, len(static_offset))
    offsets[:n] = static_offset[:n]
    return offsets
