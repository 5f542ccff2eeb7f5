"""Mean absolute error and SSIM in one pass on a CPU (Eq. 4): 11x11 Gaussian window, sigma 1.5, zero padding.

A work item is one tile of one channel: it is copied with its border into a local buffer, then filtered down the columns
and along the rows, sixteen pixels at a time. The adjoint filters three derivative maps; the window is symmetric, so it
is its own transpose. Several times faster than convolutions on a CPU; CUDA uses convolutions, see
``mgavatar/losses.py``.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels import bridge

wp.set_module_options({"enable_backward": False})

_WIDTH, _HEIGHT = 128, 16

_COMMON = """
    enum { LANES = 16, R = 5, TW = %d, TH = %d, STRIDE = TW + 2 * LANES };
    typedef float vf __attribute__((ext_vector_type(LANES), aligned(4)));
    typedef int vi __attribute__((ext_vector_type(LANES), aligned(4)));
    const float window[11] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                              0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
    const int columns = (width + TW - 1) / TW, rows = (height + TH - 1) / TH;
    const int channel = item / (columns * rows), tile = item %% (columns * rows);
    const int x0 = (tile %% columns) * TW, y0 = (tile / columns) * TH;
    const int nx = width - x0 < TW ? width - x0 : TW, ny = height - y0 < TH ? height - y0 : TH;
    const int plane = channel * width * height, all = 3 * width * height;
    vf lane;
    for (int i = 0; i < LANES; ++i) lane[i] = (float)i;
    auto along = [&](const float* p) -> vf {
        vf s = 0.0f;
        #pragma clang loop unroll(full)
        for (int k = 0; k < 11; ++k) s += window[k] * *(const vf*)(p + k);
        return s;
    };
    // Column i of a local buffer is pixel x0 + i - R; outside the image it is zero.
    auto load = [&](const float* source, float* to) {
        for (int j = 0; j < ny + 2 * R; ++j) {
            const int y = y0 + j - R;
            for (int i = 0; i < STRIDE; ++i) to[j * STRIDE + i] = 0.0f;
            if (y < 0 || y >= height) continue;
            const int first = x0 >= R ? 0 : R - x0;
            const int past = width - x0 + R < nx + 2 * R ? width - x0 + R : nx + 2 * R;
            for (int i = first; i < past; ++i) to[j * STRIDE + i] = source[plane + y * width + x0 + i - R];
        }
    };
""" % (_WIDTH, _HEIGHT)

_FORWARD = (
    "#if !defined(__CUDACC__)\n"
    + _COMMON
    + """
    float a[(TH + 2 * R) * STRIDE], b[(TH + 2 * R) * STRIDE];
    float down[5][STRIDE + LANES], row[3][TW];
    load(image.data, a);
    load(target.data, b);
    for (int m = 0; m < 5; ++m)
        for (int i = STRIDE; i < STRIDE + LANES; ++i) down[m][i] = 0.0f;
    vf total = 0.0f, absolute = 0.0f;
    for (int j = 0; j < ny; ++j) {
        for (int i = 0; i < nx + 2 * R; i += LANES) {
            vf s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, s3 = 0.0f, s4 = 0.0f;
            #pragma clang loop unroll(full)
            for (int k = 0; k < 11; ++k) {
                const vf x = *(const vf*)&a[(j + k) * STRIDE + i], y = *(const vf*)&b[(j + k) * STRIDE + i];
                const vf wx = window[k] * x, wy = window[k] * y;
                s0 += wx;
                s1 += wy;
                s2 += wx * x;
                s3 += wy * y;
                s4 += wx * y;
            }
            *(vf*)&down[0][i] = s0;
            *(vf*)&down[1][i] = s1;
            *(vf*)&down[2][i] = s2;
            *(vf*)&down[3][i] = s3;
            *(vf*)&down[4][i] = s4;
        }
        for (int i = 0; i < nx; i += LANES) {
            const vf mx = along(down[0] + i), my = along(down[1] + i);
            const vf xx = along(down[2] + i), yy = along(down[3] + i), xy = along(down[4] + i);
            const vf p = 2.0f * mx * my + 1e-4f, q = 2.0f * (xy - mx * my) + 9e-4f;
            const vf r = mx * mx + my * my + 1e-4f, s = (xx - mx * mx) + (yy - my * my) + 9e-4f;
            const vf rs = 1.0f / (r * s), value = p * q * rs;
            const vf by_xx = -value / s, by_xy = 2.0f * p * rs;
            const vf by_mu = 2.0f * (my * q * rs - value * mx / r) - by_xy * my - 2.0f * by_xx * mx;
            const vf d = *(const vf*)&a[(j + R) * STRIDE + i + R] - *(const vf*)&b[(j + R) * STRIDE + i + R];
            const vi inside = lane < (float)(nx - i);
            total += inside ? value : (vf)0.0f;
            absolute += inside ? __builtin_elementwise_abs(d) : (vf)0.0f;
            *(vf*)&row[0][i] = by_mu;
            *(vf*)&row[1][i] = by_xx;
            *(vf*)&row[2][i] = by_xy;
        }
        for (int m = 0; m < 3; ++m)
            __builtin_memcpy(&maps.data[m * all + plane + (y0 + j) * width + x0], row[m], nx * sizeof(float));
    }
    float sum = 0.0f, sum_absolute = 0.0f;
    for (int l = 0; l < LANES; ++l) {
        sum += total[l];
        sum_absolute += absolute[l];
    }
    sums.data[2 * item] = sum_absolute;
    sums.data[2 * item + 1] = sum;
#endif
"""
)

_BACKWARD = (
    "#if !defined(__CUDACC__)\n"
    + _COMMON
    + """
    float a[3][(TH + 2 * R) * STRIDE];
    float down[3][STRIDE + LANES], row[3][TW];
    for (int m = 0; m < 3; ++m) {
        load(maps.data + m * all, a[m]);
        for (int i = STRIDE; i < STRIDE + LANES; ++i) down[m][i] = 0.0f;
    }
    const float by_absolute = v_means.data[0] / (float)all, by_ssim = v_means.data[1] / (float)all;
    for (int j = 0; j < ny; ++j) {
        for (int i = 0; i < nx + 2 * R; i += LANES)
            for (int m = 0; m < 3; ++m) {
                vf s = 0.0f;
                #pragma clang loop unroll(full)
                for (int k = 0; k < 11; ++k) s += window[k] * *(const vf*)&a[m][(j + k) * STRIDE + i];
                *(vf*)&down[m][i] = s;
            }
        const int o = plane + (y0 + j) * width + x0;
        __builtin_memcpy(row[0], &image.data[o], nx * sizeof(float));
        __builtin_memcpy(row[1], &target.data[o], nx * sizeof(float));
        for (int i = 0; i < nx; i += LANES) {
            const vf x = *(const vf*)&row[0][i], y = *(const vf*)&row[1][i];
            const vf sign = x > y ? (vf)1.0f : (x < y ? (vf)-1.0f : (vf)0.0f);
            const vf mu = along(down[0] + i), xx = along(down[1] + i), xy = along(down[2] + i);
            *(vf*)&row[2][i] = by_absolute * sign + by_ssim * (mu + 2.0f * x * xx + y * xy);
        }
        __builtin_memcpy(&v_image.data[o], row[2], nx * sizeof(float));
    }
#endif
"""
)


@wp.func_native(_FORWARD)
def _compare_tile(
    item: int, width: int, height: int, image: wp.array3d[wp.float32], target: wp.array3d[wp.float32],
    sums: wp.array2d[wp.float32], maps: wp.array4d[wp.float32],
): ...  # fmt: skip


@wp.func_native(_BACKWARD)
def _compare_tile_bwd(
    item: int, width: int, height: int, image: wp.array3d[wp.float32], target: wp.array3d[wp.float32],
    maps: wp.array4d[wp.float32], v_means: wp.array[wp.float32], v_image: wp.array3d[wp.float32],
): ...  # fmt: skip


@wp.kernel
def _compare_kernel(
    # In:
    first: int,
    image: wp.array3d[wp.float32],  # [3, H, W]
    target: wp.array3d[wp.float32],  # [3, H, W]
    # Out:
    sums: wp.array2d[wp.float32],  # [items, 2] absolute error, SSIM
    maps: wp.array4d[wp.float32],  # [3, 3, H, W] SSIM by the blurred image, its square, its product with the target
):
    _compare_tile(first + wp.tid(), image.shape[2], image.shape[1], image, target, sums, maps)


@wp.kernel
def _compare_bwd_kernel(
    # In:
    first: int,
    image: wp.array3d[wp.float32],  # [3, H, W]
    target: wp.array3d[wp.float32],  # [3, H, W]
    maps: wp.array4d[wp.float32],  # [3, 3, H, W]
    v_means: wp.array[wp.float32],  # [2]
    # Out:
    v_image: wp.array3d[wp.float32],  # [3, H, W]
):
    _compare_tile_bwd(first + wp.tid(), image.shape[2], image.shape[1], image, target, maps, v_means, v_image)


def _n_items(image: Tensor) -> int:
    return 3 * -(-image.shape[2] // _WIDTH) * -(-image.shape[1] // _HEIGHT)


class _Compare(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        image, target = image.contiguous(), target.contiguous()
        sums = image.new_empty(_n_items(image), 2)
        maps = image.new_empty(3, *image.shape)
        bridge.launch_ranges(_compare_kernel, len(sums), [image, target], [sums, maps])
        ctx.save_for_backward(image, target, maps)
        return (sums.double().sum(0) / image.numel()).float()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_means: Tensor) -> Any:
        image, target, maps = ctx.saved_tensors
        v_image = torch.empty_like(image)
        bridge.launch_ranges(
            _compare_bwd_kernel, _n_items(image), [image, target, maps, v_means.contiguous()], [v_image]
        )
        return v_image, None


def compare_images(image: Tensor, target: Tensor) -> Tensor:
    """Compute mean absolute error and mean SSIM of two images. Differentiable in ``image``.

    Args:
        image: Colours in 0..1, shape [3, H, W], float32, on a CPU.
        target: Colours of the same shape.

    Returns:
        The two means, shape [2].

    Raises:
        ValueError: If shapes, dtypes or devices do not fit.
    """
    if image.ndim != 3 or image.shape[0] != 3 or image.shape != target.shape:
        raise ValueError(f"images must both have shape [3, H, W], got {tuple(image.shape)} and {tuple(target.shape)}")
    if any(x.dtype != torch.float32 or x.device.type != "cpu" for x in (image, target)):
        raise ValueError(f"images must be float32 on a CPU, got {image.dtype} on {image.device}")
    return _Compare.apply(image, target)
