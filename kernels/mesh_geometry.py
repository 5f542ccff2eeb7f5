"""Normals and edge lengths of triangle meshes. No gradients: where they are used, they steer and do not learn."""

from __future__ import annotations

import torch
from torch import Tensor

from mgavatar.kernels.sparse import SparseMatrix, sparse_apply

_NO_AREA = 1e-18
"""Twice the area [m^2] below which a normal is zero: the square of its length still fits float32."""


def corner_sum(faces: Tensor, n_verts: int) -> SparseMatrix:
    """Build the matrix that adds the values of faces up at their corners.

    It is the transpose of a gather, so sums have a fixed order: the same bits on every run, unlike ``index_add_``.

    Args:
        faces: Vertex indices, shape [F, 3], integers.
        n_verts: Number of vertices V.

    Returns:
        Ones from each face to its three vertices, shape [V, F], on the device of ``faces``.

    Raises:
        ValueError: If ``faces`` is not [F, 3] or an index is outside the vertices.
    """
    _check_faces(faces)
    corners = faces.reshape(-1)
    owners = torch.arange(len(faces), device=faces.device).repeat_interleave(3)
    ones = torch.ones(len(corners), device=faces.device)
    return SparseMatrix.from_coo(corners, owners, ones, (n_verts, len(faces)))


@torch.no_grad()
def face_normals(verts: Tensor, faces: Tensor) -> Tensor:
    """Return unit normals of faces, by the right-hand rule. No gradient.

    Args:
        verts: Vertices [m], shape [V, 3], float32 or float64.
        faces: Vertex indices, shape [F, 3], integers.

    Returns:
        Normals, shape [F, 3]; zero where a face has no area.

    Raises:
        ValueError: If a shape is wrong.
    """
    return _units(_area_vectors(verts, faces))


@torch.no_grad()
def vertex_normals(verts: Tensor, faces: Tensor, *, corners: SparseMatrix | None = None) -> Tensor:
    """Return unit normals of vertices: the mean of the adjacent faces' normals weighted by area. No gradient.

    Args:
        verts: Vertices [m], shape [V, 3], float32 or float64.
        faces: Vertex indices, shape [F, 3], integers.
        corners: :func:`corner_sum` of ``faces``; without it, it is prepared on every call.

    Returns:
        Normals, shape [V, 3]; zero where a vertex has no face with an area.

    Raises:
        ValueError: If a shape is wrong, an index is outside the vertices, or ``corners`` is of another mesh.
    """
    corners = _corners(verts, faces, corners)
    return _units(sparse_apply(corners, _area_vectors(verts, faces)))


@torch.no_grad()
def vertex_edge_lengths(verts: Tensor, faces: Tensor, *, corners: SparseMatrix | None = None) -> Tensor:
    """Return the size of the mesh around each vertex: the mean over its faces of their mean edge. No gradient.

    Args:
        verts: Vertices [m], shape [V, 3], float32 or float64.
        faces: Vertex indices, shape [F, 3], integers.
        corners: :func:`corner_sum` of ``faces``; without it, it is prepared on every call.

    Returns:
        Lengths [m], shape [V]; zero where a vertex has no face.

    Raises:
        ValueError: As for :func:`vertex_normals`.
    """
    corners = _corners(verts, faces, corners)
    a, b, c = verts[faces.long()].unbind(1)
    means = ((b - a).norm(dim=1) + (c - b).norm(dim=1) + (a - c).norm(dim=1)) / 3
    # One pass gives the sum of the faces' means and, from the column of ones, the number of faces.
    total = sparse_apply(corners, torch.stack([means, torch.ones_like(means)], 1))
    return total[:, 0] / total[:, 1].clamp(min=1.0)


def _area_vectors(verts: Tensor, faces: Tensor) -> Tensor:
    """Return normals of faces whose lengths are twice the faces' areas [m^2], shape [F, 3]."""
    _check_verts(verts)
    _check_faces(faces)
    a, b, c = verts[faces.long()].unbind(1)
    return torch.cross(b - a, c - a, dim=1)


def _units(vectors: Tensor) -> Tensor:
    lengths = vectors.norm(dim=1, keepdim=True)
    return torch.where(lengths > _NO_AREA, vectors / lengths, 0.0)


def _corners(verts: Tensor, faces: Tensor, corners: SparseMatrix | None) -> SparseMatrix:
    _check_verts(verts)
    corners = corner_sum(faces, len(verts)) if corners is None else corners
    if corners.shape != (len(verts), len(faces)):
        raise ValueError(f"corners has shape {corners.shape} but there are {len(verts)} vertices, {len(faces)} faces")
    return corners


def _check_verts(verts: Tensor) -> None:
    if verts.ndim != 2 or verts.shape[1] != 3:
        raise ValueError(f"verts must have shape [V, 3], got {tuple(verts.shape)}")


def _check_faces(faces: Tensor) -> None:
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces must have shape [F, 3], got {tuple(faces.shape)}")
