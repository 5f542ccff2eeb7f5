"""Maps in UV space: vertex values drawn into maps, and maps sampled at fixed places.

Texel (column i, row j) of a W x H map has its centre at u = (i + 0.5) / W, v = 1 - (j + 0.5) / H: row 0 is the top,
v = 1. Both directions are sparse matrices, so their adjoints are deterministic.
"""

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from mgavatar.kernels.bridge import launch
from mgavatar.kernels.sparse import SparseMatrix, sparse_apply

wp.set_module_options({"enable_backward": False})

_NONE = 2**31 - 1  # larger than any face
_EDGE = 1e-9  # barycentric weight: a texel centre this close to an edge belongs to the faces on both sides


@wp.func
def _cross(a: wp.vec2d, b: wp.vec2d) -> wp.float64:
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def _barycentric(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, p: wp.vec2d) -> wp.vec3d:
    """Return the weights of a, b and c at ``p``, for either orientation; all NaN for a face without area."""
    area = _cross(b - a, c - a)
    w_b = _cross(p - a, c - a) / area
    w_c = _cross(b - a, p - a) / area
    return wp.vec3d(wp.float64(1.0) - w_b - w_c, w_b, w_c)


@wp.func
def _texel_range(low: wp.float64, high: wp.float64, size: int) -> wp.vec2i:
    """Return the first texel whose centre may lie between ``low`` and ``high`` [texels], and one past the last.

    A NaN fails the comparison and gives an empty range, so that it never becomes an index.
    """
    end = wp.float64(size)
    if not (high >= wp.float64(0.0) and low <= end):
        return wp.vec2i(0, 0)
    return wp.vec2i(int(wp.max(low - wp.float64(1.0), wp.float64(0.0))), int(wp.min(high + wp.float64(1.0), end)))


@wp.kernel
def _cover_kernel(
    # In:
    corners: wp.array2d[wp.vec2d],  # [F, 3], in texels, row down
    width: int,
    height: int,
    # Out:
    face_ids: wp.array[int],  # [H W], the smallest face over each texel
) -> None:
    f = wp.tid()
    a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
    low, high = wp.min(a, wp.min(b, c)), wp.max(a, wp.max(b, c))
    cols, rows = _texel_range(low[0], high[0], width), _texel_range(low[1], high[1], height)
    for j in range(rows[0], rows[1]):
        for i in range(cols[0], cols[1]):
            p = wp.vec2d(wp.float64(i) + wp.float64(0.5), wp.float64(j) + wp.float64(0.5))
            weights = _barycentric(a, b, c, p)
            least = wp.float64(-_EDGE)
            # Compared one by one: a face without area has NaN weights, and a minimum of them might hide it.
            if weights[0] >= least and weights[1] >= least and weights[2] >= least:
                wp.atomic_min(face_ids, j * width + i, f)


@wp.kernel
def _weights_kernel(
    # In:
    corners: wp.array2d[wp.vec2d],  # [F, 3]
    face_ids: wp.array[int],  # [E]
    texels: wp.array[int],  # [E]
    width: int,
    # Out:
    weights: wp.array[wp.vec3d],  # [E]
) -> None:
    e = wp.tid()
    f = face_ids[e]
    p = wp.vec2d(
        wp.float64(texels[e] % width) + wp.float64(0.5),
        wp.float64(texels[e] // width) + wp.float64(0.5),
    )
    raw = wp.max(_barycentric(corners[f, 0], corners[f, 1], corners[f, 2], p), wp.vec3d())
    weights[e] = raw / (raw[0] + raw[1] + raw[2])


@dataclass(frozen=True, eq=False)
class UvMap:
    """The face that covers each texel, and the matrix that draws per-vertex values into the map.

    Attributes:
        matrix: Barycentric weights of the covering face at each texel centre, [H W, V]; rows without a face are zero.
        face_ids: Face of each texel, or -1, shape [H, W], int32.
    """

    matrix: SparseMatrix
    face_ids: Tensor

    def to(self, device: torch.device | str) -> "UvMap":
        """Return the same map on another device."""
        return UvMap(self.matrix.to(device), self.face_ids.to(device))


def uv_map(vt: Tensor, ft: Tensor, faces: Tensor, n_verts: int, height: int, width: int) -> UvMap:
    """Find the face over each texel centre; where faces overlap or meet, that with the smallest index.

    Args:
        vt: Texture coordinates, v up, shape [U, 2], float32 or float64; parts outside the unit square are cut off.
        ft: Texture indices of each face, shape [F, 3], integers.
        faces: Vertex indices of each face, shape [F, 3], integers.
        n_verts: Number of vertices V.
        height: Rows H.
        width: Columns W.

    Returns:
        The map, on the device of ``vt``.

    Raises:
        ValueError: If a shape is wrong or an index is out of range.
    """
    if vt.ndim != 2 or vt.shape[1] != 2 or ft.shape != faces.shape or tuple(faces.shape) != (len(faces), 3):
        raise ValueError(
            f"a UV map needs vt [U, 2], ft [F, 3] and faces [F, 3], got "
            f"{tuple(vt.shape)}, {tuple(ft.shape)} and {tuple(faces.shape)}"
        )
    if height < 1 or width < 1:
        raise ValueError(f"a UV map needs at least one texel, got {height} x {width}")
    if ft.numel() and not (int(ft.min()) >= 0 and int(ft.max()) < len(vt)):
        raise ValueError(f"ft indexes {int(ft.min())}..{int(ft.max())} but there are {len(vt)} texture coordinates")
    u, v = vt.double().unbind(1)
    corners = torch.stack([u * width, (1.0 - v) * height], 1)[ft.long()].contiguous()
    found = torch.full((height * width,), _NONE, dtype=torch.int32, device=vt.device)
    if len(faces):
        launch(_cover_kernel, len(faces), (corners, width, height), (found,))
    texels = torch.nonzero(found != _NONE).flatten()
    covering = found[texels]
    weights = torch.empty(len(texels), 3, dtype=torch.float64, device=vt.device)
    if len(texels):
        launch(_weights_kernel, len(texels), (corners, covering, texels.int(), width), (weights,))
    rows, cols = texels.repeat_interleave(3), faces.long()[covering.long()].reshape(-1)
    matrix = SparseMatrix.from_coo(rows, cols, weights.reshape(-1), (height * width, n_verts))
    return UvMap(matrix, torch.where(found == _NONE, -1, found).reshape(height, width))


def position_map(uv: UvMap, verts: Tensor) -> Tensor:
    """Draw per-vertex values into the map; zero where there is no face. Differentiable in ``verts``.

    Args:
        uv: Made by :func:`uv_map`.
        verts: Positions [m] or any other values, shape [V, C], float32 or float64.

    Returns:
        The map, shape [C, H, W], in the unit of ``verts``.

    Raises:
        ValueError: If ``verts`` does not fit the map.
    """
    return sparse_apply(uv.matrix, verts).T.reshape(verts.shape[1], *uv.face_ids.shape)


def _neighbours(at: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the two texels around each place [texels] along one axis, clamped to the map, and the second's weight."""
    inside = torch.nan_to_num(at - 0.5, nan=0.0).clamp(0, size - 1)
    low = inside.floor().clamp(max=max(size - 2, 0))
    return low.long(), (low.long() + 1).clamp(max=size - 1), inside - low


def uv_sampler(uv: Tensor, height: int, width: int) -> SparseMatrix:
    """Prepare bilinear samples of maps at fixed places; border texels continue outside the map.

    Args:
        uv: Texture coordinates, v up, shape [N, 2], float32 or float64; NaN reads the first texels.
        height: Rows H of the maps.
        width: Columns W of the maps.

    Returns:
        The matrix from texels, row by row, to samples, shape [N, H W], on the device of ``uv``.

    Raises:
        ValueError: If ``uv`` is not [N, 2] or the maps have no texel.
    """
    if uv.ndim != 2 or uv.shape[1] != 2:
        raise ValueError(f"uv must have shape [N, 2], got {tuple(uv.shape)}")
    if height < 1 or width < 1:
        raise ValueError(f"a map needs at least one texel, got {height} x {width}")
    exact = uv.detach().double()
    left, right, x = _neighbours(exact[:, 0] * width, width)
    top, bottom, y = _neighbours((1.0 - exact[:, 1]) * height, height)
    cols = torch.stack([top * width + left, top * width + right, bottom * width + left, bottom * width + right], 1)
    weights = torch.stack([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x], 1)
    rows = torch.arange(len(uv), device=uv.device).repeat_interleave(4)
    return SparseMatrix.from_coo(rows, cols.reshape(-1), weights.reshape(-1), (len(uv), height * width))


def sample_map(maps: Tensor, uv: Tensor, *, sampler: SparseMatrix | None = None) -> Tensor:
    """Sample maps bilinearly at UV coordinates; border texels continue outside. Differentiable in ``maps``.

    Args:
        maps: Maps, shape [C, H, W], float32 or float64.
        uv: Texture coordinates, v up, shape [N, 2].
        sampler: :func:`uv_sampler` of ``uv``; without it, it is prepared on every call.

    Returns:
        Samples, shape [N, C].

    Raises:
        ValueError: If a shape is wrong or ``sampler`` was made for another map.
    """
    if maps.ndim != 3:
        raise ValueError(f"maps must have shape [C, H, W], got {tuple(maps.shape)}")
    sampler = uv_sampler(uv, maps.shape[1], maps.shape[2]) if sampler is None else sampler
    return sparse_apply(sampler, maps.reshape(len(maps), -1).T)
