"""Rays cast at triangle meshes: distance, face and barycentric weights of the nearest hit.

For synthetic captures, previews and visibility. Nothing here is differentiable: the module has no adjoints.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from mgavatar.kernels.bridge import launch_ranges, to_warp, torch_stream

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e30)
"""Longest distance that a ray travels [m]."""


@wp.func
def is_ray(origin: wp.vec3, direction: wp.vec3) -> bool:
    """Return True if a ray can hit anything; NaN fails these comparisons, as infinity and a zero direction do."""
    length = wp.length_sq(direction)
    return length > 0.0 and length < FAR and wp.length_sq(origin) < FAR


@wp.kernel
def _ray_cast_kernel(
    # In:
    first: int,
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],  # [N]
    directions: wp.array[wp.vec3],  # [N]
    # Out:
    depths: wp.array[float],  # [N]
    face_ids: wp.array[wp.int32],  # [N]
    barycentrics: wp.array[wp.vec3],  # [N]
) -> None:
    n = first + wp.tid()
    depth = float(wp.inf)
    face = wp.int32(-1)
    weights = wp.vec3(0.0, 0.0, 0.0)
    if is_ray(origins[n], directions[n]):
        length = wp.length(directions[n])
        hit = wp.mesh_query_ray(mesh, origins[n], directions[n] / length, FAR)
        if hit.result:
            depth = hit.t / length
            face = hit.face
            weights = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
    depths[n] = depth
    face_ids[n] = face
    barycentrics[n] = weights


class RayMesh:
    """A triangle mesh with its bounding volume hierarchy, kept between calls.

    Args:
        verts: Vertices [m], shape [V, 3], float32.
        faces: Vertex indices, shape [F, 3], int32; F may be 0.

    Raises:
        ValueError: If a shape or dtype is wrong, a vertex is not finite, or an index is out of range.
    """

    def __init__(self, verts: Tensor, faces: Tensor) -> None:
        _check_mesh(verts, faces)
        # Both are kept alive here: the hierarchy reads them at every query.
        self._verts = verts.detach().clone(memory_format=torch.contiguous_format)
        self._indices = faces.detach().reshape(-1).contiguous().clone()
        self._mesh: wp.Mesh | None = None
        if len(faces):
            with torch_stream(verts.device):
                self._mesh = wp.Mesh(to_warp(self._verts, wp.vec3), to_warp(self._indices, wp.int32))

    @property
    def id(self) -> int:
        """Return the handle that kernels take as ``wp.uint64``; 0 for a mesh without faces: it must not be queried."""
        return 0 if self._mesh is None else int(self._mesh.id)

    def move(self, verts: Tensor) -> None:
        """Move the vertices and refit the hierarchy, which is far cheaper than building it.

        Args:
            verts: New positions [m], shape [V, 3], float32.

        Raises:
            ValueError: If the number of vertices changes or one is not finite.
        """
        if verts.shape != self._verts.shape or verts.device != self._verts.device:
            raise ValueError(f"the mesh has vertices {tuple(self._verts.shape)}, the new ones are {tuple(verts.shape)}")
        _check_finite(verts)
        self._verts.copy_(verts)
        if self._mesh is not None:
            with torch_stream(verts.device):
                self._mesh.refit()

    def cast(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Find the nearest hit of each ray, from either side of a face; see :func:`ray_cast`."""
        for name, rays in (("origins", origins), ("directions", directions)):
            if rays.ndim != 2 or rays.shape[1] != 3 or rays.dtype != torch.float32:
                raise ValueError(f"{name} must be float32 of shape [N, 3], got {rays.dtype} {tuple(rays.shape)}")
        if len(origins) != len(directions):
            raise ValueError(f"there are {len(origins)} origins but {len(directions)} directions")
        n_rays, device = len(origins), origins.device
        depths = torch.full((n_rays,), torch.inf, device=device)
        face_ids = torch.full((n_rays,), -1, dtype=torch.int32, device=device)
        barycentrics = torch.zeros((n_rays, 3), device=device)
        if n_rays and self._mesh is not None:
            outputs = (depths, face_ids, barycentrics)
            launch_ranges(_ray_cast_kernel, n_rays, (self.id, origins, directions), outputs)
        return depths, face_ids, barycentrics


def ray_cast(verts: Tensor, faces: Tensor, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find the nearest hit of each ray with a mesh, from either side of a face.

    A ray with a zero or non-finite direction, or a non-finite origin, misses. The hit point is
    ``origins + depths * directions``; up to rounding it is the barycentric mean of its face's vertices.

    Args:
        verts: Vertices [m], shape [V, 3], float32.
        faces: Vertex indices, shape [F, 3], int32; F may be 0.
        origins: Starting points [m], shape [N, 3], float32.
        directions: Directions of any length, shape [N, 3], float32.

    Returns:
        ``depths`` in units of the direction's length, inf for a miss, shape [N], float32; ``face_ids``, -1 for a miss,
        shape [N], int32; ``barycentrics`` of the face's three vertices, zeros for a miss, shape [N, 3], float32.

    Raises:
        ValueError: If a shape or dtype is wrong, a vertex is not finite, or an index is out of range.
    """
    return RayMesh(verts, faces).cast(origins, directions)


def camera_rays(
    viewmat: Tensor, K: Tensor, width: int, height: int, *, offsets: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Build rays through the pixels of a pinhole camera, row by row; depths along them are camera depths (z).

    Args:
        viewmat: World to camera, OpenCV axes, shape [4, 4].
        K: Intrinsics [px], shape [3, 3].
        width: Image width [px].
        height: Image height [px].
        offsets: Sample positions inside a pixel, x then y, in 0..1, shape [S, 2]; the pixel's centre by default.

    Returns:
        ``origins`` [m] and ``directions`` (camera z = 1), each shape [height * width * S, 3], float32.
    """
    viewmat, K = viewmat.double(), K.double()
    samples = torch.full((1, 2), 0.5) if offsets is None else offsets
    samples = samples.to(viewmat)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    corners = torch.stack([columns, rows], dim=-1).to(viewmat)  # [H, W, 2]
    pixels = torch.nn.functional.pad(corners[:, :, None] + samples, (0, 1), value=1.0).reshape(-1, 3)
    directions = pixels @ torch.linalg.inv(K).T @ viewmat[:3, :3]
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    return origin.expand_as(directions).float().contiguous(), directions.float()


def _check_finite(verts: Tensor) -> None:
    if not bool(torch.isfinite(verts).all()):
        raise ValueError("verts has values that are not finite")


def _check_mesh(verts: Tensor, faces: Tensor) -> None:
    if verts.ndim != 2 or verts.shape[1] != 3 or verts.dtype != torch.float32:
        raise ValueError(f"verts must be float32 of shape [V, 3], got {verts.dtype} {tuple(verts.shape)}")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype != torch.int32:
        raise ValueError(f"faces must be int32 of shape [F, 3], got {faces.dtype} {tuple(faces.shape)}")
    _check_finite(verts)
    if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(verts):
        raise ValueError(f"faces has indices outside 0..{len(verts) - 1}")
