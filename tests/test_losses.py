"""Photometric losses (Eq. 4)."""

from __future__ import annotations

import pytest
import torch
from checks import assert_gradcheck, assert_matches_twin
from torch import Tensor
from twins import image as twins

from mgavatar.config import ImageLossConfig
from mgavatar.losses import image_loss, ssim


def pair(*size: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """Two unlike images, of which the first wants a gradient."""
    image, target = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(size[0]), dtype=dtype)
    return image.requires_grad_(), target


@pytest.mark.parametrize("size", [(1, 1), (4, 7), (11, 11), (23, 31)])
def test_ssim_matches_the_explicit_window(size, device):
    """The form for CUDA and float64 agrees with 121 weighted shifts, in value and gradient."""
    assert_matches_twin(ssim, twins.ssim, pair(*size), device=device, gradient_tolerance=1e-5)


def test_ssim_is_its_own_derivative_in_double_precision():
    """The hand-written adjoint passes finite differences."""
    image, target = pair(5, 6, dtype=torch.float64)
    assert_gradcheck(lambda x: ssim(x, target), image)


def test_ssim_of_equal_and_of_constant_images(device):
    """1 for equal images, finite where nothing varies."""
    image = pair(13, 9)[0].detach().to(device)
    assert ssim(image, image).item() == pytest.approx(1.0, abs=1e-6)
    black = torch.zeros(3, 12, 12, device=device, requires_grad=True)
    value = ssim(black, torch.ones_like(black))
    value.backward()
    assert 0.0 < value.item() < 0.05
    assert black.grad.isfinite().all()


def test_image_loss_weighs_its_two_terms():
    """Eq. 4 with one weight at a time, then with both."""
    image, target = pair(15, 18)
    absolute, similarity = twins.compare_images(image.detach().double(), target.double()).tolist()
    for color, weight in ((1.0, 0.0), (0.0, 1.0), (0.8, 0.2), (3.0, 0.5)):
        config = ImageLossConfig(color=color, ssim=weight)
        expected = color * absolute + weight * (1.0 - similarity)
        assert image_loss(image, target, config).item() == pytest.approx(expected, rel=1e-5)


def test_both_forms_of_the_image_loss_agree():
    """The CPU's kernel in float32 and the convolutions in float64 give one loss and one gradient."""
    image, target = pair(21, 19)
    double = image.detach().double().requires_grad_()
    losses = image_loss(image, target, ImageLossConfig()), image_loss(double, target.double(), ImageLossConfig())
    for loss in losses:
        loss.backward()
    assert losses[0].item() == pytest.approx(losses[1].item(), rel=1e-5)
    assert (image.grad - double.grad).norm() < 1e-5 * double.grad.norm()


def test_the_loss_of_equal_images_is_zero():
    """Nothing is left to improve."""
    image = pair(14, 14)[0].detach()
    assert image_loss(image, image, ImageLossConfig()).item() == pytest.approx(0.0, abs=1e-6)


def test_images_of_another_size_are_refused():
    """A target of another size is a mistake, not a broadcast."""
    with pytest.raises(ValueError, match="must both have shape"):
        image_loss(torch.zeros(3, 8, 8), torch.zeros(3, 8, 9), ImageLossConfig())
