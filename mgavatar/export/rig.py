"""The personal head as a linear rig, which every animation program can pose: rest mesh, directions, joints, weights."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.head.params import Pose
from mgavatar.kernels.lbs import blend_shapes, joint_transforms, skin
from mgavatar.scoring.evaluate import spread

MAX_WEIGHTS = 4
"""Joints that may move one vertex: more than that, programs do not take."""

_SAMPLE = 32
"""Number of poses that means are taken over."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A head whose vertices are linear in the expression before they are skinned.

    Attributes:
        verts: Rest mesh with identity and offsets [m], shape [V, 3].
        expr_dirs: Directions of the first K expressions [m per unit], shape [K, V, 3].
        expr_names: Their names.
        joints: Rest joints [m], shape [5, 3].
        parents: Parent of each joint, -1 for the root, shape [5], int32, on the CPU.
        weights: Skinning weights, at most ``MAX_WEIGHTS`` of a row are not zero, rows sum to 1, shape [V, 5].
    """

    verts: Tensor
    expr_dirs: Tensor
    expr_names: tuple[str, ...]
    joints: Tensor
    parents: Tensor
    weights: Tensor

    def posed(self, pose: Pose) -> Tensor:
        """Return the vertices in a pose [m], shape [V, 3], as a program that reads the rig computes them."""
        transforms, _ = joint_transforms(self.joints, pose.joint_rotations(), self.parents)
        expressed = blend_shapes(self.verts, self.expr_dirs, pose.expr[: len(self.expr_dirs)].contiguous())
        return skin(expressed, self.weights, transforms) + pose.translation


@torch.no_grad()
def bake_rig(avatar: Avatar, *, n_expr: int) -> Rig:
    """Return the linear rig of an avatar.

    Correctives that depend on the pose, the head model's and those of Phi_pose, are replaced by their mean over the
    training poses. Weights beyond the four largest of a vertex are left out.

    Args:
        avatar: The avatar.
        n_expr: Largest number of expressions; the first ones are taken.
    """
    head, body = avatar.head, avatar.head.body
    canonical = head.canonical()
    joints = head.joints(canonical)
    poses = training_poses(avatar)
    correctives = torch.stack([_correctives(avatar, pose, joints) for pose in poses]).mean(0)
    n_expr = min(n_expr, body.model.n_expr)
    dirs = [body.carry(direction) for direction in body.expr_dirs[:n_expr]]
    names = body.model.expr_names or tuple(f"expression_{index}" for index in range(body.model.n_expr))
    largest = body.lbs_weights.topk(MAX_WEIGHTS, dim=1)
    weights = torch.zeros_like(body.lbs_weights).scatter_(1, largest.indices, largest.values)
    return Rig(
        verts=canonical + correctives,
        expr_dirs=torch.stack(dirs) if dirs else canonical.new_zeros(0, *canonical.shape),
        expr_names=names[:n_expr],
        joints=joints,
        parents=body.parents,
        weights=weights / weights.sum(1, keepdim=True),
    )


def _correctives(avatar: Avatar, pose: Pose, joints: Tensor) -> Tensor:
    """Return what the pose adds to the rest mesh beyond expression and skinning [m], shape [V, 3]."""
    body = avatar.head.body
    by_pose = avatar.head.posed(pose).pose_offsets
    if not body.has_pose_dirs:
        return by_pose
    _, feature = joint_transforms(joints, pose.joint_rotations(), body.parents)
    return by_pose + body.carry(blend_shapes(torch.zeros_like(body.v_template), body.pose_dirs, feature))


def training_poses(avatar: Avatar) -> list[Pose]:
    """Return poses of the capture that have training images, spread over it."""
    return [avatar.head.pose(timestep) for timestep in spread(avatar.capture.train_timesteps, _SAMPLE)]


@torch.no_grad()
def rig_error(avatar: Avatar, rig: Rig, poses: list[Pose]) -> tuple[float, float]:
    """Return the mean and the largest distance of the rig's vertices from the avatar's over poses [mm]."""
    distances = []
    for given in spread(poses, _SAMPLE):
        pose = given.to(avatar.device)
        distances.append((rig.posed(pose) - avatar.verts(pose)).norm(dim=1))
    stacked = 1000.0 * torch.stack(distances)
    return float(stacked.mean()), float(stacked.max())
