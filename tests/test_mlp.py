"""Fused small networks: values by hand, the float64 twin, shapes that do not fill a tile, refusals."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from checks import assert_matches_twin, assert_same_bits
from twins import mesh as twins

from mgavatar.kernels import mlp as module
from mgavatar.kernels.mlp import mlp


def network(rng, *widths):
    """Weights and biases of layers with these numbers of channels."""
    weights = [torch.randn(o, i, generator=rng) / i**0.5 for i, o in pairwise(widths)]
    return weights, [0.3 * torch.randn(o, generator=rng) for o in widths[1:]]


def inputs_of(rng, n, widths, n_extra=0):
    """Points in two parts, then all weights, then all biases; all want gradients."""
    weights, biases = network(rng, *widths)
    x = torch.randn(n, widths[0] - n_extra, generator=rng)
    extra = torch.randn(n, n_extra, generator=rng)
    return [tensor.requires_grad_(tensor.numel() > 0) for tensor in (x, extra, *weights, *biases)]


def fused(x, extra, *parameters):
    half = len(parameters) // 2
    return mlp(x, parameters[:half], parameters[half:], extra=extra)


def twin(x, extra, *parameters):
    half = len(parameters) // 2
    return twins.mlp(torch.cat([x, extra], 1), parameters[:half], parameters[half:])


def test_two_layers_by_hand(device):
    """One unit passes, the other is closed; only the open one gets a gradient."""
    x = torch.tensor([[1.0, 2.0]], device=device, requires_grad=True)
    weights = [torch.tensor([[1.0, 1.0], [-1.0, 0.0]], device=device), torch.tensor([[2.0, 5.0]], device=device)]
    biases = [torch.tensor([0.5, 0.25], device=device), torch.tensor([-1.0], device=device)]
    out = mlp(x, weights, biases)
    out.sum().backward()
    assert out.tolist() == [[6.0]]
    assert x.grad.tolist() == [[2.0, 2.0]]


@pytest.mark.parametrize(
    ("n", "widths", "n_extra"),
    [
        (1500, (19, 64, 3), 3),  # ColorNet
        (700, (48, 128, 128, 128, 3), 0),  # RefineNet
        (130, (5, 17, 33, 4), 2),  # nothing fills a vector
        (1, (1, 1), 0),
        (65, (256, 256, 256, 1), 0),  # the widest
    ],
)
def test_outputs_and_gradients_match_the_float64_twin(device, rng, n, widths, n_extra):
    """Of the inputs and of every weight and bias."""
    assert_matches_twin(fused, twin, inputs_of(rng, n, widths, n_extra), device=device)


def test_networks_that_fit_no_tile_go_through_torch(rng, monkeypatch):
    """Too wide, too deep or in double precision: the same numbers."""
    monkeypatch.setattr(module._Mlp, "apply", lambda *_: pytest.fail("the kernel got a network that it cannot hold"))
    assert_matches_twin(fused, twin, inputs_of(rng, 20, (8, 257, 2)))
    assert_matches_twin(fused, twin, inputs_of(rng, 20, (8, *[250] * 4, 2)))
    x, extra, *parameters = inputs_of(rng, 20, (8, 16, 2))
    assert fused(x.double(), extra.double(), *(p.double() for p in parameters)).dtype == torch.float64


def test_points_without_a_gradient_are_passed_over(rng, device):
    """Their own gradient is zero, and the others' do not notice."""
    inputs = inputs_of(rng, 500, (19, 64, 3), 3)
    seen = (torch.rand(500, 1, generator=rng) < 0.3).to(torch.float32)

    def masked(op):
        return lambda *values: seen.to(values[0]) * op(*values)

    assert_matches_twin(masked(fused), masked(twin), inputs, device=device)


def test_nan_stays_in_its_own_point(device, rng):
    """A point that has diverged spoils no other point's output."""
    x, extra, *parameters = (tensor.detach().to(device) for tensor in inputs_of(rng, 100, (6, 32, 3)))
    x[40, 2] = torch.nan
    out = fused(x, extra, *parameters)
    assert out[40].isnan().all()
    assert out[:40].isfinite().all()
    assert out[41:].isfinite().all()


def test_same_bits_for_any_number_of_threads(device, rng):
    """Each of a fixed number of items has sums of its own."""
    assert_same_bits(fused, inputs_of(rng, 3000, (19, 64, 3), 3), device=device)


def test_no_points(rng):
    """Nothing in, nothing out, zero gradients."""
    x, extra, *parameters = inputs_of(rng, 0, (6, 16, 3))
    out = fused(x, extra, *parameters)
    out.sum().backward()
    assert out.shape == (0, 3)
    assert not parameters[0].grad.any()


def test_bad_input_is_refused(rng):
    """Shapes that do not fit each other."""
    x, extra, *parameters = inputs_of(rng, 10, (6, 16, 3), 2)
    with pytest.raises(ValueError, match="a layer of 4 inputs has weight"):
        mlp(x, parameters[:2], parameters[2:])
    with pytest.raises(ValueError, match=r"inputs must be \[N, C\]"):
        mlp(x, parameters[:2], parameters[2:], extra=extra[:5])
    with pytest.raises(ValueError, match="a weight and a bias a layer"):
        mlp(x, parameters[:2], parameters[2:3], extra=extra)
