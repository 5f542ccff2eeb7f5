"""Twin of the rasterizer in plain torch float64: covariance matrices, conics and one matrix of alphas.

It follows the kernels' conventions (order by depth in single precision, threshold, inclusive stop, cap) and none of
their formulas: no row form, no tiles, no hand-written adjoint.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from mgavatar.kernels.rasterize import RasterSettings

CHUNK = 2**21
"""Pairs of Gaussian and pixel that are held at once."""


@dataclass(frozen=True)
class Footprints:
    """Gaussians in the image, front to back: means [M, 2], conics [M, 2, 2], depths [M] and their indices [M]."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    order: Tensor


def rotations(quats: Tensor) -> Tensor:
    """Matrices of quaternions wxyz of any length, I + 2w [v] + 2 [v]^2 with [v] the cross product, shape [N, 3, 3]."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    return torch.eye(3, dtype=quats.dtype) + 2 * w[:, None, None] * skew + 2 * skew @ skew


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    size: tuple[int, int],
    settings: RasterSettings,
) -> Footprints:
    """Cull, linearise the camera at each mean, order by depth."""
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    keep = (points[:, 2] > settings.near) & (opacities >= settings.alpha_threshold)
    keep &= (
        (quats.norm(dim=1) > 1e-12) & (quats.norm(dim=1) < 1e12) & points.isfinite().all(1) & scales.isfinite().all(1)
    )
    index = keep.nonzero()[:, 0]
    order = index[torch.sort(points[index, 2].detach().float(), stable=True).indices]
    x, y, z = points[order].unbind(1)
    M = viewmat[:3, :3] @ rotations(quats[order]) @ torch.diag_embed(scales[order])
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    slope_x = torch.clamp(x / z, -(cx + 0.15 * size[0]) / fx, (1.15 * size[0] - cx) / fx)
    slope_y = torch.clamp(y / z, -(cy + 0.15 * size[1]) / fy, (1.15 * size[1] - cy) / fy)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], 1).reshape(-1, 2, 3)
    cov = (J @ M) @ (J @ M).mT + settings.low_pass * torch.eye(2, dtype=means.dtype)
    return Footprints(torch.stack([fx * x / z + cx, fy * y / z + cy], 1), torch.linalg.inv(cov), z, order)


def alphas_at(means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor, cap: float) -> Tensor:
    """Alpha of every Gaussian at every pixel centre before the threshold, shape [M, P]."""
    d = pixels[None] - means2d[:, None]
    power = -0.5 * torch.einsum("mpi,mij,mpj->mp", d, conics, d)
    return torch.clamp(opacities[:, None] * torch.exp(power), max=cap)


def _before(alphas: Tensor) -> Tensor:
    """Light that reaches each Gaussian, shape [M + 1, P]."""
    return torch.cat([alphas.new_ones(1, alphas.shape[1]), torch.cumprod(1 - alphas, 0)])


def _blend(
    means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, background: Tensor, pixels: Tensor,
    threshold: float, stop: float, cap: float,
) -> Tensor:  # fmt: skip
    alphas = alphas_at(means2d, conics, opacities, pixels, cap)
    alphas = torch.where(alphas >= threshold, alphas, 0.0)
    with torch.no_grad():
        going = _before(alphas)[:-1] >= stop
    alphas = torch.where(going, alphas, 0.0)
    T = _before(alphas)
    blended = torch.einsum("mp,mc->cp", alphas * T[:-1], features)
    return torch.cat([blended[:3] + background[:, None] * T[-1], 1 - T[-1:], blended[3:]])


def _chunks(n_gaussians: int, size: tuple[int, int]) -> tuple[Tensor, ...]:
    y, x = torch.meshgrid(*(torch.arange(s, dtype=torch.float64) + 0.5 for s in size[::-1]), indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], 1).split(max(1, CHUNK // max(1, n_gaussians)))


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    background: Tensor,
    *,
    K: Tensor,
    size: tuple[int, int],
    settings: RasterSettings,
    shift: Tensor | None = None,
) -> Tensor:
    """Draw red, green, blue, alpha and depth, shape [5, H, W]; ``shift`` [N, 2] moves the means in the image [px]."""
    seen = project(means, quats, scales, opacities, viewmat, K, size, settings)
    if shift is not None:
        seen = replace(seen, means2d=seen.means2d + shift[seen.order])
    features = torch.cat([colors[seen.order], seen.depths[:, None]], 1)
    gaussians = (seen.means2d, seen.conics, opacities[seen.order], features, background)
    limits = (settings.alpha_threshold, settings.stop, settings.alpha_cap)
    chunks = [
        checkpoint(_blend, *gaussians, pixels, *limits, use_reentrant=False, preserve_rng_state=False)
        for pixels in _chunks(len(seen.order), size)
    ]
    return torch.cat(chunks, 1).reshape(5, size[1], size[0])


def rasterize_views(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    backgrounds: Tensor,
    *,
    K: Tensor,
    view_ids: Tensor,
    size: tuple[int, int],
    settings: RasterSettings,
) -> Tensor:
    """Each view from its own Gaussians, one after the other, shape [B, 5, H, W]."""
    gaussians = (means, quats, scales, opacities, colors)
    return torch.stack(
        [
            rasterize(*(t[view_ids == b] for t in gaussians), viewmat, background, K=K[b], size=size, settings=settings)
            for b, (viewmat, background) in enumerate(zip(viewmats, backgrounds, strict=True))
        ]
    )


@torch.no_grad()
def decided(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    *,
    K: Tensor,
    size: tuple[int, int],
    settings: RasterSettings,
    margin: float = 1e-4,
) -> Tensor:
    """Pixels where rounding cannot change which Gaussians are blended, shape [H, W], bool.

    Elsewhere an alpha lies within ``margin`` of the threshold or the cap, or the transmittance within ten times that
    of the stop, all relative.
    """
    seen = project(means, quats, scales, opacities, viewmat, K, size, settings)
    safe = []
    for pixels in _chunks(len(seen.order), size):
        alphas = alphas_at(seen.means2d, seen.conics, opacities[seen.order], pixels, 2.0)
        at_limit = (alphas / max(settings.alpha_threshold, 1e-300) - 1).abs() < margin
        at_limit |= (alphas / settings.alpha_cap - 1).abs() < margin
        alphas = alphas.clamp(max=settings.alpha_cap)
        T = _before(torch.where(alphas >= settings.alpha_threshold, alphas, 0.0))
        near_stop = (T / max(settings.stop, 1e-300) - 1).abs() < 10 * margin
        reached = T[:-1] >= 0.9 * settings.stop
        safe.append(~((at_limit & reached).any(0) | near_stop.any(0)))
    return torch.cat(safe).reshape(size[1], size[0])
