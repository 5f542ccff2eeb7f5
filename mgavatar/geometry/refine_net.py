"""RefineNet: vertex offsets from a triplane (Section 3.1, Eq. 1 and 2)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from mgavatar.config import ResolvedGeometryConfig
from mgavatar.kernels.mlp import linear_layers, mlp
from mgavatar.kernels.sparse import SparseMatrix, sparse_apply
from mgavatar.kernels.uv_map import uv_sampler

N_POSE = 12
"""Number of inputs of Phi_pose for the rotations of neck, jaw and both eyes."""


def _mlp(n_in: int, hidden: int) -> nn.Sequential:
    """Return four layers to a 3-vector; the last one starts at zero, and so training at the template."""
    last = nn.Linear(hidden, 3)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(
        nn.Linear(n_in, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
        nn.Linear(hidden, hidden), nn.ReLU(), last,
    )  # fmt: skip


class RefineNet(nn.Module):
    """Identity and pose offsets of every vertex.

    Vertices keep their place in the triplane, so sampling it is a fixed matrix.

    Attributes:
        unit: Offset that a network's output of 1 means [m].
        planes: Features of the three planes, texels row by row, shape [3, resolution^2, channels].
        phi_id: Network of Eq. 1, or None if switched off.
        phi_pose: Network of Eq. 2, or None if switched off.
    """

    def __init__(self, v_template: Tensor, config: ResolvedGeometryConfig, *, mean_pose: Tensor) -> None:
        """Start at the template.

        Args:
            v_template: Vertices of the fine template [m], shape [V, 3].
            config: Sizes, and the offsets that are learned.
            mean_pose: Neck, jaw and eye rotations [rad] at which the pose offsets are zero, shape [12].
        """
        super().__init__()
        resolution, channels = config.triplane_resolution, config.triplane_channels
        self.unit = config.offset_unit
        self.planes = nn.Parameter(0.1 * torch.randn(3, resolution**2, channels))
        self.phi_id = _mlp(3 * channels, config.hidden) if config.identity_offsets else None
        self.phi_pose = _mlp(3 * channels + N_POSE, config.hidden) if config.pose_offsets else None
        self.centered = config.center_pose_offsets
        self.mean_pose: Tensor
        self.register_buffer("mean_pose", mean_pose.clone())
        # One scale for all axes: a texel is as long as it is wide on the head. Built on the CPU, so that the weights
        # have the same bits whatever the device.
        low, high = v_template.min(0).values, v_template.max(0).values
        place = ((v_template - low) / (high - low).max()).cpu()
        pairs = ((0, 1), (1, 2), (2, 0))
        self._samplers: list[SparseMatrix] = [
            uv_sampler(place[:, list(pair)].contiguous(), resolution, resolution) for pair in pairs
        ]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> RefineNet:
        """Move the samplers with the parameters; torch calls this for ``to`` and ``cuda``."""
        super()._apply(fn, recurse)
        self._samplers = [sampler.to(self.planes.device) for sampler in self._samplers]
        return self

    def networks(self) -> list[nn.Parameter]:
        """List the parameters of the networks, all but the triplane."""
        return [parameter for name, parameter in self.named_parameters() if name != "planes"]

    def encode(self) -> Tensor:
        """Return the triplane features of all vertices, ``E_tri(mu_0)``, shape [V, 3 channels]."""
        return torch.cat([sparse_apply(s, plane) for s, plane in zip(self._samplers, self.planes, strict=True)], 1)

    def identity_offsets(self, features: Tensor) -> Tensor:
        """Compute the identity offsets ``delta mu_id`` of Eq. 1 [m], shape [V, 3]; zero if switched off."""
        if self.phi_id is None:
            return torch.zeros(len(features), 3, device=features.device)
        weights, biases = linear_layers(self.phi_id)
        return self.unit * mlp(features, weights, biases)

    def pose_offsets(self, features: Tensor, pose: Tensor) -> Tensor:
        """Return ``delta mu_pose`` of Eq. 2 [m], shape [V, 3]; zero if switched off.

        Its value at the mean pose is subtracted: without that, Phi_pose becomes a second identity network, and the
        canonical head of Eq. 1 is nobody's.

        Args:
            features: Triplane features of the vertices, shape [V, 3 channels].
            pose: Neck, jaw and eye rotations [rad], shape [12].
        """
        if self.phi_pose is None:
            return torch.zeros(len(features), 3, device=features.device)
        offsets = self._phi_pose(features, pose)
        if self.centered:
            offsets = offsets - self._phi_pose(features, self.mean_pose)
        return self.unit * offsets

    def _phi_pose(self, features: Tensor, pose: Tensor) -> Tensor:
        assert self.phi_pose is not None  # noqa: S101  for the type checker
        weights, biases = linear_layers(self.phi_pose)
        n = features.shape[1]
        # The pose is the same for all vertices: its share of the first layer is one vector.
        biases[0] = biases[0] + weights[0][:, n:] @ pose
        weights[0] = weights[0][:, :n]
        return mlp(features, weights, biases)
