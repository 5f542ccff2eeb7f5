"""Changes of the input that must not change the rasterizer's result, to the bit where possible."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from checks import threads
from raster_scenes import NAMES, Scene, ball_scene, cotangent_for, decided, differentiate, render
from torch import Tensor

from mgavatar.kernels import compositing, compositing_blocks


@pytest.fixture(params=["plain", "blocks"])
def form(request: pytest.FixtureRequest, device: torch.device) -> str:
    """Every form that the device has."""
    if request.param == "blocks" and device.type != "cpu":
        pytest.skip("the block form is the CPU's")
    return request.param


def dense(device: torch.device, form: str = "auto", dtype: torch.dtype = torch.float32) -> Scene:
    """Several tiles of either form, and Gaussians across their borders."""
    return ball_scene(400, (270, 37), seed=21, sigma=0.1).to(dtype).to(device).knobs(form=form)


def all_of(scene: Scene, cotangent: Tensor | None = None) -> list[Tensor]:
    """Output and gradients."""
    out, grads = differentiate(render, scene, cotangent_for(scene) if cotangent is None else cotangent)
    return [out, *grads]


def assert_same_bits(first: list[Tensor], second: list[Tensor]) -> None:
    """Output and gradients are equal to the bit, and not all zero."""
    for name, a, b in zip(("output", *NAMES), first, second, strict=True):
        assert a.abs().max() > 0, name
        assert torch.equal(a, b), name


def test_two_runs_give_the_same_bits(device, form):
    """No atomics, no order that time decides."""
    assert_same_bits(all_of(dense(device, form)), all_of(dense(device, form)))


@pytest.mark.parametrize("n", [2, 3, 7])
def test_any_number_of_threads_gives_the_same_bits(form, n):
    """Threads share nothing that is written."""
    scene = dense(torch.device("cpu"), form)
    with threads(1):
        one = all_of(scene)
    with threads(n):
        many = all_of(scene)
    assert_same_bits(one, many)


def test_number_of_torch_threads_does_not_matter(form):
    """Torch adds up the camera's and the background's gradient."""
    scene = dense(torch.device("cpu"), form)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = all_of(scene)
        torch.set_num_threads(3)
        many = all_of(scene)
    finally:
        torch.set_num_threads(before)
    assert_same_bits(one, many)


def test_order_of_the_input_does_not_matter(device, form):
    """Gaussians are sorted by depth: shuffled, they give the same bits; the camera's gradient is a sum over them."""
    scene = dense(device, form)
    order = torch.randperm(len(scene.means), generator=torch.Generator().manual_seed(1)).to(device)
    shuffled = replace(scene, **{name: getattr(scene, name)[order] for name in NAMES[:5]})
    plain, mixed = all_of(scene), all_of(shuffled)
    assert torch.equal(plain[0], mixed[0])
    for a, b in zip(plain[1:6], mixed[1:6], strict=True):
        assert torch.equal(a[order.cpu()], b)
    assert (plain[6] - mixed[6]).norm() <= 1e-7 * plain[6].norm()
    assert torch.equal(plain[7], mixed[7])


def test_equal_depths_keep_the_order_of_the_input(device, form):
    """Ties are broken by index, so that a run can be repeated."""
    scene = dense(device, form)
    viewmat = torch.eye(4, device=device)
    viewmat[2, 3] = 4.0
    flat = replace(scene, viewmat=viewmat, means=scene.means * torch.tensor([1.0, 1.0, 0.0], device=device))
    nudged = replace(
        flat, means=flat.means + torch.arange(400, device=device)[:, None] * torch.tensor([0, 0, 1e-6]).to(device)
    )
    assert (render(flat) - render(nudged)).abs().amax((1, 2)).max() < 1e-2
    backwards = replace(flat, **{name: getattr(flat, name).flip(0) for name in NAMES[:5]})
    assert (render(flat) - render(backwards)).abs().max() > 0.1
    assert_same_bits(all_of(flat), all_of(flat))


def test_tiles_and_blocks_give_the_same_result(device):
    """16 x 16 tiles, one thread per pixel, on any device, against the CPU's 128 x 16 tiles of 4 x 4 pixel blocks."""
    assert (compositing.TILE, compositing.TILE) != (compositing_blocks.TILE_WIDTH, compositing_blocks.TILE_HEIGHT)
    scene = dense(torch.device("cpu"))
    cotangent = cotangent_for(scene) * decided(scene)
    plain = all_of(scene.to(device).knobs(form="plain"), cotangent)
    blocks = all_of(scene.knobs(form="blocks"), cotangent)
    assert ((plain[0] - blocks[0]) * (cotangent != 0)).abs().max() <= 2e-6
    for name, a, b in zip(NAMES, plain[1:], blocks[1:], strict=True):
        assert (a - b).norm() <= 5e-6 * a.norm(), name


@pytest.mark.parametrize("shift", [(1, 0), (0, 3), (13, 5), (128, 16)])
def test_whole_pixel_shifts_of_the_principal_point(device, form, shift):
    """A larger image with a shifted centre holds the same picture, whatever tiles it falls into."""
    scene = ball_scene(200, (60, 40), seed=22, sigma=0.1).to(device).knobs(form=form)
    scene.K[:2, 2] = scene.K[:2, 2].round()  # so that adding whole pixels is exact
    K = scene.K.clone()
    K[:2, 2] += torch.tensor(shift, device=device)
    width, height = scene.size
    larger = replace(scene, K=K, size=(width + shift[0], height + shift[1]))
    cotangent = cotangent_for(scene)
    moved = torch.zeros(5, height + shift[1], width + shift[0])
    moved[:, shift[1] :, shift[0] :] = cotangent
    plain, other = all_of(scene, cotangent), all_of(larger, moved)
    assert (plain[0] - other[0][:, shift[1] :, shift[0] :]).abs().max() <= 1e-6
    for name, a, b in zip(NAMES, plain[1:], other[1:], strict=True):
        assert (a - b).norm() <= 5e-6 * a.norm(), name


def test_world_scale(device, form):
    """Metres or half metres: the same bits, depths doubled (a power of two is exact)."""
    scene = dense(device, form)
    viewmat = scene.viewmat.clone()
    viewmat[:3, 3] *= 2
    doubled = replace(scene, means=2 * scene.means, scales=2 * scene.scales, viewmat=viewmat)
    plain, other = render(scene), render(doubled)
    assert torch.equal(plain[:4], other[:4])
    assert torch.equal(2 * plain[4], other[4])


def test_length_and_sign_of_quaternions(device, form):
    """q, -q and 3 q are one rotation."""
    scene = dense(device, form)
    for factor in (-1.0, 4.0):
        assert torch.equal(render(scene), render(replace(scene, quats=factor * scene.quats)))
    assert (render(scene) - render(replace(scene, quats=3e-5 * scene.quats))).abs().max() <= 1e-5


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-6), (torch.float64, 1e-14)])
def test_linear_in_colour_and_background(device, dtype, tolerance):
    """render(2 c1 - c2, 2 b1 - b2) = 2 render(c1, b1) - render(c2, b2)."""
    one = dense(device, dtype=dtype)
    two = replace(one, colors=one.colors.flip(1) ** 2, background=one.background.flip(0))
    both = replace(one, colors=2 * one.colors - two.colors, background=2 * one.background - two.background)
    mixed = 2 * render(one) - render(two)
    assert (render(both) - mixed).abs().max() <= tolerance * mixed.abs().max()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["colors", "background"])
def test_adjoint_of_colour_and_background(device, form, dtype, name):
    """<J v, u> = <v, J^T u>, J v being the picture of colours v alone."""
    if form == "blocks" and dtype == torch.float64:
        form = "plain"
    scene = dense(device, form, dtype)
    g = torch.Generator().manual_seed(2)
    v = torch.randn(getattr(scene, name).shape, generator=g).to(scene.means)
    zero = {"colors": torch.zeros_like(scene.colors), "background": torch.zeros_like(scene.background)}
    u = torch.randn(3, scene.size[1], scene.size[0], generator=g).double()
    forward = render(replace(scene, **(zero | {name: v})))[:3].cpu().double()
    cotangent = torch.cat([u, torch.zeros(2, *u.shape[1:])])
    adjoint = differentiate(render, scene, cotangent)[1][NAMES.index(name)]
    left, right = float((forward * u).sum()), float((v.cpu().double() * adjoint).sum())
    size = float(forward.norm() * u.norm())
    assert abs(left - right) <= (1e-7 if dtype == torch.float32 else 1e-14) * size
    assert abs(left) > 1e-3 * size / u.numel() ** 0.5


def test_views_add_up(device, form):
    """Two cameras in one graph give the sum of their gradients."""
    scene = dense(device, form)
    viewmat = scene.viewmat.clone()
    viewmat[0, 3] += 0.2
    other = replace(scene, viewmat=viewmat)
    cotangent = cotangent_for(scene).to(device)
    colors = scene.colors.clone().requires_grad_()
    means = scene.means.clone().requires_grad_()
    for view in (scene, other):
        render(replace(view, colors=colors, means=means)).backward(cotangent)
    alone = [differentiate(render, view, cotangent)[1] for view in (scene, other)]
    assert torch.equal(colors.grad.cpu(), (alone[0][4] + alone[1][4]).float())
    assert torch.equal(means.grad.cpu(), (alone[0][0] + alone[1][0]).float())


def test_more_gaussians_far_aside_change_nothing(device, form):
    """Culled ones leave no trace, and get no gradient."""
    scene = dense(device, form)
    aside = {
        name: torch.cat([getattr(scene, name), getattr(scene, name)[:50]])
        for name in ("quats", "scales", "opacities", "colors")
    }
    means = torch.cat([scene.means, scene.means[:50] + torch.tensor([500.0, 0, 0], device=device)])
    plain, more = all_of(scene), all_of(replace(scene, means=means, **aside))
    assert torch.equal(plain[0], more[0])
    for a, b in zip(plain[1:6], more[1:6], strict=True):
        assert torch.equal(a, b[:400])
        assert not b[400:].any()
