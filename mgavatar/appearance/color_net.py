"""ColorNet: a grid-based neural colour field (Section 3.2, Eq. 9)."""

from __future__ import annotations

from torch import Tensor, nn

from mgavatar.config import ResolvedColorNetConfig
from mgavatar.kernels.hash_grid import HashGrid, HashGridShape
from mgavatar.kernels.mlp import linear_layers, mlp


class ColorNet(nn.Module):
    """Colour of a Gaussian from its canonical position and the direction that it is seen from."""

    def __init__(self, low: Tensor, high: Tensor, config: ResolvedColorNetConfig, *, seed: int) -> None:
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
        self.sees_directions = config.view_frame != "none"
        n_in = self.grid.n_outputs + 3 * self.sees_directions
        self.mlp = nn.Sequential(nn.Linear(n_in, config.hidden), nn.ReLU(), nn.Linear(config.hidden, 3))

    def forward(self, canonical_means: Tensor, directions: Tensor) -> Tensor:
        """Eq. 9: ``c' = Phi_color([H(mu_c), d])``.

        Args:
            canonical_means: ``mu_c`` [m], shape [N, 3].
            directions: Unit view directions, shape [N, 3]; not looked at where ``view_frame`` is ``none``.

        Returns:
            RGB, shape [N, 3]: the network's distance from a middle grey, not held inside 0..1.
        """
        features = self.grid((canonical_means - self.low) / self.size)
        weights, biases = linear_layers(self.mlp)
        return 0.5 + mlp(features, weights, biases, extra=directions if self.sees_directions else None)
