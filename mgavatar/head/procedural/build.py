"""The built-in head: a head model in FLAME's schema without licensed data, the same arrays at every call.

It is built in this order: the form of the head (``surface``), its triangulation (``sheet``), the mesh and its texture
atlas (``mesh``, with ``ear`` and ``parts``), joints and skinning (``rig``), identity and expression directions
(``identity``, ``expression``).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from mgavatar.head.model import HeadModel
from mgavatar.head.procedural.expression import expression_directions
from mgavatar.head.procedural.identity import identity_directions
from mgavatar.head.procedural.mesh import build_mesh
from mgavatar.head.procedural.rig import (
    PARENTS,
    jaw_share,
    joint_regressor,
    pose_correctives,
    regions,
    skinning_weights,
)


@lru_cache(maxsize=1)
def build_head() -> HeadModel:
    """Build the built-in head: about 5,000 vertices, 300 identity and 100 expression directions.

    It is built once per process (2 s) and shared: do not change its arrays.

    Returns:
        The head model, with ``expr_basis`` ``"procedural"``.
    """
    mesh = build_mesh()
    jaw = jaw_share(mesh)
    shape = identity_directions(mesh)
    expr, names = expression_directions(mesh, jaw)
    arrays = {
        "v_template": mesh.verts.astype(np.float32),
        "faces": mesh.faces.astype(np.int32),
        "shapedirs": np.concatenate([shape, expr], axis=-1).astype(np.float32),
        "posedirs": pose_correctives(mesh).astype(np.float32),
        "J_regressor": joint_regressor(mesh).astype(np.float32),
        "lbs_weights": skinning_weights(mesh, jaw).astype(np.float32),
        "parents": PARENTS.copy(),
        "vt": mesh.vt.astype(np.float32),
        "ft": mesh.ft.astype(np.int32),
    }
    return HeadModel(
        **arrays,
        n_shape=shape.shape[-1],
        n_expr=expr.shape[-1],
        masks=regions(mesh),
        expr_basis="procedural",
        expr_names=names,
        name="procedural head",
    )
