"""Vertex-bound Gaussians (Section 3.1)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from mgavatar.camera import Camera
from mgavatar.config import ResolvedConfig
from mgavatar.gaussians import SH_C0, Gaussians, draw
from mgavatar.geometry.head import PersonalHead, PosedHead
from mgavatar.kernels.rasterize import RasterSettings, Rendering


class VertexGaussians(nn.Module):
    """One Gaussian per vertex with few parameters: no rotation, one scale, opacity 1, one colour for all directions.

    Attributes:
        head: The personal head.
        log_scales: Logarithms of the standard deviations [m], shape [V].
        colors: Coefficients of Y_00 in RGB, 0 for grey, shape [V, 3].
        least_edge: Least length that the edges at a vertex count as [m].
        start_edges: Mean length of the edges at each vertex when the stage starts [m], shape [V].
    """

    start_edges: Tensor

    def __init__(self, head: PersonalHead, config: ResolvedConfig) -> None:
        """Start at a share of the edges' lengths, in grey."""
        super().__init__()
        self.head = head
        self.config = config
        # Vertices without a face, or with faces of no size, as between closed lips, would start with no size at all.
        edges = head.body.edge_lengths(head.body.shaped(head.betas.detach()))
        self.least_edge = 0.2 * float(edges[edges > 0].median())
        edges = edges.clamp(min=self.least_edge)
        self.log_scales = nn.Parameter(torch.log(config.geometry.initial_scale * edges))
        self.colors = nn.Parameter(torch.zeros(head.body.n_verts, 3, device=edges.device))
        self.register_buffer("start_edges", edges, persistent=False)

    def scales(self, posed: PosedHead) -> Tensor:
        """Return the standard deviation of every Gaussian [m], shape [V].

        With ``scales_follow_mesh``, it changes with the edges at its vertex as identity offsets stretch them.
        """
        scales = self.log_scales.exp()
        if not self.config.geometry.scales_follow_mesh:
            return scales
        # Of the canonical head: a pose must not change how large a Gaussian is.
        edges = self.head.body.edge_lengths(posed.shaped + posed.identity_offsets)
        return scales * (edges.clamp(min=self.least_edge) / self.start_edges)

    def bound(self, posed: PosedHead, camera: Camera, *, scales: Tensor | None = None) -> Gaussians:
        """Return the Gaussians on a posed head for a camera, behind the surface by :func:`silhouette_offset`.

        Args:
            posed: The posed head.
            camera: The camera.
            scales: The result of :meth:`scales` if it is at hand.
        """
        verts = posed.verts
        scales = self.scales(posed) if scales is None else scales
        shift = self.config.geometry.surface_shift
        if shift:
            # No gradient: a Gaussian could otherwise move by growing or by turning the surface.
            normals = self.head.body.normals(verts)
            depth = shift * silhouette_offset(scales.detach(), verts.detach(), normals.detach(), camera)
            verts = verts - depth[:, None] * normals
        n = len(verts)
        quats = torch.zeros(n, 4, device=verts.device)
        quats[:, 0] = 1.0
        ones = torch.ones(n, device=verts.device)
        return Gaussians(verts, quats, scales[:, None].expand(n, 3), ones, 0.5 + SH_C0 * self.colors)

    def render(
        self, posed: PosedHead, camera: Camera, background: Tensor, *, scales: Tensor | None = None
    ) -> Rendering:
        """Draw the Gaussians of a posed head; arguments as in :meth:`bound`, ``background`` of shape [3]."""
        gaussians = self.bound(posed, camera, scales=scales)
        return draw(gaussians, camera, background=background, config=self.config.raster)


def silhouette_offset(sigmas: Tensor, means: Tensor, normals: Tensor, camera: Camera) -> Tensor:
    """Return the depth below the surface at which one unit of ``surface_shift`` draws Gaussians.

    At an outline, opaque Gaussians look larger than their surface by about one sigma, seen from the front they do not:
    the depth is sigma times the sine of the angle between line of sight and normal. The sigma includes the low pass of
    the rasterizer at that distance, because the pixels widen the outline of small Gaussians as well.

    Args:
        sigmas: Standard deviations [m], shape [N].
        means: Centres in world space [m], shape [N, 3].
        normals: Unit normals of the surface, shape [N, 3].
        camera: The camera.

    Returns:
        Depths [m], shape [N].
    """
    # The third row of the view matrix gives depths, and depth over focal length is the size of a pixel there.
    row = torch.from_numpy(camera.viewmat[2].astype(np.float32)).to(means.device)
    pixels = (means @ row[:3] + row[3]) / float(camera.K[0, 0])
    away = means - torch.tensor(camera.position, dtype=torch.float32, device=means.device)
    sine = torch.linalg.cross(torch.nn.functional.normalize(away, dim=1), normals).norm(dim=1)
    return sine * (sigmas.square() + RasterSettings.low_pass * pixels.square()).sqrt()
