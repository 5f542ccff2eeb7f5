"""Gaussians as the renderer takes them, and the one call that draws them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mgavatar.camera import Camera
from mgavatar.config import RasterConfig
from mgavatar.kernels.rasterize import RasterSettings, Rendering, rasterize

SH_C0 = 0.28209479177387814
"""Y_00, the constant spherical harmonic."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """World-space Gaussians.

    Attributes:
        means: Centres [m], shape [N, 3].
        quats: Rotations wxyz, shape [N, 4].
        scales: Standard deviations [m], shape [N, 3].
        opacities: In 0..1, shape [N].
        colors: RGB, shape [N, 3].
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


def draw(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Tensor,
    config: RasterConfig,
    screen_grads: Tensor | None = None,
    viewmat: Tensor | None = None,
) -> Rendering:
    """Rasterize Gaussians from a camera; see :func:`mgavatar.kernels.rasterize.rasterize`.

    ``viewmat`` takes the place of the camera's own, for example with a gradient.
    """
    device = gaussians.means.device
    alpha_threshold, stop = config.thresholds()
    if viewmat is None:
        viewmat = torch.from_numpy(camera.viewmat.astype(np.float32)).to(device)
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        viewmat=viewmat,
        K=torch.from_numpy(camera.K.astype(np.float32)).to(device),
        size=(camera.width, camera.height),
        background=background,
        settings=RasterSettings(alpha_threshold=alpha_threshold, stop=stop),
        screen_grads=screen_grads,
    )
