"""FLAME's parameters: of a whole capture as arrays, of one timestep as tensors."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class HeadParams:
    """FLAME parameters of T timesteps, float32; angles are rotation vectors [rad].

    Attributes:
        shape: Identity coefficients, shape [S].
        expr: Expression coefficients, shape [T, E].
        rotation: Root rotation about the root joint, shape [T, 3].
        neck_pose: Shape [T, 3].
        jaw_pose: Shape [T, 3].
        eyes_pose: Left, then right eye, shape [T, 6].
        translation: Added after skinning [m], shape [T, 3].
        static_offset: Vertex offsets of the tracker [m], shape [V, 3], or None.
    """

    shape: np.ndarray
    expr: np.ndarray
    rotation: np.ndarray
    neck_pose: np.ndarray
    jaw_pose: np.ndarray
    eyes_pose: np.ndarray
    translation: np.ndarray
    static_offset: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.expr)


@dataclass(frozen=True, eq=False)
class Pose:
    """One timestep of FLAME parameters as tensors; angles are rotation vectors [rad].

    Attributes:
        expr: Shape [E].
        rotation: Shape [3].
        neck_pose: Shape [3].
        jaw_pose: Shape [3].
        eyes_pose: Left, then right eye, shape [6].
        translation: Metres, shape [3].
    """

    expr: Tensor
    rotation: Tensor
    neck_pose: Tensor
    jaw_pose: Tensor
    eyes_pose: Tensor
    translation: Tensor

    def joint_rotations(self) -> Tensor:
        """Rotation vectors of root, neck, jaw and both eyes, shape [5, 3]."""
        return torch.cat([self.rotation, self.neck_pose, self.jaw_pose, self.eyes_pose]).reshape(5, 3)

    def centered(self) -> Pose:
        """The same face without root rotation and translation."""
        zero = torch.zeros_like(self.rotation)
        return Pose(self.expr, zero, self.neck_pose, self.jaw_pose, self.eyes_pose, zero)

    def to(self, device: torch.device) -> Pose:
        return Pose(*(getattr(self, field.name).to(device) for field in fields(self)))


def pad_or_truncate(values: np.ndarray, n: int) -> np.ndarray:
    """Coefficients cut or padded with zeros along the last axis to ``n``, float32."""
    out = np.zeros((*values.shape[:-1], n), np.float32)
    width = min(n, values.shape[-1])
    out[..., :width] = values[..., :width]
    return out


def pose_of(params: HeadParams, timestep: int, n_expr: int) -> Pose:
    """Row ``timestep`` of tracked parameters, with as many expression coefficients as the head has."""
    rows = (pad_or_truncate(params.expr, n_expr), params.rotation, params.neck_pose, params.jaw_pose, params.eyes_pose)
    return Pose(*(torch.from_numpy(row[timestep].copy()) for row in (*rows, params.translation)))
