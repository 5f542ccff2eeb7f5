"""Hash features as a module, with an optimizer step that visits only the entries that have a gradient."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor, nn

from mgavatar.kernels.bridge import launch_ranges
from mgavatar.kernels.hash_encode import BLOCK, HashEncode, TableGradient, check_inputs
from mgavatar.kernels.precision import Real, by_dtype

_BLOCKS = 32  # blocks per CPU item in the optimizer step


# Adam (Kingma and Ba 2015) on the numbers whose gradient is not zero; the others keep their value and moments. Blocks
# without a mark are skipped whole. Inside a block all numbers are computed and then selected: the loop has no branch,
# so it becomes vector instructions.
_ADAM = """
    const long long per_block = (long long)features * BLOCK;
#ifdef __CUDA_ARCH__
    auto root = [](REAL x) { return sqrt(x); };
#else
    auto root = [](REAL x) { return ROOT(x); };  // wp::sqrt would not become a vector instruction
#endif
    for (long long i = begin; i < end;) {
        const long long block = i / per_block;
        const long long stop = (block + 1) * per_block < end ? (block + 1) * per_block : end;
        if (marks.data[block]) {
            REAL* __restrict__ p = table.data;
            REAL* __restrict__ g = grad.data;
            REAL* __restrict__ m = means.data;
            REAL* __restrict__ v = squares.data;
            for (long long k = i; k < stop; ++k) {
                const REAL now = g[k];
                const bool hit = now != REAL(0);
                const REAL mean = beta1 * m[k] + (REAL(1) - beta1) * now;
                const REAL square = beta2 * v[k] + (REAL(1) - beta2) * now * now;
                const REAL moved = p[k] - rate * mean / (root(square) * unbias + eps);
                m[k] = hit ? mean : m[k];
                v[k] = hit ? square : v[k];
                p[k] = hit ? moved : p[k];
                g[k] = REAL(0);
            }
        }
        i = stop;
    }
"""


def _kernels(real: Real) -> SimpleNamespace:
    scalar = real.scalar
    root = "__builtin_sqrt" if real.name == "float64" else "__builtin_sqrtf"

    @wp.func_native(_ADAM.replace("REAL", real.c_name).replace("ROOT", root).replace("BLOCK", str(BLOCK)))
    def adam_range(
        begin: wp.int64,
        end: wp.int64,
        features: int,
        rate: scalar,
        unbias: scalar,
        beta1: scalar,
        beta2: scalar,
        eps: scalar,
        marks: wp.array[wp.uint8],
        table: wp.array2d[scalar],
        grad: wp.array2d[scalar],
        means: wp.array2d[scalar],
        squares: wp.array2d[scalar],
    ) -> None: ...

    @wp.kernel(module=f"{__name__}.{real.name}", enable_backward=False)
    def adam_kernel(
        # In:
        first: int,
        width: int,  # numbers per item
        rate: scalar,
        unbias: scalar,
        beta1: scalar,
        beta2: scalar,
        eps: scalar,
        marks: wp.array[wp.uint8],  # [T / block]
        # Out:
        table: wp.array2d[scalar],  # [T, F] moved where the gradient is not zero
        grad: wp.array2d[scalar],  # [T, F] read, then left at zero
        means: wp.array2d[scalar],  # [T, F] updated
        squares: wp.array2d[scalar],  # [T, F] updated
    ) -> None:
        features = table.shape[1]
        begin = wp.int64(first + wp.tid()) * wp.int64(width)
        end = wp.min(begin + wp.int64(width), wp.int64(table.shape[0]) * wp.int64(features))
        adam_range(begin, end, features, rate, unbias, beta1, beta2, eps, marks, table, grad, means, squares)

    return SimpleNamespace(adam=adam_kernel)


_KERNELS = by_dtype(_kernels)


@dataclass(frozen=True, kw_only=True)
class HashGridShape:
    """Size of a hash grid (Section 3.2)."""

    levels: int = 16
    features: int = 2
    base_resolution: int = 16
    max_resolution: int = 4096
    log2_table_size: int = 19

    def __post_init__(self) -> None:
        """Refuse sizes that no table can have.

        Raises:
            ValueError: If a number is out of range.
        """
        if self.levels < 1 or not 1 <= self.features <= 8:
            raise ValueError(
                f"a hash grid needs 1 level or more and 1 to 8 features, got {self.levels}, {self.features}"
            )
        if not 1 <= self.base_resolution <= self.max_resolution <= 2**20:
            raise ValueError(f"resolutions must be 1 <= base <= max <= 2^20, got {self}")
        if not 1 <= self.log2_table_size <= 24:
            raise ValueError(f"log2_table_size must be 1 to 24, got {self.log2_table_size}")

    def table_levels(self) -> Tensor:
        """List resolution, first entry and number of entries of each level, shape [L, 3], int32.

        Levels start at whole blocks, so that a block's mark belongs to one level.
        """
        ratio = self.max_resolution / self.base_resolution
        rows, first = [], 0
        for level in range(self.levels):
            exponent = level / (self.levels - 1) if self.levels > 1 else 0.0
            resolution = math.floor(self.base_resolution * ratio**exponent + 1e-6)
            n_entries = min((resolution + 1) ** 3, 2**self.log2_table_size)
            rows.append((resolution, first, n_entries))
            first += -(-n_entries // BLOCK) * BLOCK
        return torch.tensor(rows, dtype=torch.int32)


class HashGrid(nn.Module):
    """Multiresolution hash features with their own optimizer (Section 3.2).

    The gradient of ``table`` does not appear in ``table.grad``: backward adds it to a buffer of the module, and
    :meth:`adam_step` visits only the blocks that have one. Leave ``table`` out of torch's optimizers. ``state_dict``
    holds the moments and the number of steps, but not a gradient that no step has used yet.

    Attributes:
        shape: Size of the grid.
        n_outputs: Features per point, L F.
    """

    def __init__(self, shape: HashGridShape | None = None, *, seed: int = 0) -> None:
        """Draw the table uniformly from -1e-4 to 1e-4, from ``seed``."""
        super().__init__()
        self.shape = shape or HashGridShape()
        self.n_outputs = self.shape.levels * self.shape.features
        levels = self.shape.table_levels()
        n_entries = -(-int(levels[-1, 1] + levels[-1, 2]) // BLOCK) * BLOCK
        start = torch.empty(n_entries, self.shape.features)
        start.uniform_(-1e-4, 1e-4, generator=torch.Generator().manual_seed(seed))
        self.table = nn.Parameter(start)
        self.register_buffer("exp_avg", torch.zeros_like(start))
        self.register_buffer("exp_avg_sq", torch.zeros_like(start))
        self.register_buffer("_levels", levels, persistent=False)
        self.register_buffer("_gradient", torch.zeros_like(start), persistent=False)
        self.register_buffer("_marks", torch.zeros(n_entries // BLOCK, dtype=torch.uint8), persistent=False)
        self._owned: TableGradient | None = None
        self._step = 0

    def forward(self, points: Tensor) -> Tensor:
        """Encode points. Differentiable in ``points``; the table's gradient goes to :meth:`adam_step`.

        Args:
            points: Points, clamped to the unit cube (NaN counts as 0), shape [N, 3], dtype of the table.

        Returns:
            Features, level by level, shape [N, L F].

        Raises:
            ValueError: If ``points`` has another shape, dtype or device.
        """
        check_inputs(points, self.table, self._levels)
        return HashEncode.apply(points, self.table, self._levels, self._table_gradient())

    def _table_gradient(self) -> TableGradient:
        if self._owned is None:
            self._owned = TableGradient(self._gradient, self._marks)
        return self._owned

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "HashGrid":
        """Drop the gradient's holder, whose buffers have moved; torch calls this for ``to`` and ``cuda``."""
        super()._apply(fn, recurse)
        self._owned = None
        return self

    def table_gradient(self) -> Tensor:
        """Copy the gradient that waits for :meth:`adam_step`, shape [T, F]."""
        return self._gradient.clone()

    @torch.no_grad()
    def adam_step(self, lr: float, *, betas: tuple[float, float] = (0.9, 0.99), eps: float = 1e-15) -> None:
        """Step Adam on the numbers whose gradient is not zero, then clear the gradient.

        The other numbers keep their value and their moments, as in torch's SparseAdam; the bias correction counts all
        steps.

        Args:
            lr: Learning rate.
            betas: Decay rates of the two moments.
            eps: Added to the root of the second moment.
        """
        self._step += 1
        rate = lr / (1.0 - betas[0] ** self._step)
        unbias = 1.0 / math.sqrt(1.0 - betas[1] ** self._step)
        width = 1 if self.table.is_cuda else BLOCK * _BLOCKS * self.shape.features
        inputs = (width, rate, unbias, *betas, eps, self._marks)
        outputs = (self.table.data, self._gradient, self.exp_avg, self.exp_avg_sq)
        launch_ranges(_KERNELS[self.table.dtype].adam, -(-self.table.numel() // width), inputs, outputs)
        self._marks.zero_()
        torch.autograd.graph.increment_version(self.table)

    def get_extra_state(self) -> dict[str, int]:
        """Return the number of optimizer steps for ``state_dict``."""
        return {"step": self._step}

    def set_extra_state(self, state: dict[str, int]) -> None:
        """Take the number of optimizer steps from a ``state_dict``."""
        self._step = int(state["step"])
