"""Pairs of faces of one mesh that cross each other, for measuring geometry. Forward only."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from mgavatar.kernels import bridge
from mgavatar.kernels.ray_cast import RayMesh

wp.set_module_options({"enable_backward": False})


@wp.func
def _volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Return six times the signed volume of a tetrahedron; exactly 0 where ``d`` equals another corner."""
    return wp.dot(a - d, wp.cross(b - d, c - d))


@wp.func
def _pierces(p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> bool:
    """Return True if a segment passes through the inside of a triangle; touching does not count."""
    # Its ends lie on different sides of the plane, and seen along it the triangle's edges all turn the same way.
    zero = wp.float64(0.0)
    above, below = _volume(a, b, c, p), _volume(a, b, c, q)
    if not above * below < zero:
        return False
    first, second, third = _volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)
    return (first > zero and second > zero and third > zero) or (first < zero and second < zero and third < zero)


@wp.func
def _crosses(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, e: wp.vec3d, f: wp.vec3d) -> bool:
    """Return True if two triangles cross: then an edge of one of them passes through the other."""
    by_first = _pierces(a, b, d, e, f) or _pierces(b, c, d, e, f) or _pierces(c, a, d, e, f)
    return by_first or _pierces(d, e, a, b, c) or _pierces(e, f, a, b, c) or _pierces(f, d, a, b, c)


@wp.func
def _are_neighbours(face: wp.vec3i, other: wp.vec3i) -> bool:
    """Return True if two faces have a vertex in common."""
    for i in range(3):
        if face[i] == other[0] or face[i] == other[1] or face[i] == other[2]:
            return True
    return False


@wp.func
def _double(v: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.kernel
def _crossings_kernel(
    # In:
    first: int,
    mesh: wp.uint64,
    verts: wp.array[wp.vec3],  # [V]
    faces: wp.array[wp.vec3i],  # [F]
    starts: wp.array[wp.int64],  # [F] first entry of each face in partners
    n_places: wp.int64,  # P, or 0 to count only
    # Out:
    counts: wp.array[wp.int32],  # [F]
    partners: wp.array[wp.int32],  # [P]
) -> None:
    n = first + wp.tid()
    face = faces[n]
    a, b, c = verts[face[0]], verts[face[1]], verts[face[2]]
    count = wp.int32(0)
    query = wp.mesh_query_aabb(mesh, wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c))
    m = wp.int32(0)
    while wp.mesh_query_aabb_next(query, m):
        other = faces[m]
        # Each pair is tested once, by its smaller face.
        if m > n and not _are_neighbours(face, other):
            d, e, f = verts[other[0]], verts[other[1]], verts[other[2]]
            if _crosses(_double(a), _double(b), _double(c), _double(d), _double(e), _double(f)):
                # The first pass has no room and only counts; the second has exactly the room that was counted.
                if starts[n] + wp.int64(count) < n_places:
                    partners[starts[n] + wp.int64(count)] = m
                count += 1
    counts[n] = count


def crossing_faces(verts: Tensor, faces: Tensor) -> Tensor:
    """List pairs of faces of a mesh that cross each other and have no vertex in common.

    Volumes are computed in double precision. Faces that only touch, and faces in one plane, do not cross.

    Args:
        verts: Vertices [m], shape [V, 3], float32.
        faces: Vertex indices, shape [F, 3], int32; F may be 0.

    Returns:
        Face indices, the smaller one first, each pair once and in ascending order, shape [P, 2], int64.

    Raises:
        ValueError: If a shape or dtype is wrong, a vertex is not finite, or an index is out of range.
    """
    mesh = RayMesh(verts, faces)
    n_faces, device = len(faces), faces.device
    counts = torch.zeros(n_faces, dtype=torch.int32, device=device)
    if not n_faces:
        return torch.zeros(0, 2, dtype=torch.int64, device=device)

    def run(starts: Tensor, partners: Tensor, n_places: int) -> None:
        inputs = (mesh.id, verts.detach(), faces, starts, n_places)
        bridge.launch_ranges(_crossings_kernel, n_faces, inputs, (counts, partners))

    run(torch.zeros(n_faces, dtype=torch.int64, device=device), torch.zeros(1, dtype=torch.int32, device=device), 0)
    ends = counts.cumsum(0)
    partners = torch.empty(max(int(ends[-1]), 1), dtype=torch.int32, device=device)
    run(ends - counts, partners, int(ends[-1]))
    # The hierarchy returns a face's partners in any order; one sort of (face, partner) as a single number orders both.
    owners = torch.arange(n_faces, device=device).repeat_interleave(counts.long())
    codes = (owners * n_faces + partners[: len(owners)].long()).sort().values
    return torch.stack([codes // n_faces, codes % n_faces], dim=1)
