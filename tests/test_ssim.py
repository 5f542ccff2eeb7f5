"""The comparison of two images in one pass: mean absolute error and SSIM (Eq. 4)."""

from __future__ import annotations

import pytest
import torch
from checks import assert_matches_twin, assert_same_bits
from torch import Tensor
from twins import image as twins

from mgavatar.kernels.ssim import compare_images

SIZES = ((1, 1), (3, 5), (10, 4), (11, 11), (16, 128), (17, 129), (33, 257))
"""Height and width: below the window's 11, at the border of a tile of 16 x 128, and past it."""

SSIM_GRADIENT = 1e-4
"""Variances are differences of blurred squares: in float32 about four digits of a smooth image's gradient remain."""


def pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Two unlike images, of which the first wants a gradient."""
    generator = torch.Generator().manual_seed(100 * height + width)
    image, target = torch.rand(2, 3, height, width, generator=generator)
    return image.requires_grad_(), target


@pytest.mark.parametrize("size", SIZES)
def test_values_and_gradient_match_the_explicit_window(size):
    """The tiled, separable kernel agrees with 121 weighted shifts in double precision."""
    assert_matches_twin(compare_images, twins.compare_images, pair(*size), gradient_tolerance=1e-5)


def test_a_smooth_image_matches_the_explicit_window():
    """Small variances, as in a photograph of a wall, neither blow up nor vanish."""
    y, x = torch.meshgrid(torch.linspace(0, 1, 30), torch.linspace(0, 1, 45), indexing="ij")
    image = torch.stack([x, y, 0.5 + 0.2 * x * y])
    target = (0.95 * image + 0.02).contiguous()
    inputs = (image.requires_grad_(), target)
    assert_matches_twin(compare_images, twins.compare_images, inputs, gradient_tolerance=SSIM_GRADIENT)


def test_one_pixel_by_hand():
    """With zeros around it, a single pixel keeps the window's middle weight of itself."""
    a, b = 0.8, 0.3
    w = float(twins.window()[5, 5])
    luminance = (2 * w * a * w * b + 1e-4) / ((w * a) ** 2 + (w * b) ** 2 + 1e-4)
    contrast = (2 * (w - w * w) * a * b + 9e-4) / ((w - w * w) * (a * a + b * b) + 9e-4)
    absolute, similarity = compare_images(torch.full((3, 1, 1), a), torch.full((3, 1, 1), b)).tolist()
    assert absolute == pytest.approx(0.5, rel=1e-6)
    assert similarity == pytest.approx(luminance * contrast, rel=1e-5)


@pytest.mark.parametrize("size", SIZES)
def test_an_image_is_like_itself(size):
    """No error, a similarity of 1, and no direction in which it would grow."""
    image = pair(*size)[0]
    means = compare_images(image, image.detach().clone())
    assert means[0].item() == 0.0
    assert means[1].item() == pytest.approx(1.0, abs=1e-6)
    means.sum().backward()
    assert image.grad.abs().max() * image.numel() < 1e-4


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.5, 0.25)])
def test_constant_images_stay_finite(a, b):
    """No variance at all: value and gradient are finite, and right."""
    image, target = torch.full((3, 20, 23), a, requires_grad=True), torch.full((3, 20, 23), b)
    means = compare_images(image, target)
    means.sum().backward()
    assert image.grad.isfinite().all()
    assert torch.allclose(means.double(), twins.compare_images(image.double(), target.double()), atol=2e-6)


def test_threads_do_not_change_a_bit():
    """Value and gradient of several tiles are the same bits for 1, 2 and 3 threads."""
    assert_same_bits(compare_images, pair(70, 300))


def test_images_that_are_not_contiguous():
    """Channels that come last in memory are read as channels."""
    image, target = pair(12, 14)
    turned = target.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    assert torch.equal(compare_images(image, turned), compare_images(image, target))


@pytest.mark.parametrize(
    ("image", "target", "words"),
    [
        (torch.zeros(4, 5), torch.zeros(4, 5), r"\[3, H, W\]"),
        (torch.zeros(1, 4, 5), torch.zeros(1, 4, 5), r"\[3, H, W\]"),
        (torch.zeros(3, 4, 5), torch.zeros(3, 5, 4), r"\(3, 5, 4\)"),
        (torch.zeros(3, 4, 5).double(), torch.zeros(3, 4, 5).double(), "float64"),
        (torch.zeros(3, 4, 5), torch.zeros(3, 4, 5).double(), "float32"),
    ],
)
def test_what_does_not_fit_is_refused(image, target, words):
    """Shapes and dtypes are checked before the kernel indexes with them."""
    with pytest.raises(ValueError, match=words):
        compare_images(image, target)
