"""Photometric losses: mean absolute error, and SSIM as in 3D Gaussian splatting (11x11, sigma 1.5, zero padding)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from mgavatar.config import ImageLossConfig
from mgavatar.kernels.ssim import compare_images

_C1, _C2 = 0.01**2, 0.03**2


@lru_cache(maxsize=8)
def _window(channels: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    x = torch.arange(11, dtype=torch.float64) - 5
    w = torch.exp(-(x**2) / (2 * 1.5**2))
    w = (w / w.sum()).to(device, dtype).expand(channels, 1, 11)
    return w.reshape(channels, 1, 11, 1).contiguous(), w.reshape(channels, 1, 1, 11).contiguous()


def _blur(maps: Tensor) -> Tensor:
    """Convolve maps [C, H, W] with the separable window; it is symmetric, and so its own adjoint."""
    vertical, horizontal = _window(len(maps), maps.dtype, maps.device)
    # One group per map: each is blurred on its own.
    maps = functional.conv2d(maps[None], vertical, padding=(5, 0), groups=len(maps))
    return functional.conv2d(maps, horizontal, padding=(0, 5), groups=maps.shape[1])[0]


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        mu_x, mu_y, xx, yy, xy = _blur(torch.cat([image, target, image**2, target**2, image * target])).chunk(5)
        a = 2 * mu_x * mu_y + _C1
        b = 2 * (xy - mu_x * mu_y) + _C2
        c = mu_x**2 + mu_y**2 + _C1
        d = (xx - mu_x**2) + (yy - mu_y**2) + _C2
        ssim = a * b / (c * d)
        # Derivatives of the sum by the blurred image, its square and its product with the target. mu_x stands in all
        # four factors: in a and c itself, in b and d by the products that the covariances subtract.
        by_xx = -ssim / d
        by_xy = 2 * a / (c * d)
        by_mu = 2 * mu_y * b / (c * d) - 2 * ssim * mu_x / c - by_xy * mu_y - 2 * by_xx * mu_x
        ctx.save_for_backward(image, target, by_mu, by_xx, by_xy)
        return ssim.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        image, target, by_mu, by_xx, by_xy = ctx.saved_tensors
        mu, xx, xy = _blur(torch.cat([by_mu, by_xx, by_xy])).chunk(3)
        return grad / image.numel() * (mu + 2 * image * xx + target * xy), None


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Compute the structural similarity, averaged over pixels and channels.

    Differentiable in ``image``. kornia's ``ssim_loss`` is half of 1 - SSIM, to which the paper's weight does not apply,
    and several times slower on a CPU.

    Args:
        image: Image in 0..1, shape [3, H, W].
        target: Image of the same shape.

    Returns:
        Scalar tensor, 1 for equal images.
    """
    return _Ssim.apply(image, target)


def image_loss(image: Tensor, target: Tensor, config: ImageLossConfig) -> Tensor:
    """Compute the photometric loss of Eq. 4, ``lambda_c |image - target| + lambda_m (1 - SSIM)``.

    Args:
        image: Rendered image in 0..1, shape [3, H, W].
        target: Image of the capture, of the same shape.
        config: The weights.
    """
    # The fused kernel of the CPU is several times faster there than convolutions, and computes the same.
    if image.device.type == "cpu" and image.dtype == torch.float32:
        absolute, similarity = compare_images(image, target)
        return config.color * absolute + config.ssim * (1.0 - similarity)
    return config.color * (image - target).abs().mean() + config.ssim * (1.0 - ssim(image, target))
