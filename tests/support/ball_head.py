"""A small head with every part that a head has, and no likeness: a ball."""

from __future__ import annotations

import numpy as np
import trimesh

from mgavatar.head.model import HeadModel


def ball_head(ball: trimesh.Trimesh | None = None, *, n_shape: int = 4, n_expr: int = 3, seed: int = 0) -> HeadModel:
    """A ball of 0.1 m with random directions and weights; the first face has texture coordinates of its own."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1) if ball is None else ball
    rng = np.random.default_rng(seed)
    verts = np.asarray(ball.vertices, np.float32)
    faces = np.asarray(ball.faces, np.int32)
    n_verts = len(verts)
    regressor, weights = rng.uniform(0.1, 1.0, (5, n_verts)), rng.uniform(0.1, 1.0, (n_verts, 5))
    ft = faces.copy()
    ft[0] = n_verts + np.arange(3)
    vt = np.concatenate([verts[:, :2] * 4.0 + 0.5, [[0.9, 0.9], [1.0, 0.9], [0.9, 1.0]]])
    return HeadModel(
        v_template=verts,
        faces=faces,
        shapedirs=rng.normal(0.0, 0.001, (n_verts, 3, n_shape + n_expr)).astype(np.float32),
        n_shape=n_shape,
        n_expr=n_expr,
        posedirs=rng.normal(0.0, 0.001, (n_verts, 3, 36)).astype(np.float32),
        J_regressor=(regressor / regressor.sum(axis=1, keepdims=True)).astype(np.float32),
        lbs_weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        parents=np.array([-1, 0, 1, 1, 1], np.int32),
        vt=vt.astype(np.float32),
        ft=ft,
        masks={"face": verts[:, 2] > 0.0, "neck": verts[:, 1] < -0.05},
        expr_basis="made up",
        expr_names=tuple(f"direction{index}" for index in range(n_expr)),
        name="ball",
    )
