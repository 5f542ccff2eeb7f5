"""Geometry of triangle meshes in numpy and float64, for the built-in head and synthetic people."""

from __future__ import annotations

import numpy as np


def vertex_normals(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit vertex normals, the mean of the adjacent faces' normals weighted by area.

    :func:`mgavatar.kernels.mesh_geometry.vertex_normals` is the same for tensors.

    Args:
        verts: Vertices [m], shape [V, 3], float64.
        faces: Vertex indices, shape [F, 3], integers.

    Returns:
        Normals, shape [V, 3]; zero where a vertex has no face.
    """
    a, b, c = (verts[faces[:, corner]] for corner in range(3))
    doubled_areas = np.cross(b - a, c - a)
    corners = faces.ravel()
    # bincount adds one number per corner to its vertex, face after face: the order, and so the bits, are fixed.
    sums = [np.bincount(corners, np.repeat(doubled_areas[:, axis], 3), len(verts)) for axis in range(3)]
    total = np.stack(sums, axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20)
