"""Alpha compositing, one thread per pixel, with its hand-written adjoint: the readable reference, and the CUDA form.

Front to back, with ``alpha = min(cap, opacity G)`` and the transmittance ``T``,

    image = sum_k T_k alpha_k c_k + T_end background,    T_{k+1} = T_k (1 - alpha_k).

A Gaussian with ``alpha < threshold`` is skipped; a pixel ends *after* the Gaussian that takes ``T`` below ``stop``. The
adjoint walks back from the last Gaussian that the pixel blended and from the *stored* ``T``, which keeps its relative
precision however small it is. ``behind`` is the colour behind Gaussian k times the image's gradient, one number per
pixel instead of a colour buffer. It is a convex combination of what was blended, so it cannot blow up.

Warp does not replay loops like these, so autodiff is off in this file.
"""

from typing import Any

import torch
import warp as wp

TILE = 16
BLOCK = TILE * TILE
"""Threads per tile. Warp's default CUDA block has as many, and the block sums below rely on it."""

_BLOCK_SUM = """
#if defined(__CUDA_ARCH__)
    // Shuffle down each warp, then add the warps in order: no atomics, the same bits every time.
    __shared__ REAL sums[BLOCK / 32][10];
    const bool any = __any_sync(0xffffffffu, active);
    for (int c = 0; c < 10; ++c) {
        REAL v = active ? values[c] : (REAL)0;
        if (any)
            for (int offset = 16; offset > 0; offset >>= 1) v += __shfl_down_sync(0xffffffffu, v, offset);
        if ((lane & 31) == 0) sums[lane >> 5][c] = v;
    }
    __syncthreads();
    if (lane < 10) {
        REAL v = (REAL)0;
        for (int w = 0; w < BLOCK / 32; ++w) v += sums[w][lane];
        partials.data[row * 10LL + lane] = v;
    }
    __syncthreads();
#else
    // On a CPU the block's threads run one after the other: each adds its share.
    if (active)
        for (int c = 0; c < 10; ++c) partials.data[row * 10LL + c] += values[c];
#endif
"""


def _kernels(real: Any) -> tuple[wp.Kernel, wp.Kernel]:
    row10 = wp.types.vector(10, real)
    module = f"{__name__}_{real.__name__}"
    c_name = {"float32": "float", "float64": "double"}[real.__name__]

    @wp.func_native(_BLOCK_SUM.replace("REAL", c_name).replace("BLOCK", str(BLOCK)))
    def block_sum(active: bool, values: row10, row: int, lane: int, partials: wp.array2d[real]): ...

    vec2 = wp.types.vector(2, real)

    @wp.func
    def offset(splats: wp.array2d[real], n: int, x: int, y: int) -> vec2:
        """Return u and dy of a pixel's centre (row form, see projection.py)."""
        dy = (real(y) - splats[n, 1]) - splats[n, 3]
        return vec2((real(x) - splats[n, 0]) - splats[n, 2] - splats[n, 5] * dy, dy)

    @wp.func
    def gaussian(splats: wp.array2d[real], n: int, d: vec2) -> real:
        return wp.exp(real(-0.5) * (splats[n, 4] * d[0] * d[0] + splats[n, 6] * d[1] * d[1]))

    @wp.kernel(module=module, enable_backward=False)
    def composite_kernel(
        # In:
        splats: wp.array2d[real],  # [N, 16] projection.SPLAT
        isect_offsets: wp.array[wp.int32],  # [T + 1] first entry of each tile in the lists
        gaussian_ids: wp.array[wp.int32],  # [M] by tile, front to back
        background: wp.array2d[real],  # [B, 3]
        n_columns: int,
        tiles_per_view: int,
        alpha_threshold: real,
        stop: real,
        cap: real,
        # Out:
        image: wp.array4d[real],  # [B, 3, H, W]
        alphas: wp.array3d[real],  # [B, H, W]
        depths: wp.array3d[real],  # [B, H, W] sum of weight times depth
        final_T: wp.array3d[real],  # [B, H, W]
        last_ids: wp.array3d[wp.int32],  # [B, H, W] entry of the lists blended last, -1 if none
    ):
        thread = wp.tid()
        tile = thread // BLOCK
        lane = thread % BLOCK
        b = tile // tiles_per_view
        x = (tile % tiles_per_view % n_columns) * TILE + lane % TILE
        y = (tile % tiles_per_view // n_columns) * TILE + lane // TILE
        if x >= image.shape[3] or y >= image.shape[2]:
            return
        T = real(1.0)
        red, green, blue, depth = real(0.0), real(0.0), real(0.0), real(0.0)
        accepted = wp.int32(-1)
        for k in range(isect_offsets[tile], isect_offsets[tile + 1]):
            if T >= stop:
                n = gaussian_ids[k]
                alpha = wp.min(cap, splats[n, 7] * gaussian(splats, n, offset(splats, n, x, y)))
                if alpha >= alpha_threshold:
                    weight = alpha * T
                    red += weight * splats[n, 8]
                    green += weight * splats[n, 9]
                    blue += weight * splats[n, 10]
                    depth += weight * splats[n, 11]
                    T = T * (real(1.0) - alpha)  # T - weight would cancel where alpha is near 1
                    accepted = k
        image[b, 0, y, x] = red + T * background[b, 0]
        image[b, 1, y, x] = green + T * background[b, 1]
        image[b, 2, y, x] = blue + T * background[b, 2]
        alphas[b, y, x] = real(1.0) - T
        depths[b, y, x] = depth
        final_T[b, y, x] = T
        last_ids[b, y, x] = accepted

    @wp.kernel(module=module, enable_backward=False)
    def composite_bwd_kernel(
        # In:
        splats: wp.array2d[real],  # [N, 16]
        isect_offsets: wp.array[wp.int32],  # [T + 1]
        gaussian_ids: wp.array[wp.int32],  # [M] by tile, front to back
        isect_ids: wp.array[wp.int32],  # [M] row of partials of each entry
        background: wp.array2d[real],  # [B, 3]
        n_columns: int,
        tiles_per_view: int,
        alpha_threshold: real,
        cap: real,
        final_T: wp.array3d[real],  # [B, H, W]
        last_ids: wp.array3d[wp.int32],  # [B, H, W]
        v_image: wp.array4d[real],  # [B, 3, H, W]
        v_alphas: wp.array3d[real],  # [B, H, W]
        v_depths: wp.array3d[real],  # [B, H, W]
        # Out:
        partials: wp.array2d[real],  # [M, 10] zero at first
    ):
        thread = wp.tid()
        tile = thread // BLOCK
        lane = thread % BLOCK
        b = tile // tiles_per_view
        x = (tile % tiles_per_view % n_columns) * TILE + lane % TILE
        y = (tile % tiles_per_view // n_columns) * TILE + lane // TILE
        T = real(1.0)
        v_red, v_green, v_blue, v_depth, behind = real(0.0), real(0.0), real(0.0), real(0.0), real(0.0)
        accepted = wp.int32(-1)
        if x < v_image.shape[3] and y < v_image.shape[2]:
            T = final_T[b, y, x]
            v_red = v_image[b, 0, y, x]
            v_green = v_image[b, 1, y, x]
            v_blue = v_image[b, 2, y, x]
            v_depth = v_depths[b, y, x]
            behind = (
                v_red * background[b, 0] + v_green * background[b, 1] + v_blue * background[b, 2] - v_alphas[b, y, x]
            )
            accepted = last_ids[b, y, x]
        # All threads of the block walk all entries of the tile: the block sums need every one of them.
        for step in range(isect_offsets[tile + 1] - isect_offsets[tile]):
            k = isect_offsets[tile + 1] - 1 - step
            n = gaussian_ids[k]
            active = bool(False)
            grad = row10()
            if k <= accepted:
                d = offset(splats, n, x, y)
                G = gaussian(splats, n, d)
                alpha = wp.min(cap, splats[n, 7] * G)
                if alpha >= alpha_threshold:
                    active = True
                    T = wp.min(T / (real(1.0) - alpha), real(1.0))
                    weight = alpha * T
                    seen = (
                        v_red * splats[n, 8] + v_green * splats[n, 9] + v_blue * splats[n, 10] + v_depth * splats[n, 11]
                    )
                    v_alpha = T * (seen - behind)
                    behind = alpha * seen + (real(1.0) - alpha) * behind
                    grad[6] = weight * v_red
                    grad[7] = weight * v_green
                    grad[8] = weight * v_blue
                    grad[9] = weight * v_depth
                    if splats[n, 7] * G <= cap:
                        v_log = splats[n, 7] * G * v_alpha
                        au = splats[n, 4] * d[0]
                        grad[0] = v_log * au
                        grad[1] = v_log * (splats[n, 6] * d[1] - au * splats[n, 5])
                        grad[2] = real(-0.5) * v_log * d[0] * d[0]
                        grad[3] = v_log * au * d[1]
                        grad[4] = real(-0.5) * v_log * d[1] * d[1]
                        grad[5] = G * v_alpha
            block_sum(active, grad, isect_ids[k], lane, partials)

    return composite_kernel, composite_bwd_kernel


KERNELS = {torch.float32: _kernels(wp.float32), torch.float64: _kernels(wp.float64)}
"""(composite, its adjoint) by dtype."""
