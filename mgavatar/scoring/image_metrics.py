"""Scores of an image against another."""

from __future__ import annotations

import math

from torch import Tensor

BEST_PSNR = 100.0
"""What equal images score [dB]: JSON has no infinity."""


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio of images in 0..1 [dB], at most 100."""
    error = float((image - target).square().mean())
    return min(BEST_PSNR, -10.0 * math.log10(max(error, 1e-30)))
