"""ColorNet: a grid-based neural colour field (Section 3.2, Eq. 9)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mgavatar.config import ColorNetConfig
from mgavatar.kernels.hash_grid import HashGrid, HashGridShape


class ColorNet(nn.Module):
    """Colour of a Gaussian from its canonical position and the direction that it is seen from."""

    def __init__(self, low: Tensor, high: Tensor, config: ColorNetConfig, *, seed: int) -> None:
        """The field covers the box from ``low`` to ``high`` [m], each shape [3]."""
        super().__init__()
        self.low: Tensor
        self.size: Tensor
        self.register_buffer("low", low)
        self.register_buffer("size", high - low)
        shape = HashGridShape(
            levels=config.levels,
            base_resolution=config.base_resolution,
            max_resolution=config.max_resolution,
            log2_table_size=config.log2_table_size,
        )
        self.grid = HashGrid(shape, seed=seed)
        n_in = self.grid.n_outputs + 3
        self.mlp = nn.Sequential(nn.Linear(n_in, config.hidden), nn.ReLU(), nn.Linear(config.hidden, 3))

    def forward(self, canonical_means: Tensor, directions: Tensor) -> Tensor:
        """Eq. 9: ``c' = Phi_color([H(mu_c), d])``.

        Args:
            canonical_means: ``mu_c`` [m], shape [N, 3].
            directions: Unit view directions, shape [N, 3].

        Returns:
            RGB in 0..1, shape [N, 3].
        """
        features = self.grid((canonical_means - self.low) / self.size)
        return torch.sigmoid(self.mlp(torch.cat([features, directions], 1)))
