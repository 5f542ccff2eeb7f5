"""A head model as tensors on a device: shape it, express it, pose it."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from mgavatar.head.model import HeadModel
from mgavatar.head.params import Pose
from mgavatar.head.subdivide import subdivide
from mgavatar.kernels.laplacian import laplacian_matrix
from mgavatar.kernels.lbs import blend_shapes, joint_transforms, skin
from mgavatar.kernels.mesh_geometry import corner_sum, vertex_edge_lengths, vertex_normals
from mgavatar.kernels.sparse import SparseMatrix, sparse_apply


class Body:
    """The subdivided head. Directions are linear, so they are evaluated on the base mesh and then carried over.

    Attributes:
        model: The head model as given.
        fine: The same after subdivision, without its directions.
    """

    def __init__(self, model: HeadModel, *, subdivisions: int, device: torch.device | str = "cpu") -> None:
        """Subdivide a head model and move it to a device.

        Args:
            model: The head model.
            subdivisions: Number of midpoint subdivisions; the paper's mesh is FLAME's after one.
            device: Device of all tensors.
        """
        self.model = model
        self.subdivisions = subdivisions
        self.device = torch.device(device)
        self.fine, steps = _subdivided(model, subdivisions)
        self._subdivision = [step.to(self.device) for step in steps]
        self.v_template = self._tensor(model.v_template)
        dirs = np.moveaxis(model.shapedirs, 2, 0)
        self.shape_dirs = self._tensor(dirs[: model.n_shape])
        self.expr_dirs = self._tensor(dirs[model.n_shape :])
        self.pose_dirs = self._tensor(np.moveaxis(model.posedirs, 2, 0))
        self.has_pose_dirs = bool(np.any(model.posedirs))
        self.J_regressor = self._tensor(model.J_regressor)
        self.parents = torch.tensor(model.parents, dtype=torch.int32)  # read by the host
        self.lbs_weights = self._tensor(self.fine.lbs_weights)
        self.faces = torch.tensor(self.fine.faces, dtype=torch.int32, device=self.device)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.tensor(np.ascontiguousarray(array), dtype=torch.float32, device=self.device)

    @property
    def n_verts(self) -> int:
        return len(self.fine.v_template)

    @cached_property
    def laplacian(self) -> SparseMatrix:
        """Neighbour-mean Laplacian of the fine mesh."""
        return laplacian_matrix(self.faces, self.n_verts).to(self.device)

    @cached_property
    def _corners(self) -> SparseMatrix:
        return corner_sum(self.faces, self.n_verts)

    def carry(self, values: Tensor) -> Tensor:
        """Per-vertex values of the base mesh, carried to the fine one; shape [V_base, C] to [V, C]."""
        for step in self._subdivision:
            values = sparse_apply(step, values)
        return values

    def shaped(self, betas: Tensor) -> Tensor:
        """The neutral head of an identity, ``T{beta}`` of Section 3.1; [n_shape] to [V, 3], metres."""
        return self.carry(blend_shapes(self.v_template, self.shape_dirs, betas))

    def joints(self, canonical: Tensor) -> Tensor:
        """Joints of a canonical head [m], shape [5, 3]; identity offsets move them, as in VHAP."""
        return self.J_regressor @ canonical[: len(self.v_template)]

    def posed(self, verts: Tensor, pose: Pose, *, joints: Tensor) -> Tensor:
        """Express and pose a neutral head (FLAME's forward pass).

        Args:
            verts: Neutral vertices with all offsets [m], shape [V, 3].
            pose: Expression and rotations.
            joints: Rest joints [m], shape [5, 3].

        Returns:
            Vertices in world space [m], shape [V, 3].
        """
        transforms, pose_feature = joint_transforms(joints, pose.joint_rotations(), self.parents)
        moved = blend_shapes(torch.zeros_like(self.v_template), self.expr_dirs, pose.expr)
        if self.has_pose_dirs:
            moved = blend_shapes(moved, self.pose_dirs, pose_feature)
        return skin(verts + self.carry(moved), self.lbs_weights, transforms) + pose.translation

    def normals(self, verts: Tensor) -> Tensor:
        """Return unit vertex normals, shape [V, 3]; zero where a vertex has no face. No gradient."""
        return vertex_normals(verts, self.faces, corners=self._corners)

    def edge_lengths(self, verts: Tensor) -> Tensor:
        """Return the mean length of the edges around each vertex [m], shape [V]. No gradient."""
        return vertex_edge_lengths(verts, self.faces, corners=self._corners)


def _subdivided(model: HeadModel, times: int) -> tuple[HeadModel, list[SparseMatrix]]:
    """The fine mesh without its directions, and the matrices that carry vertices to it one step at a time."""
    fine = replace(model, shapedirs=model.shapedirs[:, :, :0], posedirs=model.posedirs[:, :, :0], n_shape=0, n_expr=0)
    steps = []
    for _ in range(times):
        n_verts = len(fine.v_template)
        fine, parents = subdivide(fine)
        rows = torch.arange(len(parents)).repeat_interleave(2)
        columns, halves = torch.from_numpy(parents.reshape(-1)), torch.full((len(rows),), 0.5)
        steps.append(SparseMatrix.from_coo(rows, columns, halves, (len(parents), n_verts)))
    return fine, steps
