"""Multiresolution hash features of points in the unit cube: kernels, and the op with an ordinary gradient.

L grids of growing resolution hold F numbers at each vertex; a level whose vertices fit its table is stored densely, a
finer one shares entries through a hash of the vertex. A point interpolates the eight vertices of its cell on each
level; the levels are concatenated.
"""

from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels.bridge import launch, launch_ranges
from mgavatar.kernels.precision import Real, by_dtype, pick

BLOCK = 64  # entries that share one mark "has a gradient"; no block spans two levels
_POINTS = 512  # points per CPU item in the forward pass
_FIXED_BITS = 60  # bits of the integers that add up gradients on CUDA

# Cells and weights of TILE points on one level: vectors on a CPU, one point per thread on CUDA.
# x is a double: in float32, p * resolution keeps no digits of the fraction on fine levels.
# `p > 0 ? ... : 0` is false for NaN, so NaN becomes 0 and no index leaves the table.
# Corner bits: 1 for x, 2 for y, 4 for z. A dense level numbers its vertices row by row; a hashed level mixes the
# coordinates with two large odd factors (Mueller et al. 2022) and keeps the low bits. Both are one formula with other
# steps, chosen per level, so that the inner loop has no branch.
_LOCATE = """
    const int resolution = levels.data[level * 3];
    const int n_entries = levels.data[level * 3 + 2];
    const unsigned side = (unsigned)resolution + 1u;
    const bool dense = (long long)side * side * side <= n_entries;
    const unsigned step_y = dense ? side : 2654435761u;
    const unsigned step_z = dense ? side * side : 805459861u;
    const unsigned mask = dense ? 0xffffffffu : (unsigned)n_entries - 1u;
    const long long first_value = (long long)levels.data[level * 3 + 1] * FEATURES;
    const int stride = n_levels * FEATURES;
#ifdef __CUDA_ARCH__
    enum { TILE = 1 };
#else
    enum { TILE = 16 };
#endif
    unsigned entry[8][TILE];
    REAL part[3][2][TILE];
    bool inside[3][TILE];
    auto locate = [&](int from, int many) {
        unsigned cell[3][TILE];
        for (int axis = 0; axis < 3; ++axis)
            for (int i = 0; i < TILE; ++i) {
                const REAL p = points.data[(long long)(from + (i < many ? i : 0)) * 3 + axis];
                const double x = (p > REAL(0) ? (p < REAL(1) ? (double)p : 1.0) : 0.0) * resolution;
                const int whole = (int)x < resolution - 1 ? (int)x : resolution - 1;
                const double fraction = x - whole;
                cell[axis][i] = (unsigned)whole;
                part[axis][0][i] = (REAL)(1.0 - fraction);
                part[axis][1][i] = (REAL)fraction;
                inside[axis][i] = p >= REAL(0) && p <= REAL(1);
            }
        for (int corner = 0; corner < 8; ++corner)
            for (int i = 0; i < TILE; ++i) {
                const unsigned x = cell[0][i] + (corner & 1);
                const unsigned y = (cell[1][i] + (corner >> 1 & 1)) * step_y;
                const unsigned z = (cell[2][i] + (corner >> 2)) * step_z;
                entry[corner][i] = dense ? x + y + z : (x ^ y ^ z) & mask;
            }
    };
"""

_ENCODE = """
    const REAL* values = table.data + first_value;
    for (int from = begin; from < end; from += TILE) {
        const int many = end - from < TILE ? end - from : TILE;
        locate(from, many);
        REAL sums[FEATURES][TILE];
        for (int f = 0; f < FEATURES; ++f)
            for (int i = 0; i < TILE; ++i)
                sums[f][i] = 0;
        for (int corner = 0; corner < 8; ++corner)
            for (int i = 0; i < TILE; ++i) {
                const REAL w = part[0][corner & 1][i] * part[1][corner >> 1 & 1][i] * part[2][corner >> 2][i];
                for (int f = 0; f < FEATURES; ++f)
                    sums[f][i] += w * values[(long long)entry[corner][i] * FEATURES + f];
            }
        for (int i = 0; i < many; ++i)
            for (int f = 0; f < FEATURES; ++f)
                out.data[(long long)(from + i) * stride + level * FEATURES + f] = sums[f][i];
    }
"""

# Points without a gradient, such as those of Gaussians that no pixel saw, are skipped.
_TABLE_BWD = """
    for (int from = begin; from < end; from += TILE) {
        const int many = end - from < TILE ? end - from : TILE;
        locate(from, many);
        for (int i = 0; i < many; ++i) {
            const REAL* g = grad.data + (long long)(from + i) * stride + level * FEATURES;
            bool any = false;
            for (int f = 0; f < FEATURES; ++f)
                any = any || g[f] != REAL(0);
            if (!any)
                continue;
            for (int corner = 0; corner < 8; ++corner) {
                const REAL w = part[0][corner & 1][i] * part[1][corner >> 1 & 1][i] * part[2][corner >> 2][i];
                const long long value = first_value + (long long)entry[corner][i] * FEATURES;
                marks.data[value / (FEATURES * BLOCK)] = 1;
                for (int f = 0; f < FEATURES; ++f) {
                    ADD
                }
            }
        }
    }
"""

_ADD_REAL = "sums.data[value + f] += w * g[f];"

# Sums of integers do not depend on their order. On a CPU this form runs in one thread, for the tests.
_ADD_FIXED = """
                    const double scaled = (double)w * g[f] * scale.data[0];
                    const long long whole = (long long)(scaled + (scaled < 0.0 ? -0.5 : 0.5));
#ifdef __CUDA_ARCH__
                    atomicAdd((unsigned long long*)&sums.data[value + f], (unsigned long long)whole);
#else
                    sums.data[value + f] += whole;
#endif
"""

_POINTS_BWD = """
    const REAL* values = table.data + first_value;
    for (int from = begin; from < end; from += TILE) {
        const int many = end - from < TILE ? end - from : TILE;
        locate(from, many);
        REAL slope[3][TILE];
        for (int axis = 0; axis < 3; ++axis)
            for (int i = 0; i < TILE; ++i)
                slope[axis][i] = 0;
        for (int corner = 0; corner < 8; ++corner) {
            const int bx = corner & 1, by = corner >> 1 & 1, bz = corner >> 2;
            for (int i = 0; i < TILE; ++i) {
                const REAL* g = grad.data + (long long)(from + (i < many ? i : 0)) * stride + level * FEATURES;
                REAL along = 0;
                for (int f = 0; f < FEATURES; ++f)
                    along += g[f] * values[(long long)entry[corner][i] * FEATURES + f];
                slope[0][i] += (bx ? along : -along) * part[1][by][i] * part[2][bz][i];
                slope[1][i] += (by ? along : -along) * part[0][bx][i] * part[2][bz][i];
                slope[2][i] += (bz ? along : -along) * part[0][bx][i] * part[1][by][i];
            }
        }
        for (int axis = 0; axis < 3; ++axis)
            for (int i = 0; i < many; ++i)
                if (inside[axis][i])
                    grad_points.data[(long long)(from + i) * 3 + axis] += slope[axis][i] * REAL(resolution);
    }
"""


def _kernels(real: Real, features: int) -> SimpleNamespace:
    scalar = real.scalar
    module = f"{__name__}.f{features}.{real.name}"
    words = {"FEATURES": str(features), "BLOCK": str(BLOCK), "REAL": real.c_name}

    def native(snippet: str) -> Any:
        for word, meaning in words.items():
            snippet = snippet.replace(word, meaning)
        return wp.func_native(snippet)

    @native(_LOCATE + _ENCODE)
    def encode_range(
        level: int,
        n_levels: int,
        begin: int,
        end: int,
        points: wp.array2d[scalar],
        table: wp.array2d[scalar],
        levels: wp.array2d[int],
        out: wp.array2d[scalar],
    ) -> None: ...

    @native(_LOCATE + _TABLE_BWD.replace("ADD", _ADD_REAL))
    def add_table_gradient(
        level: int,
        n_levels: int,
        begin: int,
        end: int,
        points: wp.array2d[scalar],
        grad: wp.array2d[scalar],
        levels: wp.array2d[int],
        sums: wp.array2d[scalar],
        marks: wp.array[wp.uint8],
    ) -> None: ...

    @native(_LOCATE + _TABLE_BWD.replace("ADD", _ADD_FIXED))
    def add_fixed_gradient(
        level: int,
        n_levels: int,
        begin: int,
        end: int,
        points: wp.array2d[scalar],
        grad: wp.array2d[scalar],
        scale: wp.array[wp.float64],
        levels: wp.array2d[int],
        sums: wp.array2d[wp.int64],
        marks: wp.array[wp.uint8],
    ) -> None: ...

    @native(_LOCATE + _POINTS_BWD)
    def add_point_gradient(
        level: int,
        n_levels: int,
        begin: int,
        end: int,
        points: wp.array2d[scalar],
        table: wp.array2d[scalar],
        grad: wp.array2d[scalar],
        levels: wp.array2d[int],
        grad_points: wp.array2d[scalar],
    ) -> None: ...

    @wp.kernel(module=module, enable_backward=False)
    def encode_kernel(
        # In:
        first: int,
        width: int,  # points per item, on one level
        points: wp.array2d[scalar],  # [N, 3]
        table: wp.array2d[scalar],  # [T, F]
        levels: wp.array2d[int],  # [L, 3]
        # Out:
        out: wp.array2d[scalar],  # [N, L F]
    ) -> None:
        n = points.shape[0]
        n_ranges = (n + width - 1) // width
        item = first + wp.tid()
        begin = item % n_ranges * width
        encode_range(item // n_ranges, levels.shape[0], begin, wp.min(begin + width, n), points, table, levels, out)

    @wp.kernel(module=module, enable_backward=False)
    def table_bwd_kernel(
        # In:
        first: int,
        points: wp.array2d[scalar],  # [N, 3]
        grad: wp.array2d[scalar],  # [N, L F]
        levels: wp.array2d[int],  # [L, 3]
        # Out:
        sums: wp.array2d[scalar],  # [T, F] added to; an item owns one level
        marks: wp.array[wp.uint8],  # [T / block]
    ) -> None:
        level = first + wp.tid()
        add_table_gradient(level, levels.shape[0], 0, points.shape[0], points, grad, levels, sums, marks)

    @wp.kernel(module=module, enable_backward=False)
    def table_fixed_bwd_kernel(
        # In:
        points: wp.array2d[scalar],  # [N, 3]
        grad: wp.array2d[scalar],  # [N, L F]
        scale: wp.array[wp.float64],  # [1]
        levels: wp.array2d[int],  # [L, 3]
        # Out:
        sums: wp.array2d[wp.int64],  # [T, F] added to, by all points at once
        marks: wp.array[wp.uint8],  # [T / block]
    ) -> None:
        level, n = wp.tid()
        add_fixed_gradient(level, levels.shape[0], n, n + 1, points, grad, scale, levels, sums, marks)

    @wp.kernel(module=module, enable_backward=False)
    def from_fixed_kernel(
        # In:
        scale: wp.array[wp.float64],  # [1]
        marks: wp.array[wp.uint8],  # [T / block]
        # Out:
        fixed: wp.array2d[wp.int64],  # [T, F] read, then left at zero
        sums: wp.array2d[scalar],  # [T, F] added to
    ) -> None:
        t, f = wp.tid()
        if marks[t // wp.static(BLOCK)] != wp.uint8(0):
            sums[t, f] = sums[t, f] + scalar(wp.float64(fixed[t, f]) / scale[0])
            fixed[t, f] = wp.int64(0)

    @wp.kernel(module=module, enable_backward=False)
    def points_bwd_kernel(
        # In:
        first: int,
        width: int,  # points per item, on all levels
        points: wp.array2d[scalar],  # [N, 3]
        table: wp.array2d[scalar],  # [T, F]
        grad: wp.array2d[scalar],  # [N, L F]
        levels: wp.array2d[int],  # [L, 3]
        # Out:
        grad_points: wp.array2d[scalar],  # [N, 3] zero at first, added to level by level
    ) -> None:
        begin = (first + wp.tid()) * width
        end = wp.min(begin + width, points.shape[0])
        n_levels = levels.shape[0]
        for level in range(n_levels):
            add_point_gradient(level, n_levels, begin, end, points, table, grad, levels, grad_points)

    return SimpleNamespace(
        encode=encode_kernel,
        table_bwd=table_bwd_kernel,
        table_fixed_bwd=table_fixed_bwd_kernel,
        from_fixed=from_fixed_kernel,
        points_bwd=points_bwd_kernel,
    )


@lru_cache
def kernels_for(features: int) -> Any:
    """Return the kernels of a table with ``features`` numbers per entry, by dtype."""
    return by_dtype(lambda real: _kernels(real, features))


kernels_for(2)  # made on import, so that they can be compiled ahead of time


class TableGradient:
    """The gradient of a table, with a mark on each block of entries that it touches.

    Attributes:
        values: Gradient, shape [T, F].
        marks: 1 for each block of ``BLOCK`` entries that has a gradient, shape [T / BLOCK], uint8.
    """

    def __init__(self, values: Tensor, marks: Tensor) -> None:
        self.values = values
        self.marks = marks
        self._fixed: Tensor | None = None

    @classmethod
    def like(cls, table: Tensor) -> "TableGradient":
        """Return a zero gradient of ``table`` [T, F]."""
        marks = torch.zeros(-(-len(table) // BLOCK), dtype=torch.uint8, device=table.device)
        return cls(torch.zeros_like(table), marks)

    def add(self, points: Tensor, grad: Tensor, levels: Tensor) -> None:
        """Add the gradient of one forward pass.

        On a CPU a thread owns a level and walks the points in order; CUDA adds integers with atomics. Both give the
        same bits on every run.

        Args:
            points: Points of the forward pass, shape [N, 3].
            grad: Gradient of its features, shape [N, L F].
            levels: ``HashGridShape.table_levels``, shape [L, 3].
        """
        if not len(points):
            return
        if self.values.is_cuda:
            self.add_fixed(points, grad, levels)
            return
        kernels = kernels_for(self.values.shape[1])[self.values.dtype]
        launch_ranges(kernels.table_bwd, len(levels), (points, grad, levels), (self.values, self.marks))

    def add_fixed(self, points: Tensor, grad: Tensor, levels: Tensor) -> None:
        """Add as :meth:`add` does, in fixed point; its unit is the smallest power of two that cannot overflow."""
        if self._fixed is None:
            self._fixed = torch.zeros_like(self.values, dtype=torch.int64)
        kernels = kernels_for(self.values.shape[1])[self.values.dtype]
        largest = (grad.abs().amax().double() * len(points)).clamp(min=1e-30)
        scale = torch.exp2(torch.floor(_FIXED_BITS - torch.log2(largest))).reshape(1)
        outputs = (self._fixed, self.marks)
        launch(kernels.table_fixed_bwd, (len(levels), len(points)), (points, grad, scale, levels), outputs)
        launch(kernels.from_fixed, tuple(self.values.shape), (scale, self.marks, self._fixed), (self.values,))


class HashEncode(torch.autograd.Function):
    """A node of torch's graph: points to features. :func:`check_inputs` checks what goes in."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, levels: Tensor, owned: TableGradient | None) -> Tensor:
        """Return features [N, L F]. With ``owned``, the table's gradient goes there instead of to torch."""
        ctx.save_for_backward(points, table, levels)
        ctx.owned = owned
        out = points.new_empty(len(points), len(levels) * table.shape[1])
        if len(points):
            width = 1 if points.is_cuda else _POINTS
            n_items = len(levels) * -(-len(points) // width)
            kernels = kernels_for(table.shape[1])[table.dtype]
            launch_ranges(kernels.encode, n_items, (width, points, table, levels), (out,))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        """Return the gradients of points [N, 3] and table [T, F] from that of the features [N, L F]."""
        points, table, levels = ctx.saved_tensors
        grad_points, grad_table = None, None
        if ctx.needs_input_grad[0]:
            grad_points = torch.zeros_like(points, memory_format=torch.contiguous_format)
            if len(points):
                width = 1 if points.is_cuda else _POINTS
                inputs = (width, points, table, grad, levels)
                kernels = kernels_for(table.shape[1])[table.dtype]
                launch_ranges(kernels.points_bwd, -(-len(points) // width), inputs, (grad_points,))
        if ctx.needs_input_grad[1]:
            sums = ctx.owned or TableGradient.like(table)
            sums.add(points, grad, levels)
            grad_table = None if ctx.owned else sums.values
        return grad_points, grad_table, None, None


def hash_encode(points: Tensor, table: Tensor, levels: Tensor) -> Tensor:
    """Encode points as features, with an ordinary gradient of the whole table; ``HashGrid`` has a cheaper one.

    Differentiable in ``points`` and ``table``.

    Args:
        points: Points, clamped to the unit cube, shape [N, 3], float32 or float64.
        table: Entries of all levels, shape [T, F].
        levels: ``HashGridShape.table_levels``, shape [L, 3], int32, on the device of ``table``.

    Returns:
        Features, level by level, shape [N, L F].

    Raises:
        ValueError: If shapes, dtypes or devices do not agree.
    """
    check_inputs(points, table, levels)
    return HashEncode.apply(points, table, levels, None)


def check_inputs(points: Tensor, table: Tensor, levels: Tensor) -> None:
    """Refuse points and tables that do not fit each other.

    Raises:
        ValueError: If shapes, dtypes or devices do not agree.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape [N, 3], got {tuple(points.shape)}")
    last = levels[-1].tolist() if levels.ndim == 2 and levels.shape[1:] == (3,) and not levels.is_cuda else None
    if last is not None and (table.ndim != 2 or last[1] + last[2] > len(table)):
        raise ValueError(f"a table of shape {tuple(table.shape)} is too small for {last[1] + last[2]} entries")
    pick(kernels_for(table.shape[1]), table=table, points=points)
