"""Nearest points on a triangle mesh, for measuring geometry. Forward only."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from mgavatar.kernels import bridge

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _closest_point_kernel(
    # In:
    mesh: wp.uint64,
    points: wp.array[wp.vec3],  # [N]
    reach: wp.float32,
    # Out:
    closest: wp.array[wp.vec3],  # [N]
    face_ids: wp.array[wp.int32],  # [N] -1 if the mesh has no face within reach
):
    n = wp.tid()
    face_ids[n] = -1
    closest[n] = points[n]
    query = wp.mesh_query_point_no_sign(mesh, points[n], reach)
    if query.result:
        closest[n] = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        face_ids[n] = query.face


def closest_points(verts: Tensor, faces: Tensor, points: Tensor, *, reach: float = 1.0) -> tuple[Tensor, Tensor]:
    """Find the point of a mesh nearest to each query.

    Args:
        verts: Vertices [m], shape [V, 3], float32.
        faces: Vertex indices, shape [F, 3], int32.
        points: Queries [m], shape [N, 3], float32.
        reach: Largest distance searched [m].

    Returns:
        Nearest points [m], shape [N, 3], the query itself where nothing is in reach; and the faces that they lie on, -1
        where nothing is, shape [N], int32.

    Raises:
        ValueError: If a face has an index outside the vertices.
    """
    if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(verts):
        raise ValueError(f"faces name vertices {int(faces.min())}..{int(faces.max())} of {len(verts)}")
    vertex_array = bridge.to_warp(verts.contiguous(), wp.vec3)
    index_array = bridge.to_warp(faces.reshape(-1).contiguous(), wp.int32)
    closest = torch.empty_like(points)
    face_ids = torch.empty(len(points), dtype=torch.int32, device=points.device)
    if len(points):
        mesh = wp.Mesh(vertex_array, index_array)
        bridge.launch(_closest_point_kernel, len(points), [mesh.id, points, reach], [closest, face_ids])
    return closest, face_ids
