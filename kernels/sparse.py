"""Fixed sparse matrices applied to per-row values: gathers, averages and interpolations, whose adjoint is a gather too.

Subdivision, corners of faces, joint regression, the Laplacian and UV maps are all ``y = A x`` with an ``A`` that does
not change. The matrix keeps its transpose, so that the adjoint ``A^T g`` gathers rows as the forward pass does: no
atomic addition, and the same bits from run to run and for any number of threads.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse
import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels.bridge import launch_ranges
from mgavatar.kernels.precision import Real, by_dtype, pick

_LIMIT = 2**31 - 1  # indices are int32
_SEGMENT = 512  # entries per item; longer rows are added in two stages, for balance between threads and for accuracy

_ROW_SNIPPET = """
    const int begin = starts.data[row];
    const int end = starts.data[row + 1];
    REAL* y = out.data + (long long)row * channels;
    if (channels == 3) {
        REAL y0 = 0, y1 = 0, y2 = 0;
        for (int k = begin; k < end; ++k) {
            const REAL value = values.data[k];
            const REAL* source = x.data + (long long)cols.data[k] * 3;
            y0 += value * source[0];
            y1 += value * source[1];
            y2 += value * source[2];
        }
        y[0] = y0;
        y[1] = y1;
        y[2] = y2;
        return;
    }
    for (int c = 0; c < channels; ++c)
        y[c] = 0;
    for (int k = begin; k < end; ++k) {
        const REAL value = values.data[k];
        const REAL* source = x.data + (long long)cols.data[k] * channels;
        for (int c = 0; c < channels; ++c)
            y[c] += value * source[c];
    }
"""


def _kernels(real: Real) -> SimpleNamespace:
    scalar = real.scalar

    @wp.func_native(_ROW_SNIPPET.replace("REAL", real.c_name))
    def multiply_row(
        row: int,
        starts: wp.array[int],
        cols: wp.array[int],
        values: wp.array[scalar],
        x: wp.array2d[scalar],
        channels: int,
        out: wp.array2d[scalar],
    ) -> None: ...

    @wp.kernel(module=f"{__name__}.{real.name}", enable_backward=False)
    def multiply_kernel(
        # In:
        first: int,
        starts: wp.array[int],  # [M + 1]
        cols: wp.array[int],  # [E]
        values: wp.array[scalar],  # [E]
        x: wp.array2d[scalar],  # [N, C]
        # Out:
        out: wp.array2d[scalar],  # [M, C]
    ) -> None:
        multiply_row(first + wp.tid(), starts, cols, values, x, x.shape[1], out)

    return SimpleNamespace(multiply=multiply_kernel)


_KERNELS = by_dtype(_kernels)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Compressed rows: row i owns entries ``starts[i]`` to ``starts[i + 1]``."""

    starts: Tensor  # [M + 1] int32
    cols: Tensor  # [E] int32
    values: dict[torch.dtype, Tensor]  # [E] in both precisions

    @classmethod
    def of(cls, starts: np.ndarray, cols: np.ndarray, values: np.ndarray) -> "_Rows":
        numbers = torch.from_numpy(values.astype(np.float64))
        return cls(
            torch.from_numpy(starts.astype(np.int32)),
            torch.from_numpy(cols.astype(np.int32)),
            {torch.float32: numbers.float(), torch.float64: numbers},
        )

    def to(self, device: torch.device | str) -> "_Rows":
        values = {dtype: tensor.to(device) for dtype, tensor in self.values.items()}
        return _Rows(self.starts.to(device), self.cols.to(device), values)

    def multiply(self, x: Tensor) -> Tensor:
        n_rows = len(self.starts) - 1
        out = x.new_empty(n_rows, x.shape[1])
        if out.numel():
            inputs = (self.starts, self.cols, self.values[x.dtype], x)
            launch_ranges(pick(_KERNELS, x=x).multiply, n_rows, inputs, (out,), ranges_per_thread=1)
        return out


def _stages(csr: scipy.sparse.csr_array) -> tuple[_Rows, ...]:
    """Factor the matrix into one or two, such that no row of the first is very long.

    A long row is cut into segments. The first factor adds up each segment; the second one adds up a row's segments.
    """
    starts, cols, values = csr.indptr.astype(np.int64), csr.indices, csr.data
    lengths = np.diff(starts)
    if lengths.max(initial=0) <= 2 * _SEGMENT:
        return (_Rows.of(starts, cols, values),)
    counts = -(-lengths // _SEGMENT)
    row_starts = np.concatenate([[0], np.cumsum(counts)])
    nth = np.arange(row_starts[-1]) - np.repeat(row_starts[:-1], counts)  # number of each segment within its row
    # Entries stay in place: a segment starts a multiple of _SEGMENT after its row and ends where the next one starts.
    segment_starts = np.append(np.repeat(starts[:-1], counts) + nth * _SEGMENT, starts[-1])
    n_segments = len(nth)
    return _Rows.of(segment_starts, cols, values), _Rows.of(row_starts, np.arange(n_segments), np.ones(n_segments))


class SparseMatrix:
    """A fixed matrix, kept as compressed rows of itself and of its transpose.

    Attributes:
        shape: Rows M and columns N.
        device: Device of the values that it can be applied to.
    """

    def __init__(self, shape: tuple[int, int], stages: Sequence[_Rows], transposed: Sequence[_Rows]) -> None:
        """Take factors of the matrix and of its transpose; use :meth:`from_coo` instead."""
        self.shape = shape
        self._stages = tuple(stages)
        self._transposed = tuple(transposed)

    @classmethod
    def from_coo(cls, rows: Tensor, cols: Tensor, values: Tensor, shape: tuple[int, int]) -> "SparseMatrix":
        """Build a matrix from its entries; those at the same place are summed, in float64.

        Args:
            rows: Row of each entry, shape [E], any integer type.
            cols: Column of each entry, shape [E], any integer type.
            values: Value of each entry, shape [E], float32 or float64.
            shape: Rows M and columns N.

        Returns:
            The matrix, on the device of ``values``.

        Raises:
            ValueError: If an index is out of range, the lengths differ, or a size does not fit 32 bits.
        """
        device = values.device
        r, c, v = (t.detach().cpu().numpy() for t in (rows, cols, values))
        _check_entries(r, c, v, shape)
        coo = scipy.sparse.coo_array((v.astype(np.float64), (r.astype(np.int32), c.astype(np.int32))), shape=shape)
        csr = coo.tocsr()
        csr.sum_duplicates()
        return cls(shape, _stages(csr), _stages(csr.T.tocsr())).to(device)

    @property
    def T(self) -> "SparseMatrix":
        """Return the transpose, without a copy."""
        return SparseMatrix((self.shape[1], self.shape[0]), self._transposed, self._stages)

    @property
    def device(self) -> torch.device:
        """Return the device of the values that it can be applied to."""
        return self._stages[0].cols.device

    def to(self, device: torch.device | str) -> "SparseMatrix":
        """Return the same matrix on another device."""
        stages = [[rows.to(device) for rows in stages] for stages in (self._stages, self._transposed)]
        return SparseMatrix(self.shape, *stages)

    def multiply(self, x: Tensor) -> Tensor:
        """Compute ``A x`` for x [N, C] outside torch's graph, shape [M, C]."""
        for rows in self._stages:
            x = rows.multiply(x)
        return x


def _check_entries(rows: np.ndarray, cols: np.ndarray, values: np.ndarray, shape: tuple[int, int]) -> None:
    if not len(rows) == len(cols) == len(values):
        raise ValueError(f"a sparse matrix got {len(rows)} rows, {len(cols)} columns and {len(values)} values")
    if max(len(values), *shape) > _LIMIT:
        raise ValueError(f"a sparse matrix of shape {shape} with {len(values)} entries does not fit 32-bit indices")
    for name, index, size in (("row", rows, shape[0]), ("column", cols, shape[1])):
        if len(index) and not (index.min() >= 0 and index.max() < size):
            raise ValueError(f"{name} index {index.min()}..{index.max()} is outside a sparse matrix of shape {shape}")


class _SparseApply(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, matrix: SparseMatrix, x: Tensor) -> Tensor:
        ctx.matrix = matrix
        return matrix.multiply(x)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        return None, ctx.matrix.T.multiply(grad)


def sparse_apply(matrix: SparseMatrix, x: Tensor) -> Tensor:
    """Multiply per-row values by a fixed matrix: ``y = A x``. Differentiable in ``x``.

    Args:
        matrix: A, of shape [M, N].
        x: Values, shape [N] or [N, ...], float32 or float64.

    Returns:
        Values of the same dtype, shape [M] or [M, ...].

    Raises:
        ValueError: If ``x`` has another number of rows than the matrix has columns, dtype or device.
    """
    if x.ndim == 0 or len(x) != matrix.shape[1]:
        raise ValueError(f"a sparse matrix of shape {matrix.shape} was applied to values of shape {tuple(x.shape)}")
    if x.device != matrix.device:
        raise ValueError(f"a sparse matrix on {matrix.device} was applied to values on {x.device}")
    pick(_KERNELS, x=x)
    out = _SparseApply.apply(matrix, x.reshape(len(x), math.prod(x.shape[1:])))
    return out.reshape(matrix.shape[0], *x.shape[1:])
