"""FLAME's parameters: as arrays over T frames, and as tensors for one frame."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
import torch
from torch import Tensor

POSE_WIDTHS = {"rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
"""Number of columns of each parameter whose width is the same in all FLAME heads."""

MOTION_KEYS = ("expr", *POSE_WIDTHS)
"""Parameters that change from frame to frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HeadParams:
    """FLAME parameters of T frames; angles are rotation vectors [rad].

    Attributes:
        expr: Expression coefficients, shape [T, E].
        rotation: Root rotation about the root joint, shape [T, 3].
        neck_pose: Shape [T, 3].
        jaw_pose: Shape [T, 3].
        eyes_pose: Left, then right eye, shape [T, 6].
        translation: Added after skinning [m], shape [T, 3].
        shape: Identity coefficients of all frames, shape [S]; empty if the motion has no identity.
        static_offset: Vertex offsets of the tracker [m], shape [V, 3], or None.
    """

    expr: np.ndarray
    rotation: np.ndarray
    neck_pose: np.ndarray
    jaw_pose: np.ndarray
    eyes_pose: np.ndarray
    translation: np.ndarray
    shape: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    static_offset: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check shapes and finiteness.

        Raises:
            ValueError: If an array has another shape, or holds NaN or infinity; the message names it.
        """
        n_frames = len(self.expr)
        for name, width in POSE_WIDTHS.items():
            found = getattr(self, name).shape
            if found != (n_frames, width):
                raise ValueError(f"{name} has shape {found}, ({n_frames}, {width}) is needed")
        if self.expr.ndim != 2 or self.shape.ndim != 1:
            raise ValueError(f"expr {self.expr.shape} and shape {self.shape.shape} need shapes (T, E) and (S,)")
        if self.static_offset is not None and self.static_offset.shape[1:] != (3,):
            raise ValueError(f"static_offset has shape {self.static_offset.shape}, (V, 3) is needed")
        for entry in fields(HeadParams):  # a subclass may have fields that are not numbers
            values = getattr(self, entry.name)
            if values is not None and not np.isfinite(values).all():
                raise ValueError(f"{entry.name} holds NaN or infinity")

    @staticmethod
    def neutral(*, n_frames: int, n_expr: int) -> HeadParams:
        """Return frames of a neutral face at the origin, float32."""
        widths = {"expr": n_expr, **POSE_WIDTHS}
        return HeadParams(**{name: np.zeros((n_frames, width), np.float32) for name, width in widths.items()})

    def __len__(self) -> int:
        return len(self.expr)

    def pose(self, frame: int, *, n_expr: int | None = None) -> Pose:
        """Return one frame as float32 tensors on the CPU.

        Args:
            frame: Row of the arrays.
            n_expr: Length to which ``expr`` is padded or truncated, that of the head model; None keeps all of it.
        """
        rows = {name: getattr(self, name)[frame] for name in MOTION_KEYS}
        if n_expr is not None:
            rows["expr"] = pad_or_truncate(rows["expr"], n_expr)
        return Pose(**{name: torch.tensor(row, dtype=torch.float32) for name, row in rows.items()})


@dataclass(frozen=True, eq=False)
class Pose:
    """One frame of :class:`HeadParams` as tensors; angles are rotation vectors [rad].

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
        """Return the rotation vectors of root, neck, jaw and both eyes, shape [5, 3]."""
        return torch.cat([self.rotation, self.neck_pose, self.jaw_pose, self.eyes_pose]).reshape(5, 3)

    def without_root(self) -> Pose:
        """Return the same expression, neck, jaw and eyes without root rotation and translation."""
        zero = torch.zeros_like(self.rotation)
        return Pose(self.expr, zero, self.neck_pose, self.jaw_pose, self.eyes_pose, zero)

    def to(self, device: torch.device) -> Pose:
        """Return the pose on another device."""
        return Pose(*(getattr(self, entry.name).to(device) for entry in fields(self)))


def pad_or_truncate(values: np.ndarray, n: int) -> np.ndarray:
    """Return coefficients padded with zeros or truncated along the last axis to ``n``, float32."""
    out = np.zeros((*values.shape[:-1], n), np.float32)
    width = min(n, values.shape[-1])
    out[..., :width] = values[..., :width]
    return out
