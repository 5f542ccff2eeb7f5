"""A head model as tensors on a device, ready to be shaped, expressed and posed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from mgavatar.head.model import HeadModel
from mgavatar.head.params import Pose
from mgavatar.head.subdivide import subdivide
from mgavatar.kernels.face_frames import gather_matrix
from mgavatar.kernels.laplacian import laplacian_matrix
from mgavatar.kernels.lbs import blend_shapes, joint_transforms, skin
from mgavatar.kernels.mesh_geometry import corner_sum, vertex_edge_lengths, vertex_normals
from mgavatar.kernels.sparse import SparseMatrix, sparse_apply


class Body(nn.Module):
    """A subdivided head.

    Directions are linear, and so is subdivision: directions are evaluated on the base mesh, and their sum is then
    interpolated to the fine mesh, which is the same on a quarter of the vertices.

    Attributes:
        model: The head model as given, the base mesh.
        subdivisions: Number of midpoint subdivisions.
        fine: The head model after subdivision, without its directions.
        v_template: Rest vertices of the base mesh [m], shape [V_base, 3].
        shape_dirs: Identity directions [m per unit], shape [n_shape, V_base, 3].
        expr_dirs: Expression directions [m per unit], shape [n_expr, V_base, 3].
        pose_dirs: Pose correctives [m], shape [36, V_base, 3].
        has_pose_dirs: False if all pose correctives are zero.
        J_regressor: Joints from shaped vertices of the base mesh, shape [5, V_base].
        parents: Parent of each joint, -1 for the root, shape [5], int32, on the CPU.
        lbs_weights: Skinning weights of the fine mesh, shape [V, 5].
        faces: Vertex indices of the fine mesh, shape [F, 3], int32.
    """

    v_template: Tensor
    shape_dirs: Tensor
    expr_dirs: Tensor
    pose_dirs: Tensor
    J_regressor: Tensor
    lbs_weights: Tensor
    faces: Tensor

    def __init__(self, model: HeadModel, *, subdivisions: int, device: torch.device | str = "cpu") -> None:
        """Subdivide a head model and move it to a device.

        Args:
            model: The head model.
            subdivisions: Number of midpoint subdivisions; the paper's mesh is FLAME's after one.
            device: Device of all tensors.
        """
        super().__init__()
        self.model = model
        self.subdivisions = subdivisions
        self.fine, self._subdivision = _subdivided(model, subdivisions)
        dirs = np.moveaxis(model.shapedirs, 2, 0)
        arrays = {
            "v_template": model.v_template,
            "shape_dirs": dirs[: model.n_shape],
            "expr_dirs": dirs[model.n_shape :],
            "pose_dirs": np.moveaxis(model.posedirs, 2, 0),
            "J_regressor": model.J_regressor,
            "lbs_weights": self.fine.lbs_weights,
        }
        for name, array in arrays.items():
            # Not persistent: an avatar file has the head model itself.
            self.register_buffer(name, torch.tensor(np.ascontiguousarray(array), dtype=torch.float32), persistent=False)
        self.register_buffer("faces", torch.tensor(self.fine.faces, dtype=torch.int32), persistent=False)
        self.has_pose_dirs = bool(np.any(model.posedirs))
        self.parents = torch.tensor(model.parents, dtype=torch.int32)  # no buffer: only the host reads it
        self.to(device)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Body:
        """Move the matrices with the tensors; torch calls this for ``to`` and ``cuda``."""
        super()._apply(fn, recurse)
        self._subdivision = [step.to(self.device) for step in self._subdivision]
        for name in ("laplacian", "face_corners", "_corners"):
            self.__dict__.pop(name, None)  # built again from the moved faces when needed
        return self

    @property
    def device(self) -> torch.device:
        """Return the device of all tensors but ``parents``."""
        return self.v_template.device

    @property
    def n_verts(self) -> int:
        """Return the number of vertices of the fine mesh, V."""
        return len(self.fine.v_template)

    @cached_property
    def laplacian(self) -> SparseMatrix:
        """Build the neighbour-mean Laplacian of the fine mesh, shape [V, V]."""
        return laplacian_matrix(self.faces, self.n_verts).to(self.device)

    @cached_property
    def face_corners(self) -> SparseMatrix:
        """Build the matrix from vertices to the corners of the faces, which face frames take, shape [3 F, V]."""
        return gather_matrix(self.faces, self.n_verts)

    @cached_property
    def _corners(self) -> SparseMatrix:
        return corner_sum(self.faces, self.n_verts)

    def carry(self, values: Tensor) -> Tensor:
        """Interpolate per-vertex values of the base mesh to the fine one: shape [V_base, C] to [V, C]."""
        for step in self._subdivision:
            values = sparse_apply(step, values)
        return values

    def shaped(self, betas: Tensor) -> Tensor:
        """Return the neutral head of an identity, ``T{beta}`` of Section 3.1.

        Args:
            betas: Identity coefficients, shape [n_shape].

        Returns:
            Vertices [m], shape [V, 3].
        """
        return self.carry(blend_shapes(self.v_template, self.shape_dirs, betas))

    def joints(self, canonical: Tensor) -> Tensor:
        """Regress the joints of a canonical head.

        Args:
            canonical: Neutral vertices with identity offsets, which move the joints as in VHAP [m], shape [V, 3].

        Returns:
            Rest joints [m], shape [5, 3].
        """
        # Subdivision keeps the base vertices and puts them first.
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
        """Return unit vertex normals, shape [V, 3], zero at vertices without a face; they have no gradient."""
        return vertex_normals(verts, self.faces, corners=self._corners)

    def edge_lengths(self, verts: Tensor) -> Tensor:
        """Return the mean length of the edges around each vertex [m], shape [V]; it has no gradient."""
        return vertex_edge_lengths(verts, self.faces, corners=self._corners)


def _subdivided(model: HeadModel, times: int) -> tuple[HeadModel, list[SparseMatrix]]:
    """Return the fine mesh without its directions, and the matrix of each subdivision, [V_fine, V_coarse]."""
    fine = replace(model, shapedirs=model.shapedirs[:, :, :0], posedirs=model.posedirs[:, :, :0], n_shape=0, n_expr=0)
    steps = []
    for _ in range(times):
        n_verts = len(fine.v_template)
        fine, parents = subdivide(fine)
        rows = torch.arange(len(parents)).repeat_interleave(2)
        # A base vertex is its own parent twice: its two halves add up to one.
        columns, halves = torch.from_numpy(parents.reshape(-1)), torch.full((len(rows),), 0.5)
        steps.append(SparseMatrix.from_coo(rows, columns, halves, (len(parents), n_verts)))
    return fine, steps
