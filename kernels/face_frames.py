"""Face frames of a mesh (the R, k and T of Eq. 8), rows gathered in a fixed order, and rotations as quaternions.

The frame of a face: the columns of R are the direction of edge v1 - v0, the normal, and their cross product, so that
det R = 1; k is the mean of that edge's length and the triangle's height over it; T is the centroid.
"""

from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from mgavatar.kernels.bridge import taped
from mgavatar.kernels.precision import Real, by_dtype, pick
from mgavatar.kernels.sparse import SparseMatrix, sparse_apply

SMALLEST_SCALE = 1e-8
"""Least scale of a face [m]: a collapsed face still has a finite covariance whose inverse fits float32."""

_FLAT = 1e-5  # height over the longest edge at which float32 positions no longer say where the normal points
_TINY = 1e-18  # length [m] below which an edge has no direction; its square is a normal float32


def _kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, vec4 = real.scalar, real.vec3, real.vec4
    zero, half, one, two, third = scalar(0.0), scalar(0.5), scalar(1.0), scalar(2.0), scalar(1.0 / 3.0)
    flat, tiny, smallest = scalar(_FLAT), scalar(_TINY), scalar(SMALLEST_SCALE)
    module = f"{__name__}.{real.name}"

    @wp.func
    def any_normal(direction: vec3) -> vec3:
        """Return a unit vector at right angles to a unit ``direction``."""
        helper = vec3(one, zero, zero)
        if wp.abs(direction[0]) > half:
            helper = vec3(zero, one, zero)
        return wp.normalize(wp.cross(direction, helper))

    @wp.func
    def quat_of_axes(x: vec3, y: vec3, z: vec3) -> vec4:
        """Return the quaternion wxyz of the rotation with these columns.

        Each branch starts from a component that is not small, so that nothing is divided by a small number.
        """
        trace = x[0] + y[1] + z[2]
        q = vec4(one + trace, y[2] - z[1], z[0] - x[2], x[1] - y[0])
        if trace < zero:
            if x[0] >= y[1] and x[0] >= z[2]:
                q = vec4(y[2] - z[1], one + x[0] - y[1] - z[2], x[1] + y[0], x[2] + z[0])
            elif y[1] >= z[2]:
                q = vec4(z[0] - x[2], x[1] + y[0], one + y[1] - x[0] - z[2], y[2] + z[1])
            else:
                q = vec4(x[1] - y[0], x[2] + z[0], y[2] + z[1], one + z[2] - x[0] - y[1])
        return q / wp.length(q)

    @wp.func
    def rotate(q: vec4, v: vec3) -> vec3:
        """Rotate ``v`` by a unit quaternion wxyz."""
        axis = vec3(q[1], q[2], q[3])
        t = two * wp.cross(axis, v)
        return v + q[0] * t + wp.cross(axis, t)

    @wp.func
    def quat_product(p: vec4, q: vec4) -> vec4:
        """Multiply quaternions wxyz (Hamilton product)."""
        return vec4(
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        )

    @wp.kernel(module=module)
    def face_frames_kernel(
        # In:
        corners: wp.array2d[vec3],  # [F, 3]
        # Out:
        quats: wp.array[vec4],  # [F]
        scales: wp.array[scalar],  # [F]
        centers: wp.array[vec3],  # [F]
    ) -> None:
        f = wp.tid()
        a = corners[f, 0]
        edge = corners[f, 1] - a
        side = corners[f, 2] - a
        x = vec3(one, zero, zero)
        y = vec3(zero, one, zero)
        length = zero
        height = zero
        if wp.dot(edge, edge) > tiny * tiny:
            length = wp.length(edge)
            x = edge / length
            y = any_normal(x)
            upright = side - wp.dot(side, x) * x
            if wp.dot(upright, upright) > flat * flat * wp.max(wp.dot(side, side), wp.dot(edge, edge)):
                height = wp.length(upright)
                y = wp.cross(x, upright) / height
        quats[f] = quat_of_axes(x, y, wp.cross(x, y))
        scales[f] = wp.max(half * (length + height), smallest)
        centers[f] = a + (edge + side) * third

    return SimpleNamespace(face_frames=face_frames_kernel, rotate=rotate, quat_product=quat_product)


KERNELS = by_dtype(_kernels)


def gather_matrix(index: Tensor, n_rows: int) -> SparseMatrix:
    """Prepare :func:`gather_rows` for an index that is used again and again.

    Args:
        index: Row that each output takes, any shape, N elements, integers.
        n_rows: Number of rows M that it takes from.

    Returns:
        The matrix, shape [N, M], on the device of ``index``.

    Raises:
        ValueError: If an index is outside the rows.
    """
    flat = index.reshape(-1)
    ones = torch.ones(len(flat), dtype=torch.float32, device=index.device)
    return SparseMatrix.from_coo(torch.arange(len(flat), device=index.device), flat, ones, (len(flat), n_rows))


def gather_rows(x: Tensor, index: Tensor, *, order: SparseMatrix | None = None) -> Tensor:
    """Take rows of ``x``. Differentiable in ``x``; the adjoint adds up gradients in a fixed order.

    Args:
        x: Values, shape [M, ...], float32 or float64.
        index: Rows to take, shape [N], integers.
        order: :func:`gather_matrix` of ``index``; without it, it is prepared on every call.

    Returns:
        ``x[index]``, shape [N, ...].

    Raises:
        ValueError: If an index is outside the rows, or ``order`` was made for another number of rows.
    """
    order = gather_matrix(index, len(x)) if order is None else order
    if order.shape != (index.numel(), len(x)):
        raise ValueError(f"order has shape {order.shape} but {index.numel()} rows are taken from {len(x)}")
    return sparse_apply(order, x)


def face_frames(verts: Tensor, faces: Tensor, *, order: SparseMatrix | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the frames of all faces, the R, k and T of Eq. 8. Differentiable in ``verts``.

    A face whose height is less than 1e-5 of its longest edge has no usable normal in float32: its frame keeps the
    edge and takes any normal. A face whose first edge has no length is not rotated. No gradient flows through what was
    replaced, so gradients stay finite.

    Args:
        verts: Vertices [m], shape [V, 3], float32 or float64.
        faces: Vertex indices, shape [F, 3], integers.
        order: :func:`gather_matrix` of ``faces``; without it, it is prepared on every call.

    Returns:
        Rotations as unit quaternions wxyz [F, 4], scales k [m] [F], at least 1e-8, and centroids [m] [F, 3].

    Raises:
        ValueError: If a shape is wrong or a face points outside the vertices.
    """
    if verts.ndim != 2 or verts.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"verts must be [V, 3] and faces [F, 3], got {tuple(verts.shape)} and {tuple(faces.shape)}")
    kernels = pick(KERNELS, verts=verts)
    corners = gather_rows(verts, faces, order=order).reshape(-1, 3, 3)
    n = len(faces)
    return taped(kernels.face_frames, n, (corners,), ((n, 4), (n,), (n, 3)))
