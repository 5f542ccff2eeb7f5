"""OffsetNet: attribute offsets of the Gaussians from UV position maps (Section 3.2, Eq. 10)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mgavatar.config import ResolvedOffsetNetConfig
from mgavatar.kernels.binding import N_OFFSETS

N_THETA = 15
"""Rotations of root, neck, jaw and both eyes."""


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
        up = nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False)
        self.decoder = nn.Sequential(
            _conv(c + c // 2, c), up, _conv(c, c), up, _conv(c, c // 2), up, _conv(c // 2, c // 2)
        )
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
        pose = self.encode_pose(theta)[None, :, None, None].expand(-1, -1, *features.shape[2:])
        decoded = self.decoder(_laid_out(torch.cat([features, pose], 1)))
        return self.last(torch.cat([decoded, maps], 1))[0]


def _laid_out(maps: Tensor) -> Tensor:
    """Lay maps out channels last on a CPU: layers are 1.4 times faster, and sampling needs no transpose."""
    return maps if maps.is_cuda else maps.contiguous(memory_format=torch.channels_last)
