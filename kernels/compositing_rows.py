"""Alpha compositing on a CPU: the same mathematics as ``compositing.py``, eight pixels of a row at a time.

A work item is one tile, so threads share nothing. A Gaussian visits only the rows and pixels inside its own ellipse:
in row form (``projection.py``) the interval of a row is one square root. Native snippets spell out the vectors, which
the compiler maps to whatever the processor has; planes are padded by one vector, so that no row needs a tail.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

TILE_WIDTH = 128
TILE_HEIGHT = 16

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
    enum { LANES = 8, TW = %(tile_width)d, TH = %(tile_height)d, STRIDE = TW + LANES, SIZE = TH * STRIDE };
    typedef float vf __attribute__((ext_vector_type(LANES), aligned(4)));
    typedef int vi __attribute__((ext_vector_type(LANES), aligned(4)));
    vf lane;
    for (int i = 0; i < LANES; ++i) lane[i] = (float)i;
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
    const int per_view = n_columns * ((height + TH - 1) / TH), local = tile %% per_view;
    const int x0 = (local %% n_columns) * TW, y0 = (local / n_columns) * TH;
    const int x1 = x0 + TW < width ? x0 + TW : width, y1 = y0 + TH < height ? y0 + TH : height;
    const int begin = tile_begin.data[tile], end = tile_end.data[tile];
    const float threshold = alpha_threshold;
""" % {"tile_width": TILE_WIDTH, "tile_height": TILE_HEIGHT}

# The rows of one splat inside the tile, and for each the interval of pixels where alpha can reach the threshold:
# curvature u^2 + inv_var_y dy^2 <= reach, for LANES rows at a time. The slack only admits pixels that the test on alpha
# then decides, and so does the tail of the last vector: beyond the tile nothing is accepted and nothing is read.
# All of it is clamped before it becomes an integer.
_ROWS = """
        const float px = s[0], py = s[1], ox = s[2], oy = s[3], curvature = s[4], shear = s[5], inv_var_y = s[6];
        const float opacity = s[7], reach = s[12], half_y = s[13], radius = s[14];
        const float steepness = -0.72134752f * curvature;  // exponents are of 2
        float top = __builtin_ceilf((py + oy) - half_y), bottom = __builtin_floorf((py + oy) + half_y);
        top = top > (float)y0 ? (top < (float)y1 ? top : (float)y1) : (float)y0;
        bottom = bottom < (float)(y1 - 1) ? (bottom > (float)(y0 - 1) ? bottom : (float)(y0 - 1)) : (float)(y1 - 1);
        for (int strip = (int)top; strip <= (int)bottom; strip += LANES) {
            const int n_rows = (int)bottom - strip + 1 < LANES ? (int)bottom - strip + 1 : LANES;
            const vf dys = (lane + ((float)strip - py)) - oy;
            const vf heights = inv_var_y * dys * dys;
            const vf rooms = reach - heights;
            const vf half_xs = fma(__builtin_elementwise_sqrt(most(rooms, (vf)0.0f)), (vf)radius, (vf)0.01f);
            const vf centers = fma((vf)shear, dys, (vf)ox);
            vf lefts = __builtin_elementwise_ceil((px + centers) - half_xs);
            lefts = least(most(lefts, (vf)(float)x0), (vf)(float)x1);
            const vf rights = least((px + centers) + half_xs, (vf)(float)(x1 - 1));
            const vi firsts = __builtin_convertvector(lefts, vi);
            const vi ends = __builtin_convertvector(__builtin_elementwise_floor(most(rights, lefts - 1.0f)), vi) + 1;
            for (int j = 0; j < n_rows; ++j) {
                const float dy = dys[j], center = centers[j], row = -0.72134752f * heights[j];
                const int base = (strip + j - y0) * STRIDE - x0, stop_x = ends[j];
                for (int x = firsts[j]; x < stop_x; x += LANES) {
                    const int i = base + x;
                    if (!__builtin_reduce_or(OPEN)) continue;  // nothing is seen here any more
                    const vf u = (lane + ((float)x - px)) - center;
                    const vf G = exp2(fma(steepness * u, u, (vf)row));
                    const vf alpha = least(opacity * G, (vf)cap);
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
        for (int x = x0; x < x1; ++x) T[(y - y0) * STRIDE + x - x0] = 1.0f;
    for (int k = begin; k < end; ++k) {
        if (((k - begin) & 63) == 63) {
            // Once every pixel of the tile has ended, so has the tile.
            vf open = *(const vf*)&T[0];
            for (int i = LANES; i < SIZE; i += LANES) open = most(open, *(const vf*)&T[i]);
            if (__builtin_reduce_max(open) < stop) break;
        }
        const float* s = &splats.data[16LL * gaussian_ids.data[isect_ids.data[k]]];
"""
    + _ROWS.replace("OPEN", "*(const vf*)&T[i] >= stop")
    + """
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
                }
            }
        }
    }
    const int view = tile / (n_columns * ((height + TH - 1) / TH));
    const float* back = &background.data[3 * view];
    const float b0 = back[0], b1 = back[1], b2 = back[2];
    const long long plane = (long long)width * height;
    const long long start = view * plane;
    float* pixels = &image.data[3 * start];
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) {
            const int i = (y - y0) * STRIDE + x - x0, o = y * width + x;
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
    const int view = tile / (n_columns * ((height + TH - 1) / TH));
    const float* back = &background.data[3 * view];
    const float b0 = back[0], b1 = back[1], b2 = back[2];
    const long long plane = (long long)width * height;
    const long long start = view * plane;
    const float* v_pixels = &v_image.data[3 * start];
    int furthest = -1;
    for (int i = 0; i < SIZE; ++i) {
        T[i] = v_red[i] = v_green[i] = v_blue[i] = v_depth[i] = behind[i] = 0.0f;
        accepted[i] = -1;
    }
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) {
            const int i = (y - y0) * STRIDE + x - x0, o = y * width + x;
            T[i] = final_T.data[start + o];
            v_red[i] = v_pixels[o];
            v_green[i] = v_pixels[plane + o];
            v_blue[i] = v_pixels[2 * plane + o];
            v_depth[i] = v_depths.data[start + o];
            behind[i] = v_red[i] * b0 + v_green[i] * b1 + v_blue[i] * b2 - v_alphas.data[start + o];
            accepted[i] = last_ids.data[start + o];
            furthest = accepted[i] > furthest ? accepted[i] : furthest;
        }
    auto sum = [](vf v) -> float {
        typedef float v4 __attribute__((ext_vector_type(LANES / 2)));
        const v4 half = v.lo + v.hi;
        return (half[0] + half[2]) + (half[1] + half[3]);
    };
    for (int k = end - 1; k >= begin; --k) {
        const int isect = isect_ids.data[k];
        float* out = &partials.data[10LL * isect];
        if (k > furthest) {  // hidden in all of the tile
            for (int c = 0; c < 10; ++c) out[c] = 0.0f;
            continue;
        }
        const float* s = &splats.data[16LL * gaussian_ids.data[isect]];
        // Moments of h = G dL/dalpha over the pixels, in u and dy; the parameters' gradients are made of them.
        vf h0 = 0.0f, hu = 0.0f, hy = 0.0f, huu = 0.0f, huy = 0.0f, hyy = 0.0f;
        vf c0 = 0.0f, c1 = 0.0f, c2 = 0.0f, c3 = 0.0f;
"""
    + _ROWS.replace("OPEN", "*(const vi*)&accepted[i] >= k")
    + """
                    const vi use = (alpha >= threshold) & (*(const vi*)&accepted[i] >= k);
                    const vf a = use ? alpha : (vf)0.0f;
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
                    const vf h = free ? G * t * (seen - b) : (vf)0.0f;
                    const vf h_u = h * u;
                    h0 += h;
                    hu += h_u;
                    huu = fma(h_u, u, huu);
                    hy = fma(h, (vf)dy, hy);
                    huy = fma(h_u, (vf)dy, huy);
                    hyy = fma(h, (vf)(dy * dy), hyy);
                }
            }
        }
        const float mu = sum(hu), my = sum(hy);
        out[0] = opacity * curvature * mu;
        out[1] = opacity * (inv_var_y * my - curvature * shear * mu);
        out[2] = -0.5f * opacity * sum(huu);
        out[3] = opacity * curvature * sum(huy);
        out[4] = -0.5f * opacity * sum(hyy);
        out[5] = sum(h0);
        out[6] = sum(c0);
        out[7] = sum(c1);
        out[8] = sum(c2);
        out[9] = sum(c3);
    }
#endif
"""
)


def _kernels(exp: str) -> tuple[wp.Kernel, wp.Kernel]:
    module = f"{__name__}_{exp}"

    @wp.func_native(_FORWARD.replace("EXP2", _EXP2[exp]))
    def composite_tile(
        tile: int, splats: wp.array2d[wp.float32], tile_begin: wp.array[wp.int32], tile_end: wp.array[wp.int32],
        isect_ids: wp.array[wp.int32], gaussian_ids: wp.array[wp.int32], background: wp.array2d[wp.float32],
        n_columns: int, width: int, height: int, alpha_threshold: wp.float32, stop: wp.float32, cap: wp.float32,
        image: wp.array4d[wp.float32], alphas: wp.array3d[wp.float32], depths: wp.array3d[wp.float32],
        final_T: wp.array3d[wp.float32], last_ids: wp.array3d[wp.int32],
    ): ...  # fmt: skip

    @wp.func_native(_BACKWARD.replace("EXP2", _EXP2[exp]))
    def composite_tile_bwd(
        tile: int, splats: wp.array2d[wp.float32], tile_begin: wp.array[wp.int32], tile_end: wp.array[wp.int32],
        isect_ids: wp.array[wp.int32], gaussian_ids: wp.array[wp.int32], background: wp.array2d[wp.float32],
        n_columns: int, width: int, height: int, alpha_threshold: wp.float32, cap: wp.float32,
        final_T: wp.array3d[wp.float32], last_ids: wp.array3d[wp.int32], v_image: wp.array4d[wp.float32],
        v_alphas: wp.array3d[wp.float32], v_depths: wp.array3d[wp.float32], partials: wp.array2d[wp.float32],
    ): ...  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def composite_rows_kernel(
        # In:
        first: int,
        splats: wp.array2d[wp.float32],  # [N, 16] projection.SPLAT
        tile_begin: wp.array[wp.int32],  # [T]
        tile_end: wp.array[wp.int32],  # [T]
        isect_ids: wp.array[wp.int32],  # [M]
        gaussian_ids: wp.array[wp.int32],  # [M]
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
        last_ids: wp.array3d[wp.int32],  # [B, H, W] entry of isect_ids blended last, -1 if none
    ):
        composite_tile(
            first + wp.tid(), splats, tile_begin, tile_end, isect_ids, gaussian_ids, background, n_columns,
            image.shape[3], image.shape[2], alpha_threshold, stop, cap, image, alphas, depths, final_T, last_ids,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def composite_rows_bwd_kernel(
        # In:
        first: int,
        splats: wp.array2d[wp.float32],  # [N, 16]
        tile_begin: wp.array[wp.int32],  # [T]
        tile_end: wp.array[wp.int32],  # [T]
        isect_ids: wp.array[wp.int32],  # [M]
        gaussian_ids: wp.array[wp.int32],  # [M]
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
            first + wp.tid(), splats, tile_begin, tile_end, isect_ids, gaussian_ids, background, n_columns,
            v_image.shape[3], v_image.shape[2], alpha_threshold, cap, final_T, last_ids, v_image, v_alphas, v_depths,
            partials,
        )  # fmt: skip

    return composite_rows_kernel, composite_rows_bwd_kernel


KERNELS = {exp: _kernels(exp) for exp in _EXP2}
"""(composite, its adjoint) by the exponential function."""
