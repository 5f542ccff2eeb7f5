"""OffsetNet: attribute offsets of the Gaussians from UV position maps (Section 3.2, Eq. 10)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from mgavatar.config import ResolvedOffsetNetConfig
from mgavatar.kernels.binding import N_OFFSETS

N_THETA = 15
"""Rotations of root, neck, jaw and both eyes."""


@contextlib.contextmanager
def deterministic_convolutions() -> Iterator[None]:
    """Let cuDNN use only algorithms that give the same bits on every run, forward and backward, inside the block."""
    before = torch.backends.cudnn.deterministic
    torch.backends.cudnn.deterministic = True
    try:
        yield
    finally:
        torch.backends.cudnn.deterministic = before


class _UpsampleFunction(torch.autograd.Function):
    """Bilinear upsampling by two with an adjoint that gathers, so that it has the same bits on every run.

    torch's own adjoint adds with atomics on CUDA.
    """

    @staticmethod
    def forward(ctx: Any, maps: Tensor) -> Tensor:
        return functional.interpolate(maps, scale_factor=2.0, mode="bilinear", align_corners=False)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return _gather_pairs(_gather_pairs(grad, 2), 3)


def _gather_pairs(grad: Tensor, dim: int) -> Tensor:
    """Apply the adjoint of linear upsampling by two along one dimension.

    Input i is read by outputs 2i and 2i + 1 with weight 3/4, and by their outer neighbours 2i - 1 and 2i + 2 with 1/4.
    The first and the last input are read with 1/4 more by their own outputs, whose outer neighbour is missing.
    """
    # Outputs come in pairs: even[i] is output 2i, odd[i] is output 2i + 1.
    n = grad.shape[dim] // 2
    even, odd = grad.unflatten(dim, (n, 2)).unbind(dim + 1)
    out = (even + odd).mul_(0.75)
    out.narrow(dim, 1, n - 1).add_(odd.narrow(dim, 0, n - 1), alpha=0.25)
    out.narrow(dim, 0, n - 1).add_(even.narrow(dim, 1, n - 1), alpha=0.25)
    out.select(dim, 0).add_(even.select(dim, 0), alpha=0.25)
    out.select(dim, n - 1).add_(odd.select(dim, n - 1), alpha=0.25)
    return out


class Upsample(nn.Module):
    """Bilinear upsampling by two, as ``nn.Upsample`` without aligned corners, deterministic on every device."""

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps [N, C, H, W] as [N, C, 2 H, 2 W]."""
        return _UpsampleFunction.apply(maps)


def _conv(n_in: int, n_out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(n_in, n_out, 3, stride=stride, padding=1), nn.LeakyReLU(0.1))


class OffsetNet(nn.Module):
    """Encoder and decoder over the UV atlas, with the pose between them.

    One layer embeds the maps, and eight extract features at an eighth of the resolution. The decoder has five layers,
    the last of which also takes the embedded maps at full resolution. All offsets start at zero.
    """

    def __init__(self, config: ResolvedOffsetNetConfig) -> None:
        super().__init__()
        size, c = config.resolution, config.channels
        self.latent = nn.Parameter(0.1 * torch.randn(3, size, size))
        self.embed = _conv(9, c // 2)
        self.encoder = nn.Sequential(
            _conv(c // 2, c, 2), _conv(c, c), _conv(c, c, 2), _conv(c, c),
            _conv(c, c, 2), _conv(c, c), _conv(c, c), _conv(c, c),
        )  # fmt: skip
        self.encode_pose = nn.Sequential(nn.Linear(N_THETA, c // 2), nn.LeakyReLU(0.1), nn.Linear(c // 2, c // 2))
        self.decoder = nn.Sequential(
            _conv(c + c // 2, c), Upsample(), _conv(c, c), Upsample(),
            _conv(c, c // 2), Upsample(), _conv(c // 2, c // 2),
        )  # fmt: skip
        # The last layer starts at zero: the Gaussians are drawn as they are until the maps have learned something.
        self.last = nn.Conv2d(c, N_OFFSETS, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        assert self.last.bias is not None  # noqa: S101  for the type checker
        nn.init.zeros_(self.last.bias)

    def forward(self, canonical_map: Tensor, pose_map: Tensor, theta: Tensor) -> Tensor:
        """Compute the offset maps, ``O_map = Phi_d([Phi_e([M_cano, M_pose, Z]), E(theta)])`` (Eq. 10).

        Args:
            canonical_map: Canonical positions over the atlas, in units of the head's size, shape [3, H, W].
            pose_map: Posed positions without root motion, in the same units, shape [3, H, W].
            theta: Rotation vectors of the five joints [rad], shape [15].

        Returns:
            Offset maps, shape [13, H, W].
        """
        maps = self.embed(_laid_out(torch.cat([canonical_map, pose_map, self.latent])[None]))
        features = self.encoder(maps)
        # One vector for all texels: the pose is the same everywhere.
        pose = self.encode_pose(theta)[None, :, None, None].expand(-1, -1, *features.shape[2:])
        decoded = self.decoder(_laid_out(torch.cat([features, pose], 1)))
        return self.last(torch.cat([decoded, maps], 1))[0]


def _laid_out(maps: Tensor) -> Tensor:
    """Lay maps out channels last on a CPU: layers are 1.4 times faster, and sampling needs no transpose."""
    return maps if maps.is_cuda else maps.contiguous(memory_format=torch.channels_last)
