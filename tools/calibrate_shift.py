"""Calibrate how far behind the surface Gaussians are drawn, on a ball of known radius (docs/lab/geometry.md).

    python tools/calibrate_shift.py

A ball is photographed from a ring of cameras, as a plain disc or with a texture. Vertex-bound Gaussians on an icosphere
learn its radius, and on the texture their colours, from the photometric loss of Eq. 4 alone. They are drawn behind
their vertices as the geometry stage draws them. The table shows the remaining error of the radius at several shifts.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
import trimesh
from torch import Tensor

from mgavatar.camera import Camera, look_at
from mgavatar.config import ImageLossConfig, RasterConfig
from mgavatar.gaussians import Gaussians, draw
from mgavatar.geometry.vertex_gaussians import silhouette_offset
from mgavatar.losses import image_loss
from mgavatar.reporting.markdown import markdown_table

RADIUS = 0.1
"""Radius of the ball [m], about that of a head."""
DISTANCE = 1.0
"""Distance of the cameras from the centre of the ball [m]."""
SUBDIVISIONS = 4
"""Subdivisions of the icosahedron: 2,562 vertices, edges of 6.9 mm."""
N_CAMERAS = 12
SHIFTS = (0.0, 1.5, 1.8, 2.0, 2.5)
"""Values of ``geometry.surface_shift``."""
Surface = Literal["disc", "texture"]


def mesh() -> tuple[Tensor, float]:
    """Return unit vertices of the icosphere, shape [V, 3], and the mean length of its edges on the ball [m]."""
    ball = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS)
    return torch.tensor(ball.vertices, dtype=torch.float32), RADIUS * float(ball.edges_unique_length.mean())


def cameras(focal: float, size: int) -> list[Camera]:
    """Return a ring of cameras at the height of the ball; ``focal`` and ``size`` in px."""
    angles = np.linspace(0.0, 2.0 * np.pi, N_CAMERAS, endpoint=False)
    places = DISTANCE * np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], 1)
    return [look_at(place, np.zeros(3), focal=focal, width=size, height=size) for place in places]


def photograph(camera: Camera, surface: Surface, background: Tensor, samples: int = 4) -> Tensor:
    """Ray-trace the ball with ``samples`` squared rays per pixel; shape [3, H, W]."""
    steps = (np.arange(samples * camera.width) + 0.5) / samples
    pixels = np.stack([*np.meshgrid(steps, steps), np.ones((len(steps), len(steps)))], -1)
    rays = pixels @ np.linalg.inv(camera.K).T @ camera.viewmat[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = -rays @ camera.position
    under_root = along**2 - (camera.position @ camera.position - RADIUS**2)
    points = camera.position + (along - np.sqrt(np.maximum(under_root, 0.0)))[..., None] * rays
    colors = np.where((under_root > 0)[..., None], pattern(points, surface), background.numpy())
    shape = (camera.height, samples, camera.width, samples, 3)
    return torch.from_numpy(colors.reshape(shape).mean((1, 3))).permute(2, 0, 1).float().contiguous()


def pattern(points: np.ndarray, surface: Surface) -> np.ndarray:
    """Return colours of points on the ball, shape [..., 3]: grey, or waves of 26 mm, which three pixels can show."""
    if surface == "disc":
        return np.full(points.shape, 0.4)
    x, y, z = np.moveaxis(points * (2.0 * np.pi / 0.026), -1, 0)
    waves = [np.sin(x + 0.4 * y) * np.cos(z), np.sin(y - 0.3 * z) * np.cos(x + 1.0), np.sin(z + 0.2 * x + 2.0)]
    return 0.5 + 0.3 * np.stack(waves, -1)


def calibrate(sigma: float, edge_px: float, surface: Surface, shift: float, *, iterations: int = 200) -> float:
    """Fit the radius of the vertices and return its error.

    Args:
        sigma: Standard deviation of the Gaussians, in edges.
        edge_px: Length of an edge in the images [px].
        surface: Look of the ball.
        shift: ``surface_shift`` of the geometry stage.
        iterations: Optimizer steps, one image each.

    Returns:
        Fitted minus true radius [m], a mean over the last round of cameras. Negative is inside.
    """
    directions, edge = mesh()
    focal = edge_px / edge * DISTANCE
    size = 8 * round(2.6 * RADIUS / DISTANCE * focal / 8)
    views = cameras(focal, size)
    background = torch.ones(3)
    targets = [photograph(view, surface, background) for view in views]
    radius = torch.tensor(RADIUS, requires_grad=True)
    colors = torch.tensor(pattern(RADIUS * directions.numpy(), surface), dtype=torch.float32).requires_grad_()
    optimizer = torch.optim.Adam([{"params": [radius], "lr": 5e-4}, {"params": [colors], "lr": 1e-2}], eps=1e-15)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.01 ** (1.0 / iterations))
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(directions), 1)
    scales, opacities = torch.full((len(directions), 3), sigma * edge), torch.ones(len(directions))
    late = []
    for iteration in range(iterations):
        view = iteration * 5 % N_CAMERAS  # 5 and 12 have no common factor: every camera, neighbours apart
        verts = radius * directions
        back = shift * silhouette_offset(scales[:, 0], verts.detach(), directions, views[view])
        gaussians = Gaussians(verts - back[:, None] * directions, quats, scales, opacities, colors)
        image = draw(gaussians, views[view], background=background, config=RasterConfig()).image
        optimizer.zero_grad()
        image_loss(image, targets[view], ImageLossConfig()).backward()
        optimizer.step()
        schedule.step()
        if iteration >= iterations - N_CAMERAS:
            late.append(float(radius.detach()))
    return float(np.mean(late)) - RADIUS


def table(sigmas: Sequence[float], edges_px: Sequence[float]) -> str:
    """Fit every combination and return the errors of the radius in a Markdown table."""
    header = ["sigma / edge", "edge", "surface", *(f"error at {shift:g} [mm]" for shift in SHIFTS)]
    surfaces: tuple[Surface, ...] = ("disc", "texture")
    rows = []
    for sigma, edge_px, surface in itertools.product(sigmas, edges_px, surfaces):
        errors = [calibrate(sigma, edge_px, surface, shift) for shift in SHIFTS]
        rows.append([f"{sigma:g}", f"{edge_px:g} px", surface, *(f"{1e3 * error:+.2f}" for error in errors)])
    return markdown_table(header, rows)


if __name__ == "__main__":
    print(table((0.25, 0.35, 0.5), (1.5, 3.0, 6.0)))
