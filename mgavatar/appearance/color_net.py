"""ColorNet: a grid-based neural colour field (Section 3.2, Eq. 9)."""

from __future__ import annotations

from torch import Tensor, nn

from mgavatar.config import ResolvedColorNetConfig
from mgavatar.kernels.hash_grid import HashGrid, HashGridShape
from mgavatar.kernels.mlp import linear_layers, mlp


class ColorNet(nn.Module):
    """A field of colours over canonical positions and view directions."""

    def __init__(self, low: Tensor, high: Tensor, config: ResolvedColorNetConfig, *, seed: int) -> None:
        """Make a field over the box from ``low`` to ``high`` [m], shape [3] each."""
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
        self.sees_directions = config.view_frame != "none"
        n_in = self.grid.n_outputs + 3 * self.sees_directions
        self.mlp = nn.Sequential(nn.Linear(n_in, config.hidden), nn.ReLU(), nn.Linear(config.hidden, 3))

    def forward(self, canonical_means: Tensor, directions: Tensor) -> Tensor:
        """Compute the colours of Gaussians, ``c' = Phi_color([H(mu_c), d])`` (Eq. 9).

        Args:
            canonical_means: ``mu_c`` [m], shape [N, 3].
            directions: Unit view directions, shape [N, 3]; unused if ``view_frame`` is ``none``.

        Returns:
            RGB, shape [N, 3], not clamped to 0..1; the network's output is the distance from a middle grey.
        """
        features = self.grid((canonical_means - self.low) / self.size)
        weights, biases = linear_layers(self.mlp)
        return 0.5 + mlp(features, weights, biases, extra=directions if self.sees_directions else None)
