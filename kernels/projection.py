"""Projection of 3D Gaussians to their footprints in the image, with its hand-written adjoint (EWA splatting).

A footprint is kept in *row form* rather than as a conic: with ``u = x - mx - shear (y - my)``,

    G(x, y) = exp(-(curvature u^2 + inv_var_y (y - my)^2) / 2).

It is the same ellipse after completing the square in x. Both terms have the same sign, so nothing cancels for needles,
and the pixels of a row inside the ellipse follow from one square root.

Everything is computed in double precision, whatever the arrays hold: single precision rounds a mean at 400 px to 3e-5
px, a larger error than that of everything that follows. For the same reason the mean is stored as a whole pixel and a
remainder.
"""

from typing import Any

import torch
import warp as wp

SPLAT = (
    "pixel_x", "pixel_y", "offset_x", "offset_y", "curvature", "shear", "inv_var_y", "opacity",
    "red", "green", "blue", "depth", "reach", "half_y", "radius", "unused",
)  # fmt: skip
"""Columns of a splat: a cache line in single precision.

The mean is the centre of (pixel_x, pixel_y), which are whole numbers, plus the offset [px]. The ellipse where alpha is
at the threshold is ``curvature u^2 + inv_var_y (y - my)^2 = reach``; ``half_y`` is its half height, ``radius`` is
``1 / sqrt(curvature)``. Reach and half height are slightly too large, so that rounding never cuts a pixel off.
"""

NO_EXTENT = 1.0e30
"""Reach where there is no alpha threshold: a Gaussian touches every pixel."""

LARGEST = 1.0e18
"""Gaussians with a larger depth or colour are not drawn: its square would not fit into single precision."""

GRADIENT = ("mean_x", "mean_y", "curvature", "shear", "inv_var_y", "opacity", "red", "green", "blue", "depth")
"""Columns of a splat's gradient."""


@wp.func
def _rotation_of(q: wp.vec4d) -> wp.mat33d:
    """Return the rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    one, two = wp.float64(1.0), wp.float64(2.0)
    return wp.mat33d(
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip


@wp.func
def _rotation_vjp(q: wp.vec4d, r: wp.mat33d) -> wp.vec4d:
    """Return the gradient of a unit quaternion from that of its rotation matrix."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    two = wp.float64(2.0)
    return two * wp.vec4d(
        x * (r[2, 1] - r[1, 2]) + y * (r[0, 2] - r[2, 0]) + z * (r[1, 0] - r[0, 1]),
        w * (r[2, 1] - r[1, 2]) + y * (r[0, 1] + r[1, 0]) + z * (r[0, 2] + r[2, 0]) - two * x * (r[1, 1] + r[2, 2]),
        w * (r[0, 2] - r[2, 0]) + x * (r[0, 1] + r[1, 0]) + z * (r[1, 2] + r[2, 1]) - two * y * (r[0, 0] + r[2, 2]),
        w * (r[1, 0] - r[0, 1]) + x * (r[0, 2] + r[2, 0]) + y * (r[1, 2] + r[2, 1]) - two * z * (r[0, 0] + r[1, 1]),
    )


@wp.func
def _row(m: wp.mat33d, i: int) -> wp.vec3d:
    return wp.vec3d(m[i, 0], m[i, 1], m[i, 2])


@wp.func
def _limited(slope: wp.float64, focal: wp.float64, center: wp.float64, size: wp.float64) -> wp.float64:
    """Limit x/z to 15 % of the image beyond its border: further out the linearised projection is meaningless."""
    margin = wp.float64(0.15) * size
    return wp.clamp(slope, -(center + margin) / focal, (size - center + margin) / focal)


@wp.func
def view_of(view_ids: wp.array[wp.int32], n: int) -> int:
    """Return the view of Gaussian ``n``; without ids there is one view."""
    if view_ids.shape[0] == 0:
        return 0
    return view_ids[n]


def _kernels(real: Any) -> tuple[wp.Kernel, wp.Kernel]:
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    mat33 = wp.types.matrix((3, 3), real)
    mat44 = wp.types.matrix((4, 4), real)
    row10 = wp.types.vector(10, wp.float64)
    module = f"{__name__}_{real.__name__}"

    @wp.func
    def wide3(v: vec3) -> wp.vec3d:
        return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))

    @wp.func
    def wide4(v: vec4) -> wp.vec4d:
        return wp.vec4d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]), wp.float64(v[3]))

    @wp.func
    def rotation_part(m: mat44) -> wp.mat33d:
        return wp.mat33d(
            wp.float64(m[0, 0]), wp.float64(m[0, 1]), wp.float64(m[0, 2]),
            wp.float64(m[1, 0]), wp.float64(m[1, 1]), wp.float64(m[1, 2]),
            wp.float64(m[2, 0]), wp.float64(m[2, 1]), wp.float64(m[2, 2]),
        )  # fmt: skip

    @wp.func
    def translation_part(m: mat44) -> wp.vec3d:
        return wp.vec3d(wp.float64(m[0, 3]), wp.float64(m[1, 3]), wp.float64(m[2, 3]))

    @wp.kernel(module=module, enable_backward=False)
    def project_kernel(
        # In:
        first: int,
        means: wp.array[vec3],  # [N]
        quats: wp.array[vec4],  # [N] wxyz, norm in 1e-12..1e12
        scales: wp.array[vec3],  # [N]
        opacities: wp.array[real],  # [N]
        colors: wp.array[vec3],  # [N]
        viewmats: wp.array[mat44],  # [B]
        Ks: wp.array[mat33],  # [B]
        view_ids: wp.array[wp.int32],  # [N] in 0..B-1, or empty where B = 1
        width: int,
        height: int,
        tile_width: int,
        tile_height: int,
        near: wp.float64,
        low_pass: wp.float64,
        alpha_threshold: wp.float64,
        # Out:
        splats: wp.array2d[real],  # [N, 16]
        tiles: wp.array2d[wp.int32],  # [N, 4] first and last + 1 tile column, then row; all zero where culled
        keys: wp.array[wp.float32],  # [N] depth, or 0 where culled
    ):
        n = first + wp.tid()
        for c in range(4):
            tiles[n, c] = 0
        for c in range(16):
            splats[n, c] = real(0.0)
        keys[n] = wp.float32(0.0)
        zero, one, half = wp.float64(0.0), wp.float64(1.0), wp.float64(0.5)
        largest, tiny = wp.float64(LARGEST), wp.float64(1.0e-30)
        i_view = view_of(view_ids, n)
        view = rotation_part(viewmats[i_view])
        p = view * wide3(means[n]) + translation_part(viewmats[i_view])
        q = wide4(quats[n])
        norm = wp.length(q)
        opacity = wp.float64(opacities[n])
        color_sq = wp.length_sq(wide3(colors[n]))
        # Comparisons with NaN are false, so `not (a > b)` culls what `a <= b` would let through.
        if not (p[2] > near) or not (p[2] < largest) or not (color_sq < largest * largest):
            return
        if not (norm > wp.float64(1.0e-12)) or not (norm < wp.float64(1.0e12)):
            return
        if not (opacity >= alpha_threshold) or not (opacity < largest):
            return
        g = view * (_rotation_of(q / norm) * wp.diag(wide3(scales[n])))
        focal_x, focal_y = wp.float64(Ks[i_view][0, 0]), wp.float64(Ks[i_view][1, 1])
        center_x, center_y = wp.float64(Ks[i_view][0, 2]), wp.float64(Ks[i_view][1, 2])
        ux = _limited(p[0] / p[2], focal_x, center_x, wp.float64(width))
        uy = _limited(p[1] / p[2], focal_y, center_y, wp.float64(height))
        gx = (_row(g, 0) - ux * _row(g, 2)) * (focal_x / p[2])
        gy = (_row(g, 1) - uy * _row(g, 2)) * (focal_y / p[2])
        var_x = wp.dot(gx, gx) + low_pass
        var_y = wp.dot(gy, gy) + low_pass
        # det(cov) as a sum of squares: var_x var_y - cov_xy^2 would cancel for needles.
        cross = wp.cross(gx, gy)
        det = low_pass * (var_y + wp.dot(gx, gx)) + wp.dot(cross, cross)
        mx = focal_x * p[0] / p[2] + center_x
        my = focal_y * p[1] / p[2] + center_y
        # Outside these the footprint does not fit into single precision.
        if not (det > tiny) or not (var_x < one / tiny) or not (var_y < one / tiny):
            return
        if (
            not (var_y > tiny)
            or not (det > tiny * var_y)
            or not (wp.abs(mx) < one / tiny)
            or not (wp.abs(my) < one / tiny)
        ):
            return
        reach = wp.float64(NO_EXTENT)
        if alpha_threshold > zero:
            reach = wp.float64(2.0) * wp.log(opacity / alpha_threshold) + wp.float64(1.0e-3)
        half_x = wp.sqrt(reach * var_x) + wp.float64(0.01)
        half_y = wp.sqrt(reach * var_y) + wp.float64(0.01)
        # A pixel i is touched if its centre i + 0.5 lies within the half extent.
        x0 = wp.clamp(wp.ceil(mx - half_x - half), zero, wp.float64(width))
        x1 = wp.clamp(wp.floor(mx + half_x + half), zero, wp.float64(width))
        y0 = wp.clamp(wp.ceil(my - half_y - half), zero, wp.float64(height))
        y1 = wp.clamp(wp.floor(my + half_y + half), zero, wp.float64(height))
        if not (x1 > x0) or not (y1 > y0):
            return
        tiles[n, 0] = int(x0) // tile_width
        tiles[n, 1] = (int(x1) + tile_width - 1) // tile_width
        tiles[n, 2] = int(y0) // tile_height
        tiles[n, 3] = (int(y1) + tile_height - 1) // tile_height
        keys[n] = wp.float32(p[2])
        splats[n, 0] = real(wp.floor(mx))
        splats[n, 1] = real(wp.floor(my))
        splats[n, 2] = real(mx - wp.floor(mx) - half)
        splats[n, 3] = real(my - wp.floor(my) - half)
        splats[n, 4] = real(var_y / det)
        splats[n, 5] = real(wp.dot(gx, gy) / var_y)
        splats[n, 6] = real(one / var_y)
        splats[n, 7] = opacities[n]
        splats[n, 8] = colors[n][0]
        splats[n, 9] = colors[n][1]
        splats[n, 10] = colors[n][2]
        splats[n, 11] = real(p[2])
        splats[n, 12] = real(reach)
        splats[n, 13] = real(half_y)
        splats[n, 14] = real(wp.sqrt(det / var_y))

    @wp.kernel(module=module, enable_backward=False)
    def project_bwd_kernel(
        # In:
        first: int,
        means: wp.array[vec3],  # [N]
        quats: wp.array[vec4],  # [N]
        scales: wp.array[vec3],  # [N]
        viewmats: wp.array[mat44],  # [B]
        Ks: wp.array[mat33],  # [B]
        view_ids: wp.array[wp.int32],  # [N] in 0..B-1, or empty where B = 1
        width: int,
        height: int,
        low_pass: wp.float64,
        first_isects: wp.array[wp.int32],  # [N] first row of partials
        tiles_per_gauss: wp.array[wp.int32],  # [N] zero where culled
        partials: wp.array2d[real],  # [M, 10] gradient of each (tile, Gaussian)
        # Out:
        v_means: wp.array[vec3],  # [N]
        v_quats: wp.array[vec4],  # [N]
        v_scales: wp.array[vec3],  # [N]
        v_opacities: wp.array[real],  # [N]
        v_colors: wp.array[vec3],  # [N]
        v_means2d: wp.array2d[real],  # [N, 2]
        v_viewmats: wp.array2d[wp.float64],  # [N, 12] each Gaussian's share, or empty
    ):
        n = first + wp.tid()
        count = tiles_per_gauss[n]
        if count == 0:
            return
        v = row10()
        for k in range(count):
            for c in range(10):
                v[c] += wp.float64(partials[first_isects[n] + k, c])
        i_view = view_of(view_ids, n)
        view = rotation_part(viewmats[i_view])
        mean = wide3(means[n])
        p = view * mean + translation_part(viewmats[i_view])
        q = wide4(quats[n])
        unit = q / wp.length(q)
        rot = _rotation_of(unit)
        scale = wide3(scales[n])
        m = rot * wp.diag(scale)
        g = view * m
        focal_x, focal_y = wp.float64(Ks[i_view][0, 0]), wp.float64(Ks[i_view][1, 1])
        rz = wp.float64(1.0) / p[2]
        fx, fy = focal_x * rz, focal_y * rz
        sx, sy = p[0] / p[2], p[1] / p[2]
        ux = _limited(sx, focal_x, wp.float64(Ks[i_view][0, 2]), wp.float64(width))
        uy = _limited(sy, focal_y, wp.float64(Ks[i_view][1, 2]), wp.float64(height))
        gx = (_row(g, 0) - ux * _row(g, 2)) * fx
        gy = (_row(g, 1) - uy * _row(g, 2)) * fy
        var_y = wp.dot(gy, gy) + low_pass
        cross = wp.cross(gx, gy)
        # From row form to covariance [[P, Q], [Q, S]]: a = S / (P S - Q^2), b = Q / S, w = 1 / S.
        a = var_y / (low_pass * (var_y + wp.dot(gx, gx)) + wp.dot(cross, cross))
        b = wp.dot(gx, gy) / var_y
        w = wp.float64(1.0) / var_y
        two = wp.float64(2.0)
        v_P = -a * a * v[2]
        v_Q = two * b * a * a * v[2] + w * v[3]
        v_S = -b * b * a * a * v[2] - b * w * v[3] - w * w * v[4]
        v_gx = two * v_P * gx + v_Q * gy
        v_gy = two * v_S * gy + v_Q * gx
        v_ux = -fx * wp.dot(v_gx, _row(g, 2))
        v_uy = -fy * wp.dot(v_gy, _row(g, 2))
        v_x = v[0] * fx
        v_y = v[1] * fy
        v_z = v[9] - v[0] * fx * sx - v[1] * fy * sy - (wp.dot(v_gx, gx) + wp.dot(v_gy, gy)) * rz
        # Where x/z was clamped, the slope no longer depends on the mean.
        if ux == sx:
            v_x += v_ux * rz
            v_z -= v_ux * sx * rz
        if uy == sy:
            v_y += v_uy * rz
            v_z -= v_uy * sy * rz
        v_p = wp.vec3d(v_x, v_y, v_z)
        v_g = wp.matrix_from_rows(v_gx * fx, v_gy * fy, -(ux * fx * v_gx + uy * fy * v_gy))
        v_mean = wp.transpose(view) * v_p
        v_m = wp.transpose(view) * v_g
        v_scale = wp.get_diag(wp.transpose(rot) * v_m)
        v_unit = _rotation_vjp(unit, v_m * wp.diag(scale))
        v_q = (v_unit - wp.dot(v_unit, unit) * unit) / wp.length(q)
        v_means[n] = vec3(real(v_mean[0]), real(v_mean[1]), real(v_mean[2]))
        v_quats[n] = vec4(real(v_q[0]), real(v_q[1]), real(v_q[2]), real(v_q[3]))
        v_scales[n] = vec3(real(v_scale[0]), real(v_scale[1]), real(v_scale[2]))
        v_opacities[n] = real(v[5])
        v_colors[n] = vec3(real(v[6]), real(v[7]), real(v[8]))
        v_means2d[n, 0] = real(v[0])
        v_means2d[n, 1] = real(v[1])
        if v_viewmats.shape[0] > 0:
            v_view = v_g * wp.transpose(m) + wp.outer(v_p, mean)
            for i in range(3):
                for j in range(3):
                    v_viewmats[n, 4 * i + j] = v_view[i, j]
                v_viewmats[n, 4 * i + 3] = v_p[i]

    return project_kernel, project_bwd_kernel


KERNELS = {torch.float32: _kernels(wp.float32), torch.float64: _kernels(wp.float64)}
"""(project, its adjoint) by dtype of the arrays."""
