"""Scenes for the rasterizer's tests, and its comparison with the twin."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor
from twins import raster as twin

from mgavatar.kernels.rasterize import RasterSettings, rasterize

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmat", "background")
"""What the rasterizer differentiates."""


@dataclass(frozen=True)
class Scene:
    """Everything that the rasterizer takes."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmat: Tensor
    background: Tensor
    K: Tensor
    size: tuple[int, int]
    settings: RasterSettings = field(default_factory=RasterSettings)

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The differentiable inputs, in the order of ``NAMES``."""
        return tuple(getattr(self, name) for name in NAMES)

    def to(self, target: torch.dtype | torch.device) -> Scene:
        """The same numbers in another precision or place."""
        return replace(self, K=self.K.to(target), **{name: getattr(self, name).to(target) for name in NAMES})

    def knobs(self, **changes: Any) -> Scene:
        """The same scene under other settings."""
        return replace(self, settings=replace(self.settings, **changes))


def tilted_camera(distance: float) -> Tensor:
    """World to camera: turned about all three axes, looking at the origin from ``distance`` [m]."""
    a, b, c = 0.3, -0.2, 0.15
    rx = torch.tensor([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    ry = torch.tensor([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
    rz = torch.tensor([[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[:3, :3] = rz @ ry @ rx
    viewmat[:3, 3] = torch.tensor([0.05, -0.1, distance])
    return viewmat


def ball_scene(n: int = 300, size: tuple[int, int] = (75, 53), *, seed: int = 0, sigma: float = 0.12) -> Scene:
    """Gaussians of all shapes in a ball before a tilted, off-centre camera, 1e-4 m or more apart in depth."""
    g = torch.Generator().manual_seed(seed)
    viewmat = tilted_camera(4.0)
    spread = torch.randn(n, 2, generator=g) * 0.6
    depths = 2.9 + 2.2 * (torch.randperm(n, generator=g) + 0.8 * torch.rand(n, generator=g)) / n
    points = torch.cat([spread * depths[:, None] / 4.0, depths[:, None]], 1)
    means = (points - viewmat[:3, 3]) @ viewmat[:3, :3]
    focal = 1.2 * size[1]
    K = torch.tensor([[focal, 0, size[0] / 2 - 1.3], [0, 1.05 * focal, size[1] / 2 + 0.7], [0, 0, 1]])
    return Scene(
        means=means,
        quats=torch.randn(n, 4, generator=g),
        scales=sigma * torch.exp(0.7 * torch.randn(n, 3, generator=g)),
        opacities=torch.sigmoid(1 + 1.5 * torch.randn(n, generator=g)),
        colors=torch.rand(n, 3, generator=g),
        viewmat=viewmat,
        background=torch.tensor([0.2, 0.7, 0.4]),
        K=K,
        size=size,
    )


def render(scene: Scene, tensors: tuple[Tensor, ...] | None = None) -> Tensor:
    """Draw image, alphas and depths in one, shape [5, H, W]."""
    *gaussians, viewmat, background = tensors or scene.tensors
    out = rasterize(
        *gaussians, viewmat=viewmat, background=background, K=scene.K, size=scene.size, settings=scene.settings
    )
    return torch.cat([out.image, out.alphas[None], out.depths[None]])


def render_twin(scene: Scene, tensors: tuple[Tensor, ...] | None = None) -> Tensor:
    """The twin's, for the same scene in float64."""
    return twin.rasterize(*(tensors or scene.tensors), K=scene.K, size=scene.size, settings=scene.settings)


def decided(scene: Scene, margin: float = 1e-4) -> Tensor:
    """Pixels where rounding cannot change which Gaussians are blended, shape [H, W]."""
    wide = scene.to(torch.device("cpu")).to(torch.float64)
    gaussians = (wide.means, wide.quats, wide.scales, wide.opacities, wide.viewmat)
    return twin.decided(*gaussians, K=wide.K, size=wide.size, settings=wide.settings, margin=margin)


def differentiate(function: Any, scene: Scene, cotangent: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Output and gradients of ``function`` (``render`` or ``render_twin``), both float64 on the CPU."""
    leaves = tuple(tensor.detach().clone().requires_grad_() for tensor in scene.tensors)
    out = function(scene, leaves)
    out.backward(cotangent.to(out))
    return out.detach().cpu().double(), [leaf.grad.cpu().double() for leaf in leaves]


def cotangent_for(scene: Scene, seed: int = 5) -> Tensor:
    """Random weights of the output, shape [5, H, W]."""
    return torch.randn(5, scene.size[1], scene.size[0], generator=torch.Generator().manual_seed(seed))


@dataclass(frozen=True)
class Errors:
    """Distance of the rasterizer from its twin.

    Attributes:
        image: Largest absolute error of the colours and the alphas.
        depth: Largest error of the depth, relative to the largest depth.
        gradients: Relative L2 error by input.
        flipped: Share of all pixels whose error exceeds ``image``'s goal.
        decided: Share of the pixels that were compared.
    """

    image: float
    depth: float
    gradients: dict[str, float]
    flipped: float
    decided: float


def errors_of(scene: Scene, *, everywhere: bool = False) -> Errors:
    """Compare image and gradients on the decided pixels, or everywhere."""
    narrow, wide = scene.to(torch.float32), scene.to(torch.float32).to(torch.device("cpu")).to(torch.float64)
    mask = decided(narrow) | everywhere
    cotangent = cotangent_for(scene) * mask
    got, got_grads = differentiate(render, narrow, cotangent)
    want, want_grads = differentiate(render_twin, wide, cotangent.double())
    off = (got - want).abs()
    gradients = {
        name: float((a - b).norm() / b.norm().clamp(min=1e-30))
        for name, a, b in zip(NAMES, got_grads, want_grads, strict=True)
    }
    depth = off[4] / want[4].abs().max().clamp(min=1e-30)
    return Errors(
        image=float(off[:4].amax(0)[mask].max()),
        depth=float(depth[mask].max()),
        gradients=gradients,
        flipped=float((off[:4].amax(0) > 1e-6).double().mean()),
        decided=float(mask.double().mean()),
    )
