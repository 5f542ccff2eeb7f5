"""The head model in FLAME's schema, of any topology and with any number of directions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

JOINTS = ("root", "neck", "jaw", "left_eye", "right_eye")


@dataclass(frozen=True, eq=False)
class HeadModel:
    """A rigged head in metres: x to the subject's left, y up, z forward.

    Attributes:
        v_template: Rest vertices [m], shape [V, 3], float32.
        faces: Vertex indices, counter-clockwise from outside, shape [F, 3], int32.
        shapedirs: Identity, then expression directions [m per unit], shape [V, 3, n_shape + n_expr], float32.
        n_shape: Number of identity directions.
        n_expr: Number of expression directions.
        posedirs: Pose correctives [m], shape [V, 3, 36], float32.
        J_regressor: Joints from shaped vertices, rows sum to 1, shape [5, V], float32.
        lbs_weights: Skinning weights, rows sum to 1, shape [V, 5], float32.
        parents: Parent of each joint, -1 for the root, shape [5], int32.
        vt: Texture coordinates, v up, shape [U, 2], float32.
        ft: Texture indices of each face, shape [F, 3], int32.
        masks: Named vertex regions (``face``, ``scalp``, ``neck``, ``boundary``, ...), each shape [V], bool.
        expr_basis: Name of the space of expressions: ``"flame2020"``, ``"flame2023"``, ``"procedural"``, a name from
            the file, or ``"unknown"``.
        expr_names: Names of the expression directions, or an empty tuple.
        name: Name of the model's file, for messages and provenance.
    """

    v_template: np.ndarray
    faces: np.ndarray
    shapedirs: np.ndarray
    n_shape: int
    n_expr: int
    posedirs: np.ndarray
    J_regressor: np.ndarray
    lbs_weights: np.ndarray
    parents: np.ndarray
    vt: np.ndarray
    ft: np.ndarray
    masks: dict[str, np.ndarray] = field(default_factory=dict)
    expr_basis: str = "unknown"
    expr_names: tuple[str, ...] = ()
    name: str = "head model"
