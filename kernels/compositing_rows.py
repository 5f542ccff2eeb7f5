"""Alpha compositing on a CPU: the same mathematics as ``compositing.py``, sixteen pixels of a row at a time.

A work item is one tile, so threads share nothing. A Gaussian visits only the rows and pixels inside its own ellipse:
in row form (``projection.py``) the interval of a row is one square root. Native snippets spell out the vectors, which
the compiler maps to whatever the processor has; planes are padded by one vector, so that no row needs a tail.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

TILE_WIDTH = 128
TILE_HEIGHT = 16

_COMMON = """
    enum { LANES = 16, TW = %(tile_width)d, TH = %(tile_height)d, STRIDE = TW + LANES };
    typedef float vf __attribute__((ext_vector_type(LANES), aligned(4)));
    typedef int vi __attribute__((ext_vector_type(LANES), aligned(4)));
    vf lane;
    for (int i = 0; i < LANES; ++i) lane[i] = (float)i;
    // exp(-t) for t >= 0: 2^n 2^f with a degree 6 polynomial, relative error below 1e-7.
    auto exp_neg = [](vf t) -> vf {
        vf e = __builtin_elementwise_max(t * -1.44269504f, (vf)(-126.0f));
        vf n = __builtin_elementwise_roundeven(e);
        vf f = e - n;
        vf p = (vf)(1.533757683e-4f);
        p = p * f + 1.339986036e-3f;
        p = p * f + 9.618519534e-3f;
        p = p * f + 5.550328998e-2f;
        p = p * f + 2.402264661e-1f;
        p = p * f + 6.931472056e-1f;
        p = p * f + 1.0f;
        vi bits = (__builtin_convertvector(n, vi) + 127) << 23;
        vf scale;
        __builtin_memcpy(&scale, &bits, sizeof(scale));
        return p * scale;
    };
    const int x0 = (tile %% n_columns) * TW, y0 = (tile / n_columns) * TH;
    const int x1 = x0 + TW < width ? x0 + TW : width, y1 = y0 + TH < height ? y0 + TH : height;
    const int begin = tile_begin.data[tile], end = tile_end.data[tile];
""" % {"tile_width": TILE_WIDTH, "tile_height": TILE_HEIGHT}  # noqa: UP031

# The rows of one splat inside the tile, and for each the interval of pixels where alpha can reach the threshold:
# curvature u^2 + inv_var_y dy^2 <= reach. The slack only admits pixels that the test on alpha then decides.
_ROWS = """
        const float px = s[0], py = s[1], ox = s[2], oy = s[3], curvature = s[4], shear = s[5], inv_var_y = s[6];
        const float opacity = s[7];
        const float reach = alpha_threshold > 0.0f ? 2.0f * __builtin_logf(opacity / alpha_threshold) + 1e-3f : 1e30f;
        const float half_y = __builtin_sqrtf(reach / inv_var_y);
        float top = py + oy - half_y - 0.01f, bottom = py + oy + half_y + 0.01f;
        top = top > (float)y0 ? __builtin_ceilf(top) : (float)y0;
        bottom = bottom < (float)(y1 - 1) ? __builtin_floorf(bottom) : (float)(y1 - 1);
        const float inv_curvature = 1.0f / curvature;
        for (int y = (int)top; y <= (int)bottom; ++y) {
            const float dy = ((float)y - py) - oy;
            const float row = inv_var_y * dy * dy;
            const float room = reach - row;
            if (!(room >= 0.0f)) continue;
            const float half_x = __builtin_sqrtf(room * inv_curvature) + 0.01f;
            const float cx = ox + shear * dy;
            float left = px + cx - half_x, right = px + cx + half_x;
            left = left > (float)x0 ? __builtin_ceilf(left) : (float)x0;
            right = right < (float)(x1 - 1) ? __builtin_floorf(right) : (float)(x1 - 1);
            const int first = (int)left, stop_x = (int)right + 1;
            const int base = (y - y0) * STRIDE - x0;
            for (int x = first; x < stop_x; x += LANES) {
                const vf u = (lane + ((float)x - px)) - cx;
                const vf G = exp_neg(0.5f * (curvature * (u * u) + row));
                const vf alpha = __builtin_elementwise_min(opacity * G, (vf)cap);
"""

_FORWARD = (
    """
#if !defined(__CUDACC__)
"""
    + _COMMON
    + """
    float T[TH * STRIDE], red[TH * STRIDE], green[TH * STRIDE], blue[TH * STRIDE], depth[TH * STRIDE];
    int accepted[TH * STRIDE];
    for (int i = 0; i < TH * STRIDE; ++i) {
        T[i] = 1.0f;
        red[i] = green[i] = blue[i] = depth[i] = 0.0f;
        accepted[i] = -1;
    }
    for (int k = begin; k < end; ++k) {
        if (((k - begin) & 63) == 63) {
            // Once every pixel of the tile has ended, so has the tile.
            float most = -1.0f;
            for (int y = y0; y < y1; ++y)
                for (int x = x0; x < x1; ++x) {
                    const float t = T[(y - y0) * STRIDE + x - x0];
                    most = t > most ? t : most;
                }
            if (most < stop) break;
        }
        const float* s = &splats.data[12 * item_splat.data[items.data[k]]];
"""
    + _ROWS
    + """
                const int i = base + x;
                vf t = *(const vf*)&T[i];
                const vi use = (alpha >= alpha_threshold) & (t >= stop) & (lane < (float)(stop_x - x));
                const vf a = use ? alpha : (vf)0.0f;
                const vf w = a * t;
                *(vf*)&red[i] = *(const vf*)&red[i] + w * s[8];
                *(vf*)&green[i] = *(const vf*)&green[i] + w * s[9];
                *(vf*)&blue[i] = *(const vf*)&blue[i] + w * s[10];
                *(vf*)&depth[i] = *(const vf*)&depth[i] + w * s[11];
                *(vf*)&T[i] = t * (1.0f - a);
                *(vi*)&accepted[i] = use ? (vi)k : *(const vi*)&accepted[i];
            }
        }
    }
    const float b0 = background.data[0], b1 = background.data[1], b2 = background.data[2];
    const int plane = width * height;
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) {
            const int i = (y - y0) * STRIDE + x - x0, o = y * width + x;
            image.data[o] = red[i] + T[i] * b0;
            image.data[plane + o] = green[i] + T[i] * b1;
            image.data[2 * plane + o] = blue[i] + T[i] * b2;
            image.data[3 * plane + o] = 1.0f - T[i];
            image.data[4 * plane + o] = depth[i];
            final_T.data[o] = T[i];
            last.data[o] = accepted[i];
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
    float T[TH * STRIDE], v_red[TH * STRIDE], v_green[TH * STRIDE], v_blue[TH * STRIDE], v_depth[TH * STRIDE];
    float behind[TH * STRIDE];
    int accepted[TH * STRIDE];
    const float b0 = background.data[0], b1 = background.data[1], b2 = background.data[2];
    const int plane = width * height;
    int furthest = -1;
    for (int i = 0; i < TH * STRIDE; ++i) {
        T[i] = 1.0f;
        v_red[i] = v_green[i] = v_blue[i] = v_depth[i] = behind[i] = 0.0f;
        accepted[i] = -1;
    }
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) {
            const int i = (y - y0) * STRIDE + x - x0, o = y * width + x;
            T[i] = final_T.data[o];
            v_red[i] = v_image.data[o];
            v_green[i] = v_image.data[plane + o];
            v_blue[i] = v_image.data[2 * plane + o];
            v_depth[i] = v_image.data[4 * plane + o];
            behind[i] = v_red[i] * b0 + v_green[i] * b1 + v_blue[i] * b2 - v_image.data[3 * plane + o];
            accepted[i] = last.data[o];
            furthest = accepted[i] > furthest ? accepted[i] : furthest;
        }
    for (int k = furthest; k >= begin; --k) {
        const int item = items.data[k];
        const float* s = &splats.data[12 * item_splat.data[item]];
        // Moments of h = G dL/dalpha over the pixels, in u and dy; the parameters' gradients are made of them.
        vf h0 = 0.0f, hu = 0.0f, hy = 0.0f, huu = 0.0f, huy = 0.0f, hyy = 0.0f;
        vf c0 = 0.0f, c1 = 0.0f, c2 = 0.0f, c3 = 0.0f;
"""
    + _ROWS
    + """
                const int i = base + x;
                const vi use = (alpha >= alpha_threshold) & (*(const vi*)&accepted[i] >= k) & (lane < (float)(stop_x - x));
                const vf a = use ? alpha : (vf)0.0f;
                const vf rest = 1.0f - a;
                const vf t = __builtin_elementwise_min(*(const vf*)&T[i] / rest, (vf)1.0f);
                const vf w = a * t;
                const vf g0 = *(const vf*)&v_red[i], g1 = *(const vf*)&v_green[i];
                const vf g2 = *(const vf*)&v_blue[i], g3 = *(const vf*)&v_depth[i];
                const vf seen = g0 * s[8] + g1 * s[9] + g2 * s[10] + g3 * s[11];
                const vf b = *(const vf*)&behind[i];
                *(vf*)&T[i] = t;
                *(vf*)&behind[i] = a * seen + rest * b;
                c0 += w * g0;
                c1 += w * g1;
                c2 += w * g2;
                c3 += w * g3;
                const vi free = use & (opacity * G <= cap);
                const vf h = free ? G * t * (seen - b) : (vf)0.0f;
                const vf h_u = h * u;
                h0 += h;
                hu += h_u;
                huu += h_u * u;
                hy += h * dy;
                huy += h_u * dy;
                hyy += h * (dy * dy);
            }
        }
        auto sum = [](vf v) -> float {
            float r = 0.0f;
            for (int j = 0; j < LANES; ++j) r += v[j];
            return r;
        };
        float* out = &partials.data[10 * item];
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


@wp.func_native(_FORWARD)
def _composite_tile(
    tile: int, splats: wp.array2d[wp.float32], tile_begin: wp.array[wp.int32], tile_end: wp.array[wp.int32],
    items: wp.array[wp.int32], item_splat: wp.array[wp.int32], background: wp.array[wp.float32], n_columns: int,
    width: int, height: int, alpha_threshold: wp.float32, stop: wp.float32, cap: wp.float32,
    image: wp.array3d[wp.float32], final_T: wp.array2d[wp.float32], last: wp.array2d[wp.int32],
): ...  # fmt: skip


@wp.func_native(_BACKWARD)
def _composite_tile_bwd(
    tile: int, splats: wp.array2d[wp.float32], tile_begin: wp.array[wp.int32], tile_end: wp.array[wp.int32],
    items: wp.array[wp.int32], item_splat: wp.array[wp.int32], background: wp.array[wp.float32], n_columns: int,
    width: int, height: int, alpha_threshold: wp.float32, cap: wp.float32, final_T: wp.array2d[wp.float32],
    last: wp.array2d[wp.int32], v_image: wp.array3d[wp.float32], partials: wp.array2d[wp.float32],
): ...  # fmt: skip


@wp.kernel
def composite_rows_kernel(
    # In:
    first: int,
    splats: wp.array2d[wp.float32],  # [N, 12] projection.SPLAT
    tile_begin: wp.array[wp.int32],  # [T]
    tile_end: wp.array[wp.int32],  # [T]
    items: wp.array[wp.int32],  # [M]
    item_splat: wp.array[wp.int32],  # [M]
    background: wp.array[wp.float32],  # [3]
    n_columns: int,
    alpha_threshold: wp.float32,
    stop: wp.float32,
    cap: wp.float32,
    # Out:
    image: wp.array3d[wp.float32],  # [5, H, W] red, green, blue, alpha, depth
    final_T: wp.array2d[wp.float32],  # [H, W]
    last: wp.array2d[wp.int32],  # [H, W] entry of items last accepted, -1 if none
):
    _composite_tile(
        first + wp.tid(), splats, tile_begin, tile_end, items, item_splat, background, n_columns,
        image.shape[2], image.shape[1], alpha_threshold, stop, cap, image, final_T, last,
    )  # fmt: skip


@wp.kernel
def composite_rows_bwd_kernel(
    # In:
    first: int,
    splats: wp.array2d[wp.float32],  # [N, 12]
    tile_begin: wp.array[wp.int32],  # [T]
    tile_end: wp.array[wp.int32],  # [T]
    items: wp.array[wp.int32],  # [M]
    item_splat: wp.array[wp.int32],  # [M]
    background: wp.array[wp.float32],  # [3]
    n_columns: int,
    alpha_threshold: wp.float32,
    cap: wp.float32,
    final_T: wp.array2d[wp.float32],  # [H, W]
    last: wp.array2d[wp.int32],  # [H, W]
    v_image: wp.array3d[wp.float32],  # [5, H, W]
    # Out:
    partials: wp.array2d[wp.float32],  # [M, 10] zero at first
):
    _composite_tile_bwd(
        first + wp.tid(), splats, tile_begin, tile_end, items, item_splat, background, n_columns,
        v_image.shape[2], v_image.shape[1], alpha_threshold, cap, final_T, last, v_image, partials,
    )  # fmt: skip
