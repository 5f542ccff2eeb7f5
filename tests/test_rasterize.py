"""The rasterizer against its float64 twin, finite differences and numbers known by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from raster_scenes import (
    NAMES,
    Scene,
    ball_scene,
    cotangent_for,
    decided,
    differentiate,
    errors_of,
    render,
    render_twin,
)
from twins import raster as twin

from mgavatar.kernels.rasterize import RasterSettings, rasterize

IMAGE = 1e-6
"""Largest absolute error of colours and alphas."""

GRADIENT = 5e-6
"""Largest relative L2 error of any gradient."""

FLIPS = 1e-3
"""Largest share of pixels where rounding may change which Gaussians are blended."""


@pytest.fixture(params=["plain", "blocks"])
def form(request: pytest.FixtureRequest, device: torch.device) -> str:
    """Every form that the device has."""
    if request.param == "blocks" and device.type != "cpu":
        pytest.skip("the block form is the CPU's")
    return request.param


def opaque(scene: Scene) -> Scene:
    """Every opacity above the cap, as in the geometry stage."""
    return replace(scene, opacities=torch.ones_like(scene.opacities))


def needles(scene: Scene) -> Scene:
    """One axis thirty times the others, in all directions."""
    return replace(scene, scales=0.015 * torch.tensor([30.0, 1.0, 1.0]).expand_as(scene.scales))


SCENES = {
    "all shapes": lambda: ball_scene(),
    "tall image": lambda: ball_scene(200, (17, 131), seed=1),
    "wide image": lambda: ball_scene(150, (257, 31), seed=2),
    "small Gaussians": lambda: ball_scene(seed=3, sigma=0.02),
    "opaque": lambda: opaque(ball_scene(seed=4)),
    "capped": lambda: opaque(ball_scene(seed=10)).knobs(alpha_cap=0.8),
    "needles": lambda: needles(ball_scene(seed=5)),
    "many layers": lambda: ball_scene(800, (41, 37), seed=6, sigma=0.2),
    "no truncation": lambda: ball_scene(seed=7).knobs(alpha_threshold=0.0, stop=0.0),
    "sharp threshold": lambda: ball_scene(seed=8).knobs(alpha_threshold=1 / 1024, stop=1e-3, alpha_cap=0.99),
    "no low-pass": lambda: ball_scene(seed=9, sigma=0.2).knobs(low_pass=0.0),
}


def one_gaussian(opacity: float = 0.8) -> dict[str, torch.Tensor]:
    """On the optical axis, 2 m away, sigma 0.2 m, seen with a focal length of 10 px: 1 px in the image."""
    return {
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), 0.2),
        "opacities": torch.tensor([opacity]),
        "colors": torch.tensor([[1.0, 0.5, 0.25]]),
    }


CAMERA = {"viewmat": torch.eye(4), "K": torch.tensor([[10.0, 0.0, 0.5], [0.0, 10.0, 0.5], [0.0, 0.0, 1.0]])}


def on(device: torch.device, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Moved to a device."""
    return {name: tensor.to(device) for name, tensor in tensors.items()}


def test_one_gaussian_known_by_hand(device, form):
    """Alpha is 0.8 at its centre and 0.8 exp(-1 / 2.6) one pixel aside: the variance is 1 + 0.3 px^2."""
    gaussian = on(device, one_gaussian())
    background = torch.tensor([0.0, 0.0, 1.0], device=device, requires_grad=True)
    leaves = [tensor.requires_grad_() for tensor in gaussian.values()]
    out = rasterize(
        **gaussian, **on(device, CAMERA), size=(2, 1), background=background, settings=RasterSettings(form=form)
    )
    side = 0.8 * math.exp(-1 / 2.6)
    assert out.alphas.tolist()[0] == pytest.approx([0.8, side], rel=1e-6)
    assert out.depths.tolist()[0] == pytest.approx([1.6, 2 * side], rel=1e-6)
    assert out.image[:, 0, 0].tolist() == pytest.approx([0.8, 0.4, 0.2 + 0.2], rel=1e-6)
    assert out.visible.tolist() == [True]
    grads = torch.autograd.grad(out.image[2, 0, 1], [*leaves, background])
    means, _, scales, opacities, colors, v_background = grads
    fall = side * (0.25 - 1.0)  # of blue, for each unit of log alpha
    # d log(alpha) / d mean_x = 1 px / 1.3 px^2 at 5 px per metre; the variance grows by 2 * 0.2 * 25 px^2 per metre.
    assert means[0].tolist() == pytest.approx([fall * 5 / 1.3, 0.0, fall * (-1.0 / 2.6 * 2 * 1.0 / 2 / 1.3)], rel=1e-5)
    assert scales[0].tolist() == pytest.approx([fall * 10 / (2 * 1.3**2), 0.0, 0.0], rel=1e-5)
    assert opacities.tolist() == pytest.approx([fall / 0.8], rel=1e-6)
    assert colors[0].tolist() == pytest.approx([0.0, 0.0, side], rel=1e-6)
    assert v_background.tolist() == pytest.approx([0.0, 0.0, 1 - side], rel=1e-6)


def test_two_gaussians_blend_front_to_back(device, form):
    """The nearer one, given last, comes first: a1 c1 + (1 - a1) a2 c2 + (1 - a1) (1 - a2) b."""
    near, far = one_gaussian(0.5), one_gaussian(0.6)
    far["means"] = torch.tensor([[0.0, 0.0, 4.0]])
    far["colors"] = torch.tensor([[0.0, 1.0, 0.0]])
    both = on(device, {name: torch.cat([far[name], near[name]]) for name in near})
    background = torch.tensor([0.0, 0.0, 2.0], device=device)
    settings = RasterSettings(form=form)
    out = rasterize(**both, **on(device, CAMERA), size=(1, 1), background=background, settings=settings)
    assert out.image[:, 0, 0].tolist() == pytest.approx([0.5, 0.25 + 0.3, 0.125 + 0.2 * 2], rel=1e-6)
    assert float(out.depths) == pytest.approx(0.5 * 2 + 0.5 * 0.6 * 4, rel=1e-6)


@pytest.mark.parametrize("name", SCENES)
def test_float32_matches_the_float64_twin(device, form, name):
    """Image to 1e-6 and every gradient to 5e-6, where rounding cannot change what is blended."""
    errors = errors_of(SCENES[name]().to(device).knobs(form=form))
    assert errors.decided >= 0.98
    assert errors.image <= IMAGE
    assert errors.depth <= IMAGE
    assert max(errors.gradients.values()) <= GRADIENT, errors.gradients


@pytest.mark.parametrize("name", SCENES)
def test_elsewhere_few_pixels_flip(device, form, name):
    """All pixels, decided or not: the share of those that are off."""
    errors = errors_of(SCENES[name]().to(device).knobs(form=form), everywhere=True)
    assert errors.flipped <= FLIPS


@pytest.mark.parametrize("name", SCENES)
def test_float64_matches_the_twin(device, name):
    """Same formulas in the same precision: only rounding is left."""
    scene = SCENES[name]().to(torch.float64)
    cotangent = cotangent_for(scene).double() * decided(scene, margin=1e-9)
    got, got_grads = differentiate(render, scene.to(device), cotangent)
    want, want_grads = differentiate(render_twin, scene, cotangent)
    assert ((got - want).abs() * (cotangent != 0)).max() <= 1e-12
    for input_name, a, b in zip(NAMES, got_grads, want_grads, strict=True):
        assert (a - b).norm() <= 1e-10 * b.norm(), input_name


def test_float64_matches_finite_differences(device):
    """With truncation off, the float64 build is smooth."""
    scene = ball_scene(5, (9, 7), seed=11, sigma=0.3).knobs(alpha_threshold=0.0, stop=0.0)
    scene = scene.to(torch.float64).to(device)
    tensors = tuple(tensor.clone().requires_grad_() for tensor in scene.tensors)
    assert float(render(scene)[3].mean()) > 0.05  # not an empty image
    assert torch.autograd.gradcheck(lambda *t: render(scene, t), tensors, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_float64_matches_finite_differences_where_the_slope_is_limited(device):
    """Gaussians beyond the image's margin: the linearisation's slope is held, and its gradient too."""
    scene = ball_scene(4, (9, 7), seed=12, sigma=1.2).knobs(alpha_threshold=0.0, stop=0.0)
    means = scene.means + torch.tensor([[3.0, 0, 0], [0, 2.5, 0], [-3.0, 1, 0], [0, -2.5, 0.3]])
    scene = replace(scene, means=means).to(torch.float64).to(device)
    tensors = tuple(tensor.clone().requires_grad_() for tensor in scene.tensors)
    assert torch.autograd.gradcheck(lambda *t: render(scene, t), tensors, eps=1e-6, atol=1e-6, rtol=1e-6)


def garden_scene(folder: Any, *, size: tuple[int, int] = (56, 44), sigma: float = 0.012) -> Scene:
    """A window of the garden, at full resolution, with the Gaussians that can be seen in it."""
    with np.load(folder / "raster" / "garden.npz", allow_pickle=False) as data:
        points, rgb = torch.tensor(data["means3d"]), torch.tensor(data["colors"]).float() / 255
        viewmat, K = torch.tensor(data["viewmats"][0]).float(), torch.tensor(data["Ks"][0]).float()
        corner = torch.tensor([data["width"] / 2 - size[0], data["height"] / 2 - size[1]]).float()
    K[:2, 2] -= corner
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixels = camera[:, :2] / camera[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    near = (camera[:, 2] > 0.1) & ((pixels > -12) & (pixels < torch.tensor(size) + 12)).all(1)
    index = near.nonzero()[:2500, 0]
    g = torch.Generator().manual_seed(0)
    n = len(index)
    return Scene(
        means=points[index],
        quats=torch.randn(n, 4, generator=g),
        scales=sigma * torch.exp(0.5 * torch.randn(n, 3, generator=g)),
        opacities=torch.sigmoid(torch.randn(n, generator=g)),
        colors=rgb[index],
        viewmat=viewmat,
        background=torch.tensor([0.1, 0.2, 0.3]),
        K=K,
        size=size,
    )


def test_a_real_scene_matches_the_float64_twin(real_data, device, form):
    """Real points, colours and camera, depths as they come."""
    scene = garden_scene(real_data).to(device).knobs(form=form)
    assert len(scene.means) >= 1000
    errors = errors_of(scene)
    assert errors.decided >= 0.95
    assert errors.image <= IMAGE
    assert max(errors.gradients.values()) <= GRADIENT, errors.gradients
    assert float(render(scene)[3].mean()) > 0.3


def test_screen_gradients_are_those_of_the_means_in_the_image(device, form):
    """What density control reads [1/px]."""
    scene = ball_scene(120, (40, 30), seed=13).knobs(form=form)
    cotangent = cotangent_for(scene) * decided(scene)
    screen = torch.full((len(scene.means), 2), 7.0, device=device)
    narrow = scene.to(device)
    leaves = [tensor.clone().requires_grad_() for tensor in narrow.tensors]
    out = rasterize(
        *leaves[:5], viewmat=leaves[5], background=leaves[6], K=narrow.K, size=scene.size, settings=scene.settings,
        screen_grads=screen,
    )  # fmt: skip
    torch.cat([out.image, out.alphas[None], out.depths[None]]).backward(cotangent.to(device))
    shift = torch.zeros(len(scene.means), 2, dtype=torch.float64, requires_grad=True)
    wide = scene.to(torch.float64)
    twin.rasterize(*wide.tensors, K=wide.K, size=wide.size, settings=wide.settings, shift=shift).backward(
        cotangent.double()
    )
    assert (screen.cpu() - shift.grad).norm() <= GRADIENT * shift.grad.norm()


def test_what_is_hidden_gets_no_gradient(device, form):
    """Behind enough opaque Gaussians nothing is blended, and the gradient is exactly zero."""
    scene = opaque(ball_scene(60, (20, 20), seed=14, sigma=3.0)).to(device).knobs(form=form)
    _, grads = differentiate(render, scene, cotangent_for(scene))
    depths = (scene.means @ scene.viewmat[:3, :3].T + scene.viewmat[:3, 3])[:, 2].cpu()
    hidden = depths.argsort()[10:]
    for name, grad in zip(NAMES[:5], grads, strict=False):
        assert not grad[hidden].any(), name
    assert grads[4].any()


def test_visible_are_those_that_touch_the_image(device, form):
    """Inside, one sigma beyond the border, far beyond it, and behind the camera."""
    gaussian = one_gaussian()
    many = on(device, {name: tensor.repeat(4, *[1] * (tensor.ndim - 1)) for name, tensor in gaussian.items()})
    many["means"] = torch.tensor([[0.0, 0, 2], [0.5, 0, 2], [5.0, 0, 2], [0, 0, -2]], device=device)
    out = rasterize(**many, **on(device, CAMERA), size=(2, 2), settings=RasterSettings(form=form))
    assert out.visible.tolist() == [True, True, False, False]


def test_strided_inputs_and_partial_gradients(device, form):
    """Views with strides are read as they are; what wants no gradient gets none."""
    scene = ball_scene(50, (24, 20), seed=15).to(device).knobs(form=form)
    plain = render(scene)
    strided = replace(scene, means=scene.means.T.contiguous().T, colors=scene.colors.repeat(1, 2)[:, :3])
    assert torch.equal(plain, render(strided))
    colors = scene.colors.clone().requires_grad_()
    render(replace(scene, colors=colors))[0].sum().backward()
    assert colors.grad[:, 0].any()
    assert not colors.grad[:, 1:].any()
    assert scene.means.grad is None


def test_a_second_derivative_is_refused(device, form):
    """The adjoint is not differentiable, and says so."""
    scene = ball_scene(5, (8, 8)).to(device).knobs(form=form)
    colors = scene.colors.clone().requires_grad_()
    out = render(replace(scene, colors=colors)).square().sum()
    (first,) = torch.autograd.grad(out, colors, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


def test_a_change_in_place_is_noticed(device, form):
    """Torch refuses to walk back through inputs that have changed."""
    scene = ball_scene(5, (8, 8)).to(device).knobs(form=form)
    means = scene.means.clone().requires_grad_()
    out = render(replace(scene, means=means)).sum()
    with torch.no_grad():
        means += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.backward()


REFUSALS = {
    "means has shape (5, 2), needs (5, 3)": {"means": torch.zeros(5, 2)},
    "quats has shape (4, 4), needs (5, 4)": {"quats": torch.zeros(4, 4)},
    "background has shape (4,), needs (3,)": {"background": torch.zeros(4)},
    "colors is torch.float64 on cpu, means is torch.float32 on cpu": {"colors": torch.zeros(5, 3).double()},
    "image size must be positive, got 0 x 4": {"size": (0, 4)},
    "alpha_cap must lie between 0 and 0.999999, got 1.0": {"settings": RasterSettings(alpha_cap=1.0)},
    "near must be positive, got 0.0": {"settings": RasterSettings(near=0.0)},
    "alpha_threshold must be at least 0 and below 1, got -0.5": {"settings": RasterSettings(alpha_threshold=-0.5)},
    "stop must be at least 0 and below 1, got nan": {"settings": RasterSettings(stop=math.nan)},
    "low_pass must be at least 0, got -1.0": {"settings": RasterSettings(low_pass=-1.0)},
    "screen_grads has shape (5, 3), needs (5, 2)": {"screen_grads": torch.zeros(5, 3)},
}


@pytest.mark.parametrize("message", REFUSALS)
def test_bad_input_is_refused(message, device):
    """One line that names the argument, what it has and what is needed."""
    scene = ball_scene(5, (8, 8)).to(device)
    bad = {name: v.to(device) if isinstance(v, torch.Tensor) else v for name, v in REFUSALS[message].items()}
    arguments = {name: getattr(scene, name) for name in (*NAMES, "K", "size", "settings")} | bad
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        rasterize(**arguments)
    assert str(caught.value).replace(str(scene.means.device), "cpu") == message


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int32])
def test_other_precisions_are_refused(dtype, device):
    """Only float32 and float64 have kernels; blocks only float32."""
    scene = ball_scene(5, (8, 8)).to(device)
    with pytest.raises(ValueError, match="needs float32 or float64"):
        render(scene.to(dtype))
    with pytest.raises(ValueError, match="form 'blocks' needs float32 on a CPU"):
        render(scene.to(torch.float64).knobs(form="blocks"))
