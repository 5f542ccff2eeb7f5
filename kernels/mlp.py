"""Small fully connected networks over many points on a CPU: linear layers with ReLU between them, fused.

A tile of points goes through all layers while its numbers are in the cache. All three products of a layer (values,
gradient of the inputs, gradient of the weights) are one loop that keeps eight rows by two vectors of sums in registers.
Nothing is stored for the backward pass: evaluating a tile again costs less than writing and reading its hidden layers.
The backward pass skips points whose gradient is zero, such as those of Gaussians that no pixel saw. CUDA, and networks
wider than a tile, use torch's own layers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from mgavatar.kernels import bridge

wp.set_module_options({"enable_backward": False})

WIDEST = 256
"""Largest number of channels per layer that a tile holds."""

WIDEST_TOGETHER = 1024
"""Largest number of input channels of all layers together that a tile holds."""

_PAD = 16  # rows of weights and of a tile are padded to so many numbers
_POINTS = 64  # points per tile
_ITEMS = 16  # work items, each with sums of its own: results do not depend on the number of threads

_COMMON = """
#if defined(__AVX512F__)
    enum { LANES = 16 };
#else
    enum { LANES = 8 };
#endif
    enum { P = %d, WIDE = %d, TOGETHER = %d, ROWS = 8, PAD = %d };
    typedef float vf __attribute__((ext_vector_type(LANES), aligned(4)));
    auto fma = [](vf a, vf b, vf c) -> vf {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
        return __builtin_elementwise_fma(a, b, c);
#else
        return a * b + c;
#endif
    };
    auto padded = [](int n) -> int { return (n + PAD - 1) / PAD * PAD; };
    auto whole = [](int n) -> int { return (n + ROWS - 1) / ROWS * ROWS; };
    // C[i][j] = start + sum over k of A[i * si + k * sk] B[k][j]; m is a multiple of ROWS, n of PAD. The sums start at
    // C itself, or at one row of numbers, or at zero.
    auto product = [fma](const float* A, int si, int sk, const float* B, int ldb, float* C, int ldc, int m, int n,
                         int depth, const float* row, bool add) {
        for (int j = 0; j < n; j += 2 * LANES) {
            const bool alone = j + LANES >= n;
            for (int i = 0; i < m; i += ROWS) {
                vf left[ROWS], right[ROWS];
                #pragma clang loop unroll(full)
                for (int r = 0; r < ROWS; ++r) {
                    const float* from = add ? C + (i + r) * ldc + j : row + j;
                    left[r] = add || row ? *(const vf*)from : (vf)0.0f;
                    right[r] = (add || row) && !alone ? *(const vf*)(from + LANES) : (vf)0.0f;
                }
                const float* a = A + i * si;
                if (alone) {
                    for (int k = 0; k < depth; ++k) {
                        const vf b = *(const vf*)(B + k * ldb + j);
                        #pragma clang loop unroll(full)
                        for (int r = 0; r < ROWS; ++r) left[r] = fma((vf)a[r * si + k * sk], b, left[r]);
                    }
                } else {
                    for (int k = 0; k < depth; ++k) {
                        const vf b0 = *(const vf*)(B + k * ldb + j), b1 = *(const vf*)(B + k * ldb + j + LANES);
                        #pragma clang loop unroll(full)
                        for (int r = 0; r < ROWS; ++r) {
                            const vf x = (vf)a[r * si + k * sk];
                            left[r] = fma(x, b0, left[r]);
                            right[r] = fma(x, b1, right[r]);
                        }
                    }
                }
                #pragma clang loop unroll(full)
                for (int r = 0; r < ROWS; ++r) {
                    *(vf*)(C + (i + r) * ldc + j) = left[r];
                    if (!alone) *(vf*)(C + (i + r) * ldc + j + LANES) = right[r];
                }
            }
        }
    };
    const int n_layers = layers.shape[0], n_points = first_part.shape[0];
    const int c0 = first_part.shape[1], c1 = second_part.shape[1];
    const int each = (n_points + n_items - 1) / n_items, begin = item * each;
    const int end = begin + each < n_points ? begin + each : n_points;
    // The inputs of a tile's points, one part after the other, with zeros behind them.
    auto load = [&](float* to, const int* points, int many) {
        const int width = padded(c0 + c1);
        for (int p = 0; p < many; ++p, to += width) {
            const float *a = first_part.data + (long long)points[p] * c0;
            const float *b = second_part.data + (long long)points[p] * c1;
            for (int c = 0; c < c0; ++c) to[c] = a[c];
            for (int c = 0; c < c1; ++c) to[c0 + c] = b[c];
            for (int c = c0 + c1; c < width; ++c) to[c] = 0.0f;
        }
        for (int c = 0; c < whole(many) * width - many * width; ++c) to[c] = 0.0f;
    };
    // y = W x + b, then ReLU but for the last layer.
    auto evaluate = [&](int l, const float* x, float* y, int many) {
        const int n_in = layers.data[4 * l], n_out = layers.data[4 * l + 1], width = padded(n_out);
        product(x, padded(n_in), 1, transposed.data + layers.data[4 * l + 2], width, y, width, whole(many), width, n_in,
                biases.data + layers.data[4 * l + 3], false);
        if (l + 1 == n_layers) return;
        for (int i = 0; i < whole(many) * width; i += LANES) {
            const vf v = *(const vf*)(y + i);
            *(vf*)(y + i) = v < 0.0f ? (vf)0.0f : v;  // NaN stays NaN
        }
    };
""" % (_POINTS, WIDEST, WIDEST_TOGETHER, _PAD)

_FORWARD = (
    "#if !defined(__CUDACC__)\n"
    + _COMMON
    + """
    alignas(64) float one[P * WIDE], two[P * WIDE];
    int points[P];
    for (int from = begin; from < end; from += P) {
        const int many = end - from < P ? end - from : P;
        for (int p = 0; p < many; ++p) points[p] = from + p;
        float *x = one, *y = two;
        load(x, points, many);
        for (int l = 0; l < n_layers; ++l) {
            evaluate(l, x, y, many);
            float* other = x;
            x = y;
            y = other;
        }
        const int n_last = out.shape[1], width = padded(n_last);
        for (int p = 0; p < many; ++p)
            for (int c = 0; c < n_last; ++c)
                out.data[(long long)(from + p) * n_last + c] = x[p * width + c];
    }
#endif
"""
)

_BACKWARD = (
    "#if !defined(__CUDACC__)\n"
    + _COMMON
    + """
    alignas(64) float values[P * TOGETHER], one[P * WIDE], two[P * WIDE];
    int points[P];
    float* v_weights = weight_sums.data + (long long)item * weight_sums.shape[1];
    float* v_biases = bias_sums.data + (long long)item * bias_sums.shape[1];
    for (int i = 0; i < weight_sums.shape[1]; ++i) v_weights[i] = 0.0f;
    for (int i = 0; i < bias_sums.shape[1]; ++i) v_biases[i] = 0.0f;
    const int n_last = v_out.shape[1];
    for (int from = begin; from < end;) {
        int many = 0;
        for (; many < P && from < end; ++from) {
            bool any = false;
            for (int c = 0; c < n_last; ++c) any = any || v_out.data[(long long)from * n_last + c] != 0.0f;
            if (any) points[many++] = from;
        }
        if (many == 0) break;
        float* x = values;
        load(x, points, many);
        for (int l = 0; l + 1 < n_layers; ++l) {
            float* y = x + P * padded(layers.data[4 * l]);
            evaluate(l, x, y, many);
            x = y;
        }
        float *dy = one, *dx = two;
        for (int p = 0; p < whole(many); ++p)
            for (int c = 0; c < padded(n_last); ++c)
                dy[p * padded(n_last) + c] =
                    p < many && c < n_last ? v_out.data[(long long)points[p] * n_last + c] : 0.0f;
        for (int l = n_layers - 1; l >= 0; --l) {
            const int n_in = layers.data[4 * l], n_out = layers.data[4 * l + 1];
            const int ld_in = padded(n_in), ld_out = padded(n_out);
            product(dy, 1, ld_out, x, ld_in, v_weights + layers.data[4 * l + 2], ld_in, whole(n_out),
                    ld_in, many, nullptr, true);
            float* sums = v_biases + layers.data[4 * l + 3];
            for (int c = 0; c < ld_out; c += LANES) {
                vf sum = 0.0f;
                for (int p = 0; p < many; ++p) sum += *(const vf*)(dy + p * ld_out + c);
                *(vf*)(sums + c) += sum;
            }
            if (l == 0 && !wants_points) break;
            product(dy, ld_out, 1, weights.data + layers.data[4 * l + 2], ld_in, dx, ld_in, whole(many), ld_in, n_out,
                    nullptr, false);
            if (l == 0) break;
            for (int i = 0; i < whole(many) * ld_in; i += LANES)
                *(vf*)(dx + i) = *(const vf*)(x + i) <= 0.0f ? (vf)0.0f : *(const vf*)(dx + i);
            x -= P * padded(layers.data[4 * l - 4]);
            float* other = dy;
            dy = dx;
            dx = other;
        }
        const int width = padded(c0 + c1);
        for (int p = 0; wants_points && p < many; ++p) {
            for (int c = 0; c < c0; ++c) v_first.data[(long long)points[p] * c0 + c] = dx[p * width + c];
            for (int c = 0; c < c1; ++c) v_second.data[(long long)points[p] * c1 + c] = dx[p * width + c0 + c];
        }
    }
#endif
"""
)


@wp.func_native(_FORWARD)
def _evaluate_range(
    item: int, n_items: int, first_part: wp.array2d[wp.float32], second_part: wp.array2d[wp.float32],
    layers: wp.array2d[int], transposed: wp.array[wp.float32], biases: wp.array[wp.float32],
    out: wp.array2d[wp.float32],
): ...  # fmt: skip


@wp.func_native(_BACKWARD)
def _differentiate_range(
    item: int, n_items: int, wants_points: int, first_part: wp.array2d[wp.float32],
    second_part: wp.array2d[wp.float32], layers: wp.array2d[int], transposed: wp.array[wp.float32],
    biases: wp.array[wp.float32], weights: wp.array[wp.float32], v_out: wp.array2d[wp.float32],
    v_first: wp.array2d[wp.float32], v_second: wp.array2d[wp.float32], weight_sums: wp.array2d[wp.float32],
    bias_sums: wp.array2d[wp.float32],
): ...  # fmt: skip


@wp.kernel
def _mlp_kernel(
    # In:
    first: int,
    n_items: int,
    first_part: wp.array2d[wp.float32],  # [N, C0]
    second_part: wp.array2d[wp.float32],  # [N, C1]
    layers: wp.array2d[int],  # [L, 4] inputs, outputs, first weight, first bias
    transposed: wp.array[wp.float32],  # [W] all layers' weights by input, then by output, padded
    biases: wp.array[wp.float32],  # [K'] padded
    # Out:
    out: wp.array2d[wp.float32],  # [N, K]
):
    _evaluate_range(first + wp.tid(), n_items, first_part, second_part, layers, transposed, biases, out)


@wp.kernel
def _mlp_bwd_kernel(
    # In:
    first: int,
    n_items: int,
    wants_points: int,
    first_part: wp.array2d[wp.float32],  # [N, C0]
    second_part: wp.array2d[wp.float32],  # [N, C1]
    layers: wp.array2d[int],  # [L, 4]
    transposed: wp.array[wp.float32],  # [W] all layers' weights by input, then by output, padded
    biases: wp.array[wp.float32],  # [K'] padded
    weights: wp.array[wp.float32],  # [W] by output, then by input, padded
    v_out: wp.array2d[wp.float32],  # [N, K]
    # Out:
    v_first: wp.array2d[wp.float32],  # [N, C0], zero where v_out is
    v_second: wp.array2d[wp.float32],  # [N, C1]
    weight_sums: wp.array2d[wp.float32],  # [items, W] laid out as weights
    bias_sums: wp.array2d[wp.float32],  # [items, K'] laid out as biases
):
    _differentiate_range(
        first + wp.tid(), n_items, wants_points, first_part, second_part, layers, transposed, biases, weights,
        v_out, v_first, v_second, weight_sums, bias_sums,
    )  # fmt: skip


def _up(n: int) -> int:
    return -(-n // _PAD) * _PAD


def _pad(matrix: Tensor) -> Tensor:
    return functional.pad(matrix, (0, _up(matrix.shape[1]) - matrix.shape[1], 0, _up(len(matrix)) - len(matrix)))


def _table(weights: Sequence[Tensor]) -> Tensor:
    """Return each layer's inputs, outputs, first weight and first bias, as the kernels read them, shape [L, 4]."""
    rows, weight, bias = [], 0, 0
    for matrix in weights:
        n_out, n_in = matrix.shape
        rows.append((n_in, n_out, weight, bias))
        weight += _up(n_in) * _up(n_out)
        bias += _up(n_out)
    return torch.tensor(rows, dtype=torch.int32)


class _Mlp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, extra: Tensor, *parameters: Tensor) -> Tensor:
        weights, biases = parameters[0::2], parameters[1::2]
        ctx.layers = _table(weights)
        ctx.transposed = torch.cat([_pad(matrix.T).reshape(-1) for matrix in weights])
        ctx.biases = torch.cat([_pad(bias[None])[0, : _up(len(bias))] for bias in biases])
        out = x.new_empty(len(x), len(biases[-1]))
        inputs = (_ITEMS, x, extra, ctx.layers, ctx.transposed, ctx.biases)
        bridge.launch_ranges(_mlp_kernel, _ITEMS, inputs, (out,))
        ctx.save_for_backward(x, extra, *weights)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_out: Tensor) -> Any:
        x, extra, *weights = ctx.saved_tensors
        flat = torch.cat([_pad(matrix).reshape(-1) for matrix in weights])
        wants_points = any(ctx.needs_input_grad[:2])
        v_x = torch.zeros_like(x, memory_format=torch.contiguous_format)
        v_extra = torch.zeros_like(extra, memory_format=torch.contiguous_format)
        weight_sums = flat.new_empty(_ITEMS, len(flat))
        bias_sums = flat.new_empty(_ITEMS, len(ctx.biases))
        inputs = (_ITEMS, int(wants_points), x, extra, ctx.layers, ctx.transposed, ctx.biases, flat, v_out)
        bridge.launch_ranges(_mlp_bwd_kernel, _ITEMS, inputs, (v_x, v_extra, weight_sums, bias_sums))
        v_parameters = _unpadded(weights, ctx.layers, weight_sums.sum(0), bias_sums.sum(0))
        return (v_x if ctx.needs_input_grad[0] else None, v_extra if ctx.needs_input_grad[1] else None, *v_parameters)


def _unpadded(weights: Sequence[Tensor], layers: Tensor, v_weights: Tensor, v_biases: Tensor) -> list[Tensor]:
    """Cut the gradients of each layer's weight and bias out of the padded sums."""
    grads = []
    for n_in, n_out, weight, bias in layers.tolist():
        matrix = v_weights[weight : weight + _up(n_in) * _up(n_out)].view(_up(n_out), _up(n_in))
        grads += [matrix[:n_out, :n_in].contiguous(), v_biases[bias : bias + n_out].contiguous()]
    return grads


def mlp(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], *, extra: Tensor | None = None) -> Tensor:
    """Apply linear layers with ReLU between them to many points. Differentiable in all tensors.

    Args:
        x: Inputs, shape [N, C].
        weights: Weight of each layer, shape [outputs, inputs], as in ``torch.nn.Linear``.
        biases: Bias of each layer, shape [outputs].
        extra: More inputs, appended to those of ``x``, shape [N, C'].

    Returns:
        Outputs of the last layer, shape [N, K].

    Raises:
        ValueError: If shapes do not fit each other.
    """
    extra = x.new_empty(len(x), 0) if extra is None else extra
    _check(x, extra, weights, biases)
    if (
        x.device.type != "cpu"
        or not _fits(weights)
        or any(t.dtype != torch.float32 for t in (x, extra, *weights, *biases))
    ):
        return _plain(torch.cat([x, extra], 1), weights, biases)
    parameters = [tensor for pair in zip(weights, biases, strict=True) for tensor in pair]
    return _Mlp.apply(x, extra, *parameters)


def linear_layers(network: nn.Sequential) -> tuple[list[Tensor], list[Tensor]]:
    """List weights and biases of a network's linear layers for :func:`mlp`; the layers between them must be ReLU."""
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    return [layer.weight for layer in layers], [layer.bias for layer in layers]


def _fits(weights: Sequence[Tensor]) -> bool:
    """Return True if a tile holds the network."""
    together = sum(_up(matrix.shape[1]) for matrix in weights)
    return max(max(matrix.shape) for matrix in weights) <= WIDEST and together <= WIDEST_TOGETHER


def _plain(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = functional.relu(functional.linear(x, weight, bias))
    return functional.linear(x, weights[-1], biases[-1])


def _check(x: Tensor, extra: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
    if x.ndim != 2 or extra.ndim != 2 or len(x) != len(extra):
        raise ValueError(f"inputs must be [N, C] and [N, C'], got {tuple(x.shape)} and {tuple(extra.shape)}")
    if not weights or len(weights) != len(biases):
        raise ValueError(f"a network needs a weight and a bias a layer, got {len(weights)} and {len(biases)}")
    n_in = x.shape[1] + extra.shape[1]
    for weight, bias in zip(weights, biases, strict=True):
        if weight.ndim != 2 or weight.shape[1] != n_in or tuple(bias.shape) != (len(weight),):
            raise ValueError(f"a layer of {n_in} inputs has weight {tuple(weight.shape)} and bias {tuple(bias.shape)}")
        n_in = len(weight)
