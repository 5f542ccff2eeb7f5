"""One midpoint subdivision of the template (Section 3.1: 5K vertices and 10K faces become 20K and 40K)."""

from __future__ import annotations

import numpy as np

from mgavatar.head.model import HeadModel


def subdivide(model: HeadModel) -> tuple[HeadModel, np.ndarray]:
    """Split every face in four at the midpoints of its edges and carry all that belongs to a vertex along linearly.

    The shaped fine head is the shaped base head, subdivided. Joints stay where they were: new vertices have no part in
    them. Faces 4i to 4i + 3 come from face i. A midpoint is in a mask if both ends of its edge are. Texture
    coordinates are split along their own edges, so seams stay seams.

    Args:
        model: The head to subdivide.

    Returns:
        The finer head, and the base vertices that each of its vertices is the mean of, shape [V_fine, 2], int32; the
        base vertices come first, in their order, each with itself.
    """
    n_verts = len(model.v_template)
    faces, parents = _split(model.faces, n_verts)
    ft, uv_parents = _split(model.ft, len(model.vt))
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


def _mean(values: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Values of the fine vertices; those of the base vertices are copied bit for bit."""
    n_base = len(values)
    fine = np.empty((len(parents), *values.shape[1:]), values.dtype)
    fine[:n_base] = values
    fine[n_base:] = values[parents[n_base:, 0]]
    fine[n_base:] += values[parents[n_base:, 1]]
    fine[n_base:] *= 0.5
    return fine


def _split(faces: np.ndarray, n_verts: int) -> tuple[np.ndarray, np.ndarray]:
    """Four faces for each, [4F, 3], and the two ends whose mean each vertex is, [V + E, 2], both int32."""
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).astype(np.int64)  # [F, 3, 2]: ab, bc, ca
    ends.sort(axis=-1)
    edges, edge_of = np.unique(ends[..., 0] * n_verts + ends[..., 1], return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = (n_verts + edge_of.reshape(faces.shape)).T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    fine = np.stack([np.stack(face, axis=-1) for face in corners], axis=1).reshape(-1, 3)
    own = np.arange(n_verts)
    pairs = np.concatenate([np.stack([own, own], axis=1), np.stack(np.divmod(edges, n_verts), axis=1)])
    return fine.astype(np.int32), pairs.astype(np.int32)
