"""Alpha compositing on a CPU: the mathematics of ``compositing.py`` in blocks of 4 x 4 pixels, one vector each.

A work item is one tile, so threads share nothing. A Gaussian visits only the blocks that its ellipse reaches: in row
form (``projection.py``) the interval of a row is one square root, and the tile's 16 rows are one vector. A band is four
rows of the tile; the blocks of a band start at the ellipse's leftmost pixel in it, whatever that is modulo four.

The planes of a tile store a band column by column, four rows at a time. A block is then 16 consecutive numbers wherever
it starts. Each band is padded by one block, so that no block needs a tail: nothing is blended beyond the tile, because
the transmittance there is zero.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

TILE_WIDTH = 128
TILE_HEIGHT = 16  # rows of a tile: as many as a vector has numbers

_EXP2 = {
    "polynomial": """
        // 2^n 2^f with a degree 6 polynomial, relative error below 1e-7.
        e = most(e, (vf)(-126.0f));
        const vf n = __builtin_elementwise_roundeven(e);
        const vf f = e - n;
        vf p = (vf)(1.533757683e-4f);
        p = fma(p, f, (vf)1.339986036e-3f);
        p = fma(p, f, (vf)9.618519534e-3f);
        p = fma(p, f, (vf)5.550328998e-2f);
        p = fma(p, f, (vf)2.402264661e-1f);
        p = fma(p, f, (vf)6.931472056e-1f);
        p = fma(p, f, (vf)1.0f);
        const vi bits = (__builtin_convertvector(n, vi) + 127) << 23;
        vf scale;
        __builtin_memcpy(&scale, &bits, sizeof(scale));
        return p * scale;
""",
    "exact": """
        vf p;
        for (int i = 0; i < LANES; ++i) p[i] = __builtin_exp2f(e[i]);
        return p;
""",
}

_COMMON = """
    enum { SIDE = 4, LANES = SIDE * SIDE, TW = %(tile_width)d, TH = %(tile_height)d };
    enum { BAND = (TW + SIDE) * SIDE, SIZE = TH / SIDE * BAND, AHEAD = 8 };
    static_assert(TH == LANES, "the rows of a tile are one vector");
    typedef float vf __attribute__((ext_vector_type(LANES), aligned(4)));
    typedef int vi __attribute__((ext_vector_type(LANES), aligned(4)));
    typedef float v4 __attribute__((ext_vector_type(SIDE), aligned(4)));
    vf lane, column;
    for (int i = 0; i < LANES; ++i) {
        lane[i] = (float)i;
        column[i] = (float)(i / SIDE);  // of a pixel in its block; its row is i %% SIDE
    }
    // Written out, because what the compiler fuses by itself may differ between the two directions.
    auto fma = [](vf a, vf b, vf c) -> vf {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
        return __builtin_elementwise_fma(a, b, c);
#else
        return a * b + c;
#endif
    };
    auto least = [](vf a, vf b) -> vf { return __builtin_elementwise_min(a, b); };
    auto most = [](vf a, vf b) -> vf { return __builtin_elementwise_max(a, b); };
    // 2^e for e <= 0.
    auto exp2 = [fma, most](vf e) -> vf {
        EXP2
    };
    // The numbers of four rows, repeated for each column of a block.
    auto per_row = [](const float* rows) -> vf {
        const v4 r = *(const v4*)rows;
        return __builtin_shufflevector(r, r, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
    };
    // The minimum of each four rows, in all four of their lanes: exchange neighbours, then pairs.
    auto least_of_band = [least](vf v) -> vf {
        v = least(v, __builtin_shufflevector(v, v, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14));
        return least(v, __builtin_shufflevector(v, v, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13));
    };
    auto place = [](int row, int x) -> int { return row / SIDE * BAND + x * SIDE + row %% SIDE; };
    const int per_view = n_columns * ((height + TH - 1) / TH), local = tile %% per_view;
    const int x0 = (local %% n_columns) * TW, y0 = (local / n_columns) * TH;
    const int x1 = x0 + TW < width ? x0 + TW : width, y1 = y0 + TH < height ? y0 + TH : height;
    const int begin = isect_offsets.data[tile], end = isect_offsets.data[tile + 1];
    const float threshold = alpha_threshold;
    const int view = tile / per_view;
    const float* back = &background.data[3 * view];
    const float b0 = back[0], b1 = back[1], b2 = back[2];
    const long long plane = (long long)width * height, start = view * plane;
""" % {"tile_width": TILE_WIDTH, "tile_height": TILE_HEIGHT}

# For each row of the tile the interval of pixels where alpha can reach the threshold:
# curvature u^2 + inv_var_y dy^2 <= reach. A band takes the union of its rows' intervals. Pixels that it adds, and those
# that the slack of the interval adds, are decided by the test on alpha. All bounds are clamped before they become
# integers; a row that the ellipse does not reach has an empty interval, which moves no minimum.
_BLOCKS = """
        const float px = s[0], py = s[1], ox = s[2], oy = s[3], curvature = s[4], shear = s[5], inv_var_y = s[6];
        const float opacity = s[7], reach = s[12], half_y = s[13], radius = s[14];
        const float steepness = -0.72134752f * curvature;  // exponents are of 2
        float top = __builtin_ceilf((py + oy) - half_y), bottom = __builtin_floorf((py + oy) + half_y);
        top = top > (float)y0 ? (top < (float)y1 ? top : (float)y1) : (float)y0;
        bottom = bottom < (float)(y1 - 1) ? (bottom > (float)(y0 - 1) ? bottom : (float)(y0 - 1)) : (float)(y1 - 1);
        if (top <= bottom) {
            const vf ys = lane + (float)y0;
            const vf dys = (lane + ((float)y0 - py)) - oy;
            const vf heights = inv_var_y * dys * dys;
            const vf half_xs = fma(__builtin_elementwise_sqrt(most(reach - heights, (vf)0.0f)), (vf)radius, (vf)0.01f);
            const vf centers = fma((vf)shear, dys, (vf)ox);
            vf lefts = __builtin_elementwise_ceil((px + centers) - half_xs);
            lefts = least(most(lefts, (vf)(float)x0), (vf)(float)x1);
            const vf rights = __builtin_elementwise_floor(least((px + centers) + half_xs, (vf)(float)(x1 - 1)));
            const vi reached = (ys >= top) & (ys <= bottom) & (rights >= lefts);
            const vf firsts = least_of_band(reached ? lefts : (vf)(float)x1);
            const vf stops = -least_of_band(reached ? -1.0f - rights : (vf)(float)-x0);
            float first_of[LANES], stop_of[LANES], dy_of[LANES], center_of[LANES], row_of[LANES];
            *(vf*)first_of = firsts;
            *(vf*)stop_of = stops;
            *(vf*)dy_of = dys;
            *(vf*)center_of = centers;
            *(vf*)row_of = -0.72134752f * heights;
            const int last_row = ((int)bottom - y0) / SIDE * SIDE;
            for (int row = ((int)top - y0) / SIDE * SIDE; row <= last_row; row += SIDE) {
                const vf dy = per_row(dy_of + row), center = per_row(center_of + row), across = per_row(row_of + row);
                const int base = row / SIDE * BAND - x0 * SIDE, stop_x = (int)stop_of[row];
                START
                for (int x = (int)first_of[row]; x < stop_x; x += SIDE) {
                    const int i = base + x * SIDE;
                    if (!__builtin_reduce_or(OPEN)) continue;  // nothing is seen here any more
                    const vf u = (column + ((float)x - px)) - center;
                    const vf G = exp2(fma(steepness * u, u, across));
                    const vf alpha = least(opacity * G, (vf)cap);
                    BLEND
                }
                FINISH
            }
        }
"""

_FORWARD = (
    """
#if !defined(__CUDACC__)
"""
    + _COMMON
    + """
    float T[SIZE], red[SIZE], green[SIZE], blue[SIZE], depth[SIZE];
    int accepted[SIZE];
    for (int i = 0; i < SIZE; ++i) {
        T[i] = red[i] = green[i] = blue[i] = depth[i] = 0.0f;
        accepted[i] = -1;
    }
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) T[place(y - y0, x - x0)] = 1.0f;
    for (int k = begin; k < end; ++k) {
        if (((k - begin) & 63) == 63) {
            // Once every pixel of the tile has ended, so has the tile.
            vf open = *(const vf*)&T[0];
            for (int i = LANES; i < SIZE; i += LANES) open = most(open, *(const vf*)&T[i]);
            if (__builtin_reduce_max(open) < stop) break;
        }
        // Splats lie in memory by index, not by depth: each one is a cache miss unless it is asked for early.
        if (k + AHEAD < end) __builtin_prefetch(&splats.data[16LL * gaussian_ids.data[k + AHEAD]]);
        const float* s = &splats.data[16LL * gaussian_ids.data[k]];
"""
    + _BLOCKS.replace("START", "")
    .replace("FINISH", "")
    .replace("OPEN", "*(const vf*)&T[i] >= stop")
    .replace(
        "BLEND",
        """
                    const vf t = *(const vf*)&T[i];
                    const vi use = (alpha >= threshold) & (t >= stop);
                    const vf a = use ? alpha : (vf)0.0f;
                    const vf w = a * t;
                    *(vf*)&red[i] = fma(w, (vf)s[8], *(const vf*)&red[i]);
                    *(vf*)&green[i] = fma(w, (vf)s[9], *(const vf*)&green[i]);
                    *(vf*)&blue[i] = fma(w, (vf)s[10], *(const vf*)&blue[i]);
                    *(vf*)&depth[i] = fma(w, (vf)s[11], *(const vf*)&depth[i]);
                    *(vf*)&T[i] = t * (1.0f - a);
                    *(vi*)&accepted[i] = use ? (vi)k : *(const vi*)&accepted[i];
""",
    )
    + """
    }
    float* pixels = &image.data[3 * start];
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) {
            const int i = place(y - y0, x - x0), o = y * width + x;
            pixels[o] = red[i] + T[i] * b0;
            pixels[plane + o] = green[i] + T[i] * b1;
            pixels[2 * plane + o] = blue[i] + T[i] * b2;
            alphas.data[start + o] = 1.0f - T[i];
            depths.data[start + o] = depth[i];
            final_T.data[start + o] = T[i];
            last_ids.data[start + o] = accepted[i];
        }
#endif
"""
)

_BACKWARD = (
    """
#if !defined(__CUDACC__)
"""
    + _COMMON
    + """
    float T[SIZE], v_red[SIZE], v_green[SIZE], v_blue[SIZE], v_depth[SIZE], behind[SIZE];
    int accepted[SIZE];
    const float* v_pixels = &v_image.data[3 * start];
    int furthest = -1;
    for (int i = 0; i < SIZE; ++i) {
        T[i] = v_red[i] = v_green[i] = v_blue[i] = v_depth[i] = behind[i] = 0.0f;
        accepted[i] = -1;
    }
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) {
            const int i = place(y - y0, x - x0), o = y * width + x;
            T[i] = final_T.data[start + o];
            v_red[i] = v_pixels[o];
            v_green[i] = v_pixels[plane + o];
            v_blue[i] = v_pixels[2 * plane + o];
            v_depth[i] = v_depths.data[start + o];
            behind[i] = v_red[i] * b0 + v_green[i] * b1 + v_blue[i] * b2 - v_alphas.data[start + o];
            accepted[i] = last_ids.data[start + o];
            furthest = accepted[i] > furthest ? accepted[i] : furthest;
        }
    // Adds neighbours and puts the sums of b behind those of a. Four levels of it leave the sum of the j-th of sixteen
    // vectors in lane j.
    auto fold = [](vf a, vf b) -> vf {
        return __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30) +
               __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
    };
    const vf zero = 0.0f;
    for (int k = end - 1; k >= begin; --k) {
        float* out = &partials.data[10LL * isect_ids.data[k]];
        if (k > furthest) {  // hidden in all of the tile
            for (int c = 0; c < 10; ++c) out[c] = 0.0f;
            continue;
        }
        if (k - AHEAD >= begin) {
            __builtin_prefetch(&splats.data[16LL * gaussian_ids.data[k - AHEAD]]);
            __builtin_prefetch(&partials.data[10LL * isect_ids.data[k - AHEAD]], 1);
        }
        const float* s = &splats.data[16LL * gaussian_ids.data[k]];
        // Moments of h = G dL/dalpha over the pixels, in u and dy; the parameters' gradients are made of them.
        vf h0 = 0.0f, hu = 0.0f, hy = 0.0f, huu = 0.0f, huy = 0.0f, hyy = 0.0f;
        vf c0 = 0.0f, c1 = 0.0f, c2 = 0.0f, c3 = 0.0f;
"""
    + _BLOCKS.replace("START", "vf band_h = 0.0f, band_hu = 0.0f;")
    .replace("OPEN", "*(const vi*)&accepted[i] >= k")
    .replace(
        "BLEND",
        """
                    const vi use = (alpha >= threshold) & (*(const vi*)&accepted[i] >= k);
                    const vf a = use ? alpha : zero;
                    const vf rest = 1.0f - a;
                    const vf t = least(*(const vf*)&T[i] / rest, (vf)1.0f);
                    const vf w = a * t;
                    const vf g0 = *(const vf*)&v_red[i], g1 = *(const vf*)&v_green[i];
                    const vf g2 = *(const vf*)&v_blue[i], g3 = *(const vf*)&v_depth[i];
                    const vf seen = fma(g0, (vf)s[8], fma(g1, (vf)s[9], fma(g2, (vf)s[10], g3 * s[11])));
                    const vf b = *(const vf*)&behind[i];
                    *(vf*)&T[i] = t;
                    *(vf*)&behind[i] = fma(a, seen, rest * b);
                    c0 = fma(w, g0, c0);
                    c1 = fma(w, g1, c1);
                    c2 = fma(w, g2, c2);
                    c3 = fma(w, g3, c3);
                    const vi free = use & (opacity * G <= cap);
                    const vf h = free ? G * t * (seen - b) : zero;
                    const vf h_u = h * u;
                    band_h += h;
                    band_hu += h_u;
                    huu = fma(h_u, u, huu);
""",
    )
    .replace(
        "FINISH",
        """
                // dy is the same in all blocks of a band, so its moments need one product per band.
                h0 += band_h;
                hu += band_hu;
                hy = fma(band_h, dy, hy);
                huy = fma(band_hu, dy, huy);
                hyy = fma(band_h, dy * dy, hyy);
""",
    )
    + """
        const vf first = fold(fold(fold(hu, hy), fold(huu, huy)), fold(fold(hyy, h0), fold(c0, c1)));
        const vf sums = fold(first, fold(fold(fold(c2, c3), zero), zero));
        out[0] = opacity * curvature * sums[0];
        out[1] = opacity * (inv_var_y * sums[1] - curvature * shear * sums[0]);
        out[2] = -0.5f * opacity * sums[2];
        out[3] = opacity * curvature * sums[3];
        out[4] = -0.5f * opacity * sums[4];
        for (int c = 5; c < 10; ++c) out[c] = sums[c];
    }
#endif
"""
)


def _kernels(exp: str) -> tuple[wp.Kernel, wp.Kernel]:
    module = f"{__name__}_{exp}"

    @wp.func_native(_FORWARD.replace("EXP2", _EXP2[exp]))
    def composite_tile(
        tile: int, splats: wp.array2d[wp.float32], isect_offsets: wp.array[wp.int32], gaussian_ids: wp.array[wp.int32],
        background: wp.array2d[wp.float32], n_columns: int, width: int, height: int, alpha_threshold: wp.float32,
        stop: wp.float32, cap: wp.float32,
        image: wp.array4d[wp.float32], alphas: wp.array3d[wp.float32], depths: wp.array3d[wp.float32],
        final_T: wp.array3d[wp.float32], last_ids: wp.array3d[wp.int32],
    ): ...  # fmt: skip

    @wp.func_native(_BACKWARD.replace("EXP2", _EXP2[exp]))
    def composite_tile_bwd(
        tile: int, splats: wp.array2d[wp.float32], isect_offsets: wp.array[wp.int32], gaussian_ids: wp.array[wp.int32],
        isect_ids: wp.array[wp.int32], background: wp.array2d[wp.float32], n_columns: int, width: int, height: int,
        alpha_threshold: wp.float32, cap: wp.float32,
        final_T: wp.array3d[wp.float32], last_ids: wp.array3d[wp.int32], v_image: wp.array4d[wp.float32],
        v_alphas: wp.array3d[wp.float32], v_depths: wp.array3d[wp.float32], partials: wp.array2d[wp.float32],
    ): ...  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def composite_blocks_kernel(
        # In:
        first: int,
        splats: wp.array2d[wp.float32],  # [N, 16] projection.SPLAT
        isect_offsets: wp.array[wp.int32],  # [T + 1] first entry of each tile in the lists
        gaussian_ids: wp.array[wp.int32],  # [M] by tile, front to back
        background: wp.array2d[wp.float32],  # [B, 3]
        n_columns: int,
        alpha_threshold: wp.float32,
        stop: wp.float32,
        cap: wp.float32,
        # Out:
        image: wp.array4d[wp.float32],  # [B, 3, H, W]
        alphas: wp.array3d[wp.float32],  # [B, H, W]
        depths: wp.array3d[wp.float32],  # [B, H, W] sum of weight times depth
        final_T: wp.array3d[wp.float32],  # [B, H, W]
        last_ids: wp.array3d[wp.int32],  # [B, H, W] entry of the lists blended last, -1 if none
    ):
        composite_tile(
            first + wp.tid(), splats, isect_offsets, gaussian_ids, background, n_columns,
            image.shape[3], image.shape[2], alpha_threshold, stop, cap, image, alphas, depths, final_T, last_ids,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def composite_blocks_bwd_kernel(
        # In:
        first: int,
        splats: wp.array2d[wp.float32],  # [N, 16]
        isect_offsets: wp.array[wp.int32],  # [T + 1]
        gaussian_ids: wp.array[wp.int32],  # [M] by tile, front to back
        isect_ids: wp.array[wp.int32],  # [M] row of partials of each entry
        background: wp.array2d[wp.float32],  # [B, 3]
        n_columns: int,
        alpha_threshold: wp.float32,
        cap: wp.float32,
        final_T: wp.array3d[wp.float32],  # [B, H, W]
        last_ids: wp.array3d[wp.int32],  # [B, H, W]
        v_image: wp.array4d[wp.float32],  # [B, 3, H, W]
        v_alphas: wp.array3d[wp.float32],  # [B, H, W]
        v_depths: wp.array3d[wp.float32],  # [B, H, W]
        # Out:
        partials: wp.array2d[wp.float32],  # [M, 10]
    ):
        composite_tile_bwd(
            first + wp.tid(), splats, isect_offsets, gaussian_ids, isect_ids, background, n_columns,
            v_image.shape[3], v_image.shape[2], alpha_threshold, cap, final_T, last_ids, v_image, v_alphas, v_depths,
            partials,
        )  # fmt: skip

    return composite_blocks_kernel, composite_blocks_bwd_kernel


KERNELS = {exp: _kernels(exp) for exp in _EXP2}
"""(composite, its adjoint) by the exponential function."""
