"""Kernels of the blend shapes. Forward and backward read every number of the directions once, and little else.

At 5K vertices and 400 directions that is 24 MB per pass: memory bandwidth sets the time.
"""

from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels.bridge import launch, launch_ranges
from mgavatar.kernels.precision import Real, by_dtype

_BLOCK = 16384  # numbers per CPU item: sums stay in its cache, and directions are read in long pieces
_DIRECTIONS = 8  # directions per CPU item in the backward pass
_LANES = 64  # partial sums of a dot product, the same on a CPU (vector lanes) and on CUDA (threads)

# Four directions per pass: each sum is loaded and stored once for four products. Directions whose coefficient is
# exactly zero are not read, so they are gathered into groups of four first.
_BLEND_SNIPPET = """
    const long long n = out.shape[0];
    const int n_dirs = coeffs.shape[0];
    const long long begin = (long long)item * width;
    const long long count = (begin + width < n ? begin + width : n) - begin;
    const REAL* base = start.data + begin;
    REAL* __restrict__ sums = out.data + begin;
    for (long long i = 0; i < count; ++i)
        sums[i] = base[i];
    const REAL* d[4];
    REAL c[4];
    int filled = 0;
    for (int k = 0; k < n_dirs; ++k) {
        if (coeffs.data[k] != REAL(0)) {
            c[filled] = coeffs.data[k];
            d[filled] = dirs.data + k * n + begin;
            ++filled;
        }
        if (filled == 4) {
            const REAL c0 = c[0], c1 = c[1], c2 = c[2], c3 = c[3];
            const REAL *__restrict__ d0 = d[0], *__restrict__ d1 = d[1];
            const REAL *__restrict__ d2 = d[2], *__restrict__ d3 = d[3];
            for (long long i = 0; i < count; ++i)
                sums[i] += (c0 * d0[i] + c1 * d1[i]) + (c2 * d2[i] + c3 * d3[i]);
            filled = 0;
        }
    }
    for (int j = 0; j < filled; ++j)
        for (long long i = 0; i < count; ++i)
            sums[i] += c[j] * d[j][i];
"""

# Lane l of direction k adds up elements l, l + 64, ...: neighbouring lanes read neighbouring numbers on both devices.
_DOT_SNIPPET = """
    const long long n = grad.shape[0];
    const REAL* d = dirs.data + (long long)k * n;
    const REAL* g = grad.data;
    REAL* sums = partial.data + (long long)k * LANES;
    if (width == 1) {
        REAL sum = 0;
        for (long long i = lane; i < n; i += LANES)
            sum += d[i] * g[i];
        sums[lane] = sum;
        return;
    }
#if !defined(__CUDACC__)
    // An item owns a few whole directions; each piece of the gradient serves all of them while it is in the cache.
    enum { PART = LANES / 4, PIECE = 4096 };
    typedef REAL part __attribute__((ext_vector_type(PART), aligned(sizeof(REAL))));
    const int count = partial.shape[0] - k < width / LANES ? partial.shape[0] - k : width / LANES;
    for (int l = 0; l < count * LANES; ++l)
        sums[l] = 0;
    const long long whole = n - n % LANES;
    for (long long from = 0; from < whole; from += PIECE) {
        const long long to = from + PIECE < whole ? from + PIECE : whole;
        for (int m = 0; m < count; ++m) {
            const REAL* e = d + m * n;
            part* s = (part*)(sums + m * LANES);
            part s0 = s[0], s1 = s[1], s2 = s[2], s3 = s[3];
            for (long long i = from; i < to; i += LANES) {
                // The hardware's prefetcher starts anew at each page of each direction: asking ahead by hand is 1.3 to
                // 1.8 times faster.
                for (int ahead = 0; ahead < LANES; ahead += PART)
                    __builtin_prefetch(e + i + 1024 + ahead);
                s0 += *(const part*)(e + i) * *(const part*)(g + i);
                s1 += *(const part*)(e + i + PART) * *(const part*)(g + i + PART);
                s2 += *(const part*)(e + i + 2 * PART) * *(const part*)(g + i + 2 * PART);
                s3 += *(const part*)(e + i + 3 * PART) * *(const part*)(g + i + 3 * PART);
            }
            s[0] = s0;
            s[1] = s1;
            s[2] = s2;
            s[3] = s3;
        }
    }
    for (int m = 0; m < count; ++m)
        for (long long i = whole; i < n; ++i)
            sums[m * LANES + i - whole] += d[m * n + i] * g[i];
#endif
"""


def _kernels(real: Real) -> SimpleNamespace:
    scalar = real.scalar
    module = f"{__name__}.{real.name}"

    def native(snippet: str) -> Any:
        return wp.func_native(snippet.replace("REAL", real.c_name).replace("LANES", str(_LANES)))

    @native(_BLEND_SNIPPET)
    def add_directions(
        item: int,
        width: int,
        dirs: wp.array2d[scalar],
        coeffs: wp.array[scalar],
        start: wp.array[scalar],
        out: wp.array[scalar],
    ) -> None: ...

    @native(_DOT_SNIPPET)
    def dot_direction(
        k: int,
        lane: int,
        width: int,
        dirs: wp.array2d[scalar],
        grad: wp.array[scalar],
        partial: wp.array2d[scalar],
    ) -> None: ...

    @wp.kernel(module=module, enable_backward=False)
    def blend_kernel(
        # In:
        first: int,
        width: int,  # numbers per item
        dirs: wp.array2d[scalar],  # [K, 3V]
        coeffs: wp.array[scalar],  # [K]
        start: wp.array[scalar],  # [3V]
        # Out:
        out: wp.array[scalar],  # [3V]
    ) -> None:
        add_directions(first + wp.tid(), width, dirs, coeffs, start, out)

    @wp.kernel(module=module, enable_backward=False)
    def blend_bwd_kernel(
        # In:
        first: int,
        width: int,  # lanes per item: 1, or those of a few directions
        dirs: wp.array2d[scalar],  # [K, 3V]
        grad: wp.array[scalar],  # [3V]
        # Out:
        partial: wp.array2d[scalar],  # [K, lanes]
    ) -> None:
        begin = (first + wp.tid()) * width
        dot_direction(begin // wp.static(_LANES), begin % wp.static(_LANES), width, dirs, grad, partial)

    @wp.kernel(module=module, enable_backward=False)
    def sum_kernel(
        # In:
        partial: wp.array2d[scalar],  # [M, N]
        # Out:
        out: wp.array[scalar],  # [M]
    ) -> None:
        m = wp.tid()
        total = scalar(0.0)
        for n in range(partial.shape[1]):
            total += partial[m, n]
        out[m] = total

    return SimpleNamespace(blend=blend_kernel, blend_bwd=blend_bwd_kernel, sum=sum_kernel)


_KERNELS = by_dtype(_kernels)


class BlendShapes(torch.autograd.Function):
    """A node of torch's graph: ``start + sum_k coeffs[k] dirs[k]``. ``lbs.blend_shapes`` checks its inputs."""

    @staticmethod
    def forward(ctx: Any, start: Tensor, dirs: Tensor, coeffs: Tensor) -> Tensor:
        """Add the directions [K, V, 3] to ``start`` [V, 3], each times its coefficient [K]."""
        ctx.save_for_backward(dirs)
        out = torch.empty_like(start, memory_format=torch.contiguous_format)
        width = 1 if start.is_cuda else _BLOCK
        n_items = -(-start.numel() // width)
        if n_items:
            inputs = (width, dirs.reshape(len(dirs), start.numel()), coeffs, start.reshape(-1))
            launch_ranges(_KERNELS[start.dtype].blend, n_items, inputs, (out.view(-1),), ranges_per_thread=1)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        """Return the gradients of ``start`` and ``coeffs`` from that of the output [V, 3]."""
        (dirs,) = ctx.saved_tensors
        if not ctx.needs_input_grad[2]:
            return grad, None, None
        kernels = _KERNELS[grad.dtype]
        n_dirs = len(dirs)
        partial = grad.new_zeros(n_dirs, _LANES)
        grad_coeffs = grad.new_zeros(n_dirs)
        width = 1 if grad.is_cuda else _DIRECTIONS * _LANES
        if dirs.numel():
            inputs = (width, dirs.reshape(n_dirs, -1), grad.reshape(-1))
            launch_ranges(kernels.blend_bwd, -(-n_dirs * _LANES // width), inputs, (partial,), ranges_per_thread=1)
            launch(kernels.sum, n_dirs, (partial,), (grad_coeffs,))
        return grad, None, grad_coeffs
