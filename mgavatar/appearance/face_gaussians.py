"""Face-bound Gaussians: local parameters, and their way to the world (Section 3.2, Eq. 8)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mgavatar.config import ResolvedAppearanceConfig
from mgavatar.kernels.binding import place_on_faces
from mgavatar.kernels.face_frames import face_frames
from mgavatar.kernels.sparse import SparseMatrix

PARAMETERS = ("local_means", "quats", "log_scales", "opacity_logits")
"""Learnable parameters of every Gaussian, one row each; ``face_ids`` has the same rows."""

SH_PARAMETERS = ("sh_constant", "sh_others")
"""Further ones if colours are spherical harmonics."""


@dataclass(frozen=True, eq=False)
class FaceFrames:
    """R, k and T of every face of a posed mesh (Eq. 8).

    Attributes:
        quats: Rotations wxyz, shape [F, 4].
        scales: Sizes k [m], shape [F].
        centers: Centroids T [m], shape [F, 3].
    """

    quats: Tensor
    scales: Tensor
    centers: Tensor

    @staticmethod
    def of(verts: Tensor, faces: Tensor, *, corners: SparseMatrix | None = None) -> FaceFrames:
        """Compute the frames of a mesh, differentiable in its vertices.

        Args:
            verts: Vertices [m], shape [V, 3].
            faces: Vertex indices, shape [F, 3], int32.
            corners: :func:`~mgavatar.kernels.face_frames.gather_matrix` of ``faces``; prepared here by default.
        """
        return FaceFrames(*face_frames(verts, faces, order=corners))

    @property
    def all(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return rotations, sizes and centroids, the arguments of the kernels."""
        return self.quats, self.scales, self.centers


class FaceGaussians(nn.Module):
    """Gaussians bound to faces: at first one per face, at its centre; density control adds and removes others.

    Attributes:
        parameter_names: Names of the parameters, with N rows each.
        local_means: Centres mu* in units of k, shape [N, 3].
        quats: Rotations wxyz in the face's frame, of any length, shape [N, 4].
        log_scales: Logarithms of the standard deviations in units of k, shape [N, 3].
        opacity_logits: Shape [N].
        face_ids: Face that owns each Gaussian, shape [N], int64.
        uvs: Texture coordinate below each Gaussian, shape [N, 2].
    """

    face_ids: Tensor
    uvs: Tensor

    def __init__(self, n_faces: int, config: ResolvedAppearanceConfig, device: torch.device) -> None:
        """Put a flat Gaussian of the configured size and opacity on each face."""
        super().__init__()
        self.n_faces = n_faces
        along, across = config.initial_scale, config.initial_thickness
        scales = torch.tensor([along, across, along], device=device)  # axes of a face: edge, normal, cross product
        quats = torch.zeros(n_faces, 4, device=device)
        quats[:, 0] = 1.0
        logit = torch.logit(torch.tensor(config.initial_opacity)).item()
        self.local_means = nn.Parameter(torch.zeros(n_faces, 3, device=device))
        self.quats = nn.Parameter(quats)
        self.log_scales = nn.Parameter(scales.log().repeat(n_faces, 1))
        self.opacity_logits = nn.Parameter(torch.full((n_faces,), logit, device=device))
        self.parameter_names: tuple[str, ...] = PARAMETERS
        if config.colors == "sh":
            self.parameter_names += SH_PARAMETERS
            n_others = (config.sh.degree + 1) ** 2 - 1
            self.sh_constant = nn.Parameter(torch.zeros(n_faces, 3, device=device))
            self.sh_others = nn.Parameter(torch.zeros(n_faces, n_others, 3, device=device))
        self.register_buffer("face_ids", torch.arange(n_faces, device=device))
        self.register_buffer("uvs", torch.zeros(n_faces, 2, device=device))

    def __len__(self) -> int:
        return len(self.face_ids)

    def canonical_means(self, frames: FaceFrames) -> Tensor:
        """Place the centres on the canonical mesh, ``mu_c`` of Eq. 9, without a gradient.

        Args:
            frames: Frames of the canonical mesh.

        Returns:
            Centres [m], shape [N, 3].
        """
        with torch.no_grad():
            return place_on_faces(frames.all, self.face_ids, self.local_means)

    def resize(self, n: int) -> None:
        """Make room for ``n`` Gaussians, whose state is then loaded."""
        for name in self.parameter_names:
            old = getattr(self, name)
            setattr(self, name, nn.Parameter(old.new_zeros(n, *old.shape[1:])))
        self.face_ids = self.face_ids.new_zeros(n)
        self.uvs = self.uvs.new_zeros(n, 2)


def face_uvs(
    local_means: Tensor, face_ids: Tensor, frames: FaceFrames, verts: Tensor, faces: Tensor, face_vt: Tensor
) -> Tensor:
    """Return the texture coordinates below the Gaussians' centres, projected onto their faces along the normal.

    A projection that falls outside of its face is moved into it.

    Args:
        local_means: Centres in units of their face's scale k, shape [N, 3].
        face_ids: Face of each Gaussian, shape [N].
        frames: Frames of the canonical mesh.
        verts: Canonical vertices [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        face_vt: Texture coordinates of the faces' corners, shape [F, 3, 2].

    Returns:
        Texture coordinates, shape [N, 2].
    """
    with torch.no_grad():
        points = place_on_faces(frames.all, face_ids, local_means)
        a, b, c = verts[faces.long()[face_ids]].unbind(1)
        # Barycentric weights v and w of the projection: d - v e1 - w e2 is normal to both edges. These are two linear
        # equations, solved by Cramer's rule. The determinant is four times the squared area.
        e1, e2, d = b - a, c - a, points - a
        d11, d12, d22 = (e1 * e1).sum(1), (e1 * e2).sum(1), (e2 * e2).sum(1)
        p1, p2 = (d * e1).sum(1), (d * e2).sum(1)
        det = (d11 * d22 - d12 * d12).clamp(min=1e-20)
        v = (d22 * p1 - d12 * p2) / det
        w = (d11 * p2 - d12 * p1) / det
        # Outside of the face a weight is negative. The weights sum to 1, so after clamping to at least 1, and dividing
        # by the sum gives a point of the face.
        weights = torch.stack([1 - v - w, v, w], 1).clamp(min=0.0)
        weights = weights / weights.sum(1, keepdim=True)
        return (weights[:, :, None] * face_vt[face_ids]).sum(1)
