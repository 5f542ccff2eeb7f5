"""Twins of the image comparisons: SSIM as its formula reads, with the window as one 11 x 11 table."""

from __future__ import annotations

import torch
from torch import Tensor

RADIUS = 5
SIGMA = 1.5


def window() -> Tensor:
    """Gaussian weights around a pixel, which sum to 1, shape [11, 11]."""
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float64)
    squares = offsets[:, None] ** 2 + offsets[None, :] ** 2
    weights = torch.exp(-squares / (2 * SIGMA**2))
    return weights / weights.sum()


def blurred(x: Tensor) -> Tensor:
    """Weighted sum of the 121 pixels around each one, shape [3, H, W]; outside the image there is zero."""
    height, width = x.shape[1:]
    padded = torch.nn.functional.pad(x, (RADIUS,) * 4)
    weights = window().to(x.dtype)
    size = 2 * RADIUS + 1
    shifted = [weights[j, i] * padded[:, j : j + height, i : i + width] for j in range(size) for i in range(size)]
    return torch.stack(shifted).sum(0)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean over pixels and channels of the product of the luminance and the contrast-structure terms."""
    mean_x, mean_y = blurred(image), blurred(target)
    var_x, var_y = blurred(image * image) - mean_x**2, blurred(target * target) - mean_y**2
    covariance = blurred(image * target) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
    return (luminance * (2 * covariance + 0.03**2) / (var_x + var_y + 0.03**2)).mean()


def compare_images(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute error and SSIM, shape [2]."""
    return torch.stack([(image - target).abs().mean(), ssim(image, target)])
