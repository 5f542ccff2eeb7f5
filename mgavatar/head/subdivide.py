"""Midpoint subdivision of a head model (Section 3.1: 5K vertices and 10K faces become 20K and 40K)."""

from __future__ import annotations

import numpy as np

from mgavatar.head.model import HeadModel


def subdivide(model: HeadModel) -> tuple[HeadModel, np.ndarray]:
    """Split every face into four at the midpoints of its edges; values of new vertices are means of both ends.

    Shaping the fine head gives the same vertices as subdividing the shaped base head. Joints stay where they were: the
    regressor's columns of new vertices are zero. A midpoint is in a mask if both ends of its edge are. Texture
    coordinates are split along their own edges, so seams stay seams.

    Args:
        model: The head to subdivide.

    Returns:
        The finer head, and the two base vertices whose mean each of its vertices is, as in :func:`split_faces`.
    """
    n_verts = len(model.v_template)
    faces, parents = split_faces(model.faces, n_verts)
    ft, uv_parents = split_faces(model.ft, len(model.vt))
    fine = HeadModel(
        v_template=_mean(model.v_template, parents),
        faces=faces,
        shapedirs=_mean(model.shapedirs, parents),
        n_shape=model.n_shape,
        n_expr=model.n_expr,
        posedirs=_mean(model.posedirs, parents),
        J_regressor=np.pad(model.J_regressor, ((0, 0), (0, len(parents) - n_verts))),
        lbs_weights=_mean(model.lbs_weights, parents),
        parents=model.parents,
        vt=_mean(model.vt, uv_parents),
        ft=ft,
        masks={name: mask[parents[:, 0]] & mask[parents[:, 1]] for name, mask in model.masks.items()},
        expr_basis=model.expr_basis,
        expr_names=model.expr_names,
        name=model.name,
    )
    return fine, parents


def split_faces(faces: np.ndarray, n_verts: int) -> tuple[np.ndarray, np.ndarray]:
    """Split every triangle into four at the midpoints of its edges.

    Args:
        faces: Vertex indices, shape [F, 3].
        n_verts: Number of vertices, V.

    Returns:
        The finer faces, shape [4F, 3], int32, of which 4i to 4i + 3 come from face i: those at its three corners, then
        the middle one; and the two vertices whose mean each fine vertex is, shape [V + E, 2], int32. The base vertices
        come first, each with itself, then one midpoint per edge in the order of its ends.
    """
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).astype(np.int64)  # [F, 3, 2]: ab, bc, ca
    # Two faces run along their common edge in opposite directions. With the lower end first, and both ends in one
    # number, the edge has the same key in both, and so one midpoint.
    ends.sort(axis=-1)
    keys = ends[..., 0] * n_verts + ends[..., 1]
    edges, edge_of_side = np.unique(keys, return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = (n_verts + edge_of_side.reshape(faces.shape)).T
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]  # each keeps the face's orientation
    fine = np.stack([np.stack(corners, axis=-1) for corners in quarters], axis=1).reshape(-1, 3)
    base = np.arange(n_verts)
    base_parents = np.stack([base, base], axis=1)
    edge_parents = np.stack(np.divmod(edges, n_verts), axis=1)
    return fine.astype(np.int32), np.concatenate([base_parents, edge_parents]).astype(np.int32)


def _mean(values: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Average values of both parents for every fine vertex; values of base vertices are copied bit for bit."""
    n_base = len(values)
    fine = np.empty((len(parents), *values.shape[1:]), values.dtype)
    fine[:n_base] = values
    fine[n_base:] = values[parents[n_base:, 0]]
    fine[n_base:] += values[parents[n_base:, 1]]
    fine[n_base:] *= 0.5
    return fine
