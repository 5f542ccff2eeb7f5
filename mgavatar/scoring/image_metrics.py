"""Scores of an image against the one that it should be: PSNR, SSIM and LPIPS.

PSNR and SSIM are kornia's, so a score does not depend on the code of the loss that the fit minimised.
"""

from __future__ import annotations

import kornia
import torch
from torch import Tensor
from torch.nn import functional

from mgavatar.scoring.lpips import Lpips

BEST_PSNR = 100.0
"""PSNR of equal images [dB]: JSON has no infinity."""

_SSIM_WINDOW = 11


@torch.no_grad()
def image_metrics(image: Tensor, target: Tensor, lpips: Lpips | None = None) -> dict[str, float | None]:
    """Score an image against its target.

    Args:
        image: In 0..1, shape [3, H, W].
        target: Same shape, on the same device.
        lpips: The distance to use, see :func:`mgavatar.scoring.lpips.load_lpips`, or None.

    Returns:
        ``psnr`` [dB], ``ssim``, and ``lpips``, which is None without a distance.

    Raises:
        ValueError: If the shapes differ.
    """
    return {
        "psnr": psnr(image, target),
        "ssim": ssim(image, target),
        "lpips": None if lpips is None else float(lpips(image, target)),
    }


def psnr(image: Tensor, target: Tensor) -> float:
    """Return the peak signal-to-noise ratio of images in 0..1 [dB], at most ``BEST_PSNR``.

    Raises:
        ValueError: If the shapes differ.
    """
    _check_shapes(image, target)
    return min(BEST_PSNR, float(kornia.metrics.psnr(image, target, 1.0)))


def ssim(image: Tensor, target: Tensor) -> float:
    """Return the structural similarity, averaged over pixels and channels; 1 for equal images.

    The definition is that of 3D Gaussian splatting: a Gaussian window of 11 x 11 pixels, sigma 1.5, zero padding.

    Args:
        image: In 0..1, shape [3, H, W].
        target: Same shape.

    Raises:
        ValueError: If the shapes differ.
    """
    _check_shapes(image, target)
    # kornia reflects the image at its border. With a border of zeros of our own, the pixels whose window lies inside
    # ("valid") are exactly those of the image.
    padded = [functional.pad(pixels[None], (_SSIM_WINDOW // 2,) * 4) for pixels in (image, target)]
    return float(kornia.metrics.ssim(*padded, _SSIM_WINDOW, eps=0.0, padding="valid").mean())


def _check_shapes(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape:
        raise ValueError(f"image has shape {tuple(image.shape)}, but its target {tuple(target.shape)}")
