"""Several views in one launch: each has the same bits as the view alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from checks import threads
from raster_scenes import NAMES, Scene, ball_scene, decided
from torch import Tensor
from twins import raster as twin

from mgavatar.kernels import bridge
from mgavatar.kernels.rasterize import RasterSettings, Rendering, rasterize

BUILDS = {
    "plain float32": ("plain", torch.float32),
    "plain float64": ("plain", torch.float64),
    "blocks float32": ("blocks", torch.float32),
}


@pytest.fixture(params=BUILDS)
def build(request: pytest.FixtureRequest, device: torch.device) -> tuple[str, torch.dtype]:
    """Form and precision, every one that the device has."""
    if BUILDS[request.param][0] == "blocks" and device.type != "cpu":
        pytest.skip("the block form is the CPU's")
    return BUILDS[request.param]


def some_views(form: str = "auto", counts: tuple[int, ...] = (200, 90, 1, 140), sigma: float = 0.12) -> list[Scene]:
    """Scenes of one image size, with their own Gaussians, cameras and backgrounds."""
    views = []
    for i, n in enumerate(counts):
        scene = ball_scene(n, (150, 37), seed=30 + i, sigma=sigma).knobs(form=form)
        viewmat, K = scene.viewmat.clone(), scene.K.clone()
        viewmat[:3, 3] += torch.tensor([0.1, -0.05, 0.2]) * i
        K[:2, :2] *= 1 + 0.1 * i
        K[:2, 2] += 1.5 * i
        views.append(replace(scene, viewmat=viewmat, K=K, background=scene.background.roll(i)))
    return views


def in_turn(counts: list[int]) -> Tensor:
    """Places of the Gaussians of several views when they take turns; each view keeps its own order."""
    ranks = torch.cat([torch.arange(n) for n in counts])
    return torch.sort(ranks, stable=True).indices


def cotangents_for(views: list[Scene], dtype: torch.dtype) -> Tensor:
    """Random weights of all outputs, shape [B, 5, H, W]."""
    width, height = views[0].size
    g = torch.Generator().manual_seed(6)
    return torch.randn(len(views), 5, height, width, generator=g, dtype=torch.float64).to(dtype)


def planes(out: Rendering) -> Tensor:
    """Return image, alphas and depths in one, shape [..., 5, H, W]."""
    return torch.cat([out.image, out.alphas.unsqueeze(-3), out.depths.unsqueeze(-3)], -3)


def draw(leaves: list[Tensor], **arguments: Any) -> Tensor:
    """All planes of the rasterizer, from the tensors that ``NAMES`` names."""
    return planes(rasterize(*leaves[:5], viewmat=leaves[5], background=leaves[6], **arguments))


def run(tensors: list[Tensor], cotangent: Tensor, **arguments: Any) -> list[Tensor]:
    """Planes, gradients of the inputs and of the means in the image, on the CPU."""
    leaves = [tensor.detach().clone().requires_grad_() for tensor in tensors]
    screen = torch.full((len(leaves[0]), 2), 7.0, dtype=leaves[0].dtype, device=leaves[0].device)
    out = draw(leaves, screen_grads=screen, **arguments)
    out.backward(cotangent.to(out))
    return [t.cpu() for t in (out.detach(), *(leaf.grad for leaf in leaves), screen)]


def run_alone(views: list[Scene], cotangents: Tensor, device: torch.device, dtype: torch.dtype) -> list[Tensor]:
    """Each view for itself, put together: planes, Gaussians' gradients in a row, cameras' and backgrounds' by view."""
    results = []
    for view, cotangent in zip(views, cotangents, strict=True):
        scene = view.to(dtype).to(device)
        tensors = list(scene.tensors)
        results.append(run(tensors, cotangent, K=scene.K, size=scene.size, settings=scene.settings))
    by_view = (0, 6, 7)
    return [
        torch.stack(parts) if i in by_view else torch.cat(parts) for i, parts in enumerate(zip(*results, strict=True))
    ]


def joined(views: list[Scene], order: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
    """Inputs of one launch with its Gaussians in ``order``, their views and the intrinsics."""
    gaussians = [torch.cat([getattr(view, name) for view in views])[order] for name in NAMES[:5]]
    cameras = [torch.stack([getattr(view, name) for view in views]) for name in NAMES[5:]]
    counts = torch.tensor([len(view.means) for view in views])
    view_ids = torch.repeat_interleave(torch.arange(len(views)), counts)[order].int()
    return [*gaussians, *cameras], view_ids, torch.stack([view.K for view in views])


def run_together(
    views: list[Scene], cotangents: Tensor, device: torch.device, dtype: torch.dtype, order: Tensor
) -> list[Tensor]:
    """All views in one launch; per Gaussian results are put back into the order of the views."""
    tensors, view_ids, Ks = joined(views, order)
    tensors = [tensor.to(device, dtype) for tensor in tensors]
    arguments = {"K": Ks.to(device, dtype), "size": views[0].size, "settings": views[0].settings}
    results = run(tensors, cotangents, view_ids=view_ids.to(device), **arguments)
    back = torch.argsort(order)
    return [r[back] if i in (1, 2, 3, 4, 5, 8) else r for i, r in enumerate(results)]


RESULTS = ("planes", *NAMES, "screen_grads")


@pytest.mark.parametrize("mixed", [False, True], ids=["one after the other", "in turn"])
def test_views_together_are_the_bits_of_each_alone(device, build, mixed):
    """Forward and every gradient, however the Gaussians of the views are mixed."""
    form, dtype = build
    views = some_views(form)
    counts = [len(view.means) for view in views]
    cotangents = cotangents_for(views, dtype)
    order = in_turn(counts) if mixed else torch.arange(sum(counts))
    alone = run_alone(views, cotangents, device, dtype)
    together = run_together(views, cotangents, device, dtype, order)
    for name, a, b in zip(RESULTS, alone, together, strict=True):
        assert a.abs().max() > 0, name
        assert torch.equal(a, b), name


def test_any_order_of_the_gaussians(device, build):
    """Shuffled across and within views: the same bits, but for the camera's gradient, a sum over them."""
    form, dtype = build
    views = some_views(form)
    n = sum(len(view.means) for view in views)
    cotangents = cotangents_for(views, dtype)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(2))
    plain = run_together(views, cotangents, device, dtype, torch.arange(n))
    mixed = run_together(views, cotangents, device, dtype, order)
    for name, a, b in zip(RESULTS, plain, mixed, strict=True):
        if name == "viewmat":
            assert (a - b).norm() <= 1e-7 * a.norm()
        else:
            assert torch.equal(a, b), name


@pytest.mark.parametrize("form", ["plain", "blocks"])
def test_any_number_of_threads_gives_the_same_bits(form):
    """Ranges of tiles and of Gaussians may cut through views."""
    views = some_views(form)
    n = sum(len(view.means) for view in views)
    cotangents = cotangents_for(views, torch.float32)
    results = []
    for count in (1, 3):
        with threads(count):
            results.append(run_together(views, cotangents, torch.device("cpu"), torch.float32, torch.arange(n)))
    for name, a, b in zip(RESULTS, *results, strict=True):
        assert torch.equal(a, b), name


def test_a_batch_of_one_is_the_single_view(device, build):
    """With a first axis of one."""
    form, dtype = build
    views = some_views(form, (120,))
    cotangents = cotangents_for(views, dtype)
    alone = run_alone(views, cotangents, device, dtype)
    together = run_together(views, cotangents, device, dtype, torch.arange(120))
    for name, a, b in zip(RESULTS, alone, together, strict=True):
        assert torch.equal(a, b), name


@pytest.mark.parametrize("counts", [(80, 0, 50), (0, 0)])
def test_a_view_without_gaussians_is_its_background(device, build, counts):
    """Nothing covers it; its background gets all of the gradient, its camera none."""
    form, dtype = build
    views = some_views(form, counts)
    cotangents = cotangents_for(views, dtype)
    out, *grads = run_together(views, cotangents, device, dtype, torch.arange(sum(counts)))
    for b in (b for b, n in enumerate(counts) if n == 0):
        background = views[b].background.to(dtype)
        assert torch.equal(out[b, :3], background[:, None, None].expand_as(out[b, :3]))
        assert not out[b, 3:].any()
        assert not grads[5][b].any()
        assert grads[6][b].tolist() == pytest.approx(cotangents[b, :3].sum((1, 2)).tolist(), rel=1e-4)
    for name, a, b in zip(RESULTS, run_alone(views, cotangents, device, dtype), [out, *grads], strict=True):
        assert torch.equal(a, b), name


def test_float32_matches_the_float64_twin(device):
    """Image to 1e-6 and every gradient to 5e-6, where rounding cannot change what is blended."""
    views = some_views()
    mask = torch.stack([decided(view) for view in views])
    assert mask.double().mean() >= 0.98
    cotangents = cotangents_for(views, torch.float64) * mask[:, None]
    order = in_turn([len(view.means) for view in views])
    tensors, view_ids, Ks = joined(views, order)
    arguments = {"size": views[0].size, "settings": views[0].settings}
    narrow = [tensor.to(device) for tensor in tensors]
    got = run(narrow, cotangents, K=Ks.to(device), view_ids=view_ids.to(device), **arguments)
    leaves = [tensor.double().requires_grad_() for tensor in tensors]
    want = twin.rasterize_views(*leaves, K=Ks.double(), view_ids=view_ids, **arguments)
    want.backward(cotangents)
    off = (got[0] - want.detach()).abs() * mask[:, None]
    assert off[:, :4].max() <= 1e-6
    assert off[:, 4].max() <= 1e-6 * want[:, 4].abs().max()
    for name, a, leaf in zip(NAMES, got[1:], leaves, strict=False):
        assert (a - leaf.grad).norm() <= 5e-6 * leaf.grad.norm(), name


def test_float64_matches_finite_differences(device):
    """With truncation off; cameras and backgrounds of all views among the inputs."""
    views = [replace(view, size=(9, 7)) for view in some_views(counts=(3, 2))]
    tensors, view_ids, Ks = joined(views, in_turn([3, 2]))
    Ks = Ks * torch.tensor([0.1, 0.15, 1.0])[:, None]
    leaves = [tensor.to(device, torch.float64).requires_grad_() for tensor in tensors]
    settings = RasterSettings(alpha_threshold=0.0, stop=0.0)
    arguments = {"K": Ks.to(leaves[0]), "view_ids": view_ids.to(device), "size": (9, 7), "settings": settings}
    assert bool((draw(leaves, **arguments)[:, 3].mean((1, 2)) > 0.02).all())  # no empty image
    assert torch.autograd.gradcheck(lambda *t: draw(t, **arguments), leaves, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_one_background_and_one_lens_may_serve_all_views(device, build):
    """As if they were repeated; the background's gradient is the sum."""
    form, dtype = build
    first, second = (view.to(dtype).to(device) for view in some_views(form, (60, 40)))
    tensors, view_ids, _ = joined([first, replace(second, background=first.background)], torch.arange(100))
    arguments = {"view_ids": view_ids.to(device), "size": first.size, "settings": first.settings}
    cotangents = cotangents_for([first, second], dtype)
    each = run(tensors, cotangents, K=first.K.repeat(2, 1, 1), **arguments)
    shared = run([*tensors[:6], first.background], cotangents, K=first.K, **arguments)
    for name, a, b in zip(RESULTS, each, shared, strict=True):
        assert torch.equal(a.sum(0) if name == "background" else a, b), name
    black = rasterize(*tensors[:5], viewmat=tensors[5], K=first.K, **arguments)
    zeros = rasterize(*tensors[:5], viewmat=tensors[5], K=first.K, background=torch.zeros_like(tensors[6]), **arguments)
    assert torch.equal(planes(black), planes(zeros))


def test_as_many_launches_as_for_one_view(device, build, monkeypatch):
    """Each kernel once, forward and backward."""
    form, dtype = build
    names: list[str] = []
    launch = bridge.wp.launch

    def counted(kernel: Any, *args: Any, **kwargs: Any) -> None:
        names.append(kernel.key)
        launch(kernel, *args, **kwargs)

    monkeypatch.setattr(bridge.wp, "launch", counted)
    with threads(1):
        for counts in ((60,), (60, 50, 40)):
            views = some_views(form, counts)
            run_together(views, cotangents_for(views, dtype), device, dtype, torch.arange(sum(counts)))
    assert len(names) == 12
    assert names[:6] == names[6:]
    assert len(set(names)) == 6


def test_a_change_of_the_views_in_place_is_noticed(device):
    """Backward reads them again."""
    tensors, view_ids, Ks = joined(some_views(counts=(5, 5)), torch.arange(10))
    leaves = [tensor.to(device).requires_grad_() for tensor in tensors]
    view_ids = view_ids.to(device)
    out = draw(leaves, K=Ks.to(device), view_ids=view_ids, size=(8, 8)).sum()
    view_ids += 100
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.backward()


SHAPE = "viewmat has shape (2, 4, 4), so view_ids must give each Gaussian's view"
REFUSALS: dict[str, dict[str, Any]] = {
    SHAPE: {"view_ids": None},
    "view_ids needs several views, but viewmat has shape (4, 4)": {
        "viewmat": torch.eye(4), "K": torch.eye(3), "background": torch.zeros(3),
    },
    "view_ids has shape (3,), needs (5,)": {"view_ids": torch.zeros(3, dtype=torch.int32)},
    "view_ids is torch.int64 on cpu, needs torch.int32 on cpu": {"view_ids": torch.zeros(5, dtype=torch.int64)},
    "view_ids lie in 0..2, need 0..1": {"view_ids": torch.tensor([0, 1, 2, 1, 0], dtype=torch.int32)},
    "view_ids lie in -1..1, need 0..1": {"view_ids": torch.tensor([0, 1, -1, 1, 0], dtype=torch.int32)},
    "viewmat has shape (0, 4, 4), needs at least one view": {"viewmat": torch.zeros(0, 4, 4)},
    "viewmat has shape (2, 3, 4), needs (2, 4, 4)": {"viewmat": torch.zeros(2, 3, 4)},
    "viewmat has shape (1, 2, 4, 4), needs (4, 4)": {"viewmat": torch.zeros(1, 2, 4, 4)},
    "K has shape (3, 3, 3), needs (2, 3, 3)": {"K": torch.zeros(3, 3, 3)},
    "background has shape (3, 3), needs (2, 3)": {"background": torch.zeros(3, 3)},
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSALS)
def test_bad_input_is_refused(message, device):
    """One line that names the argument, what it has and what is needed."""
    tensors, view_ids, Ks = joined(some_views(counts=(3, 2)), torch.arange(5))
    arguments = dict(zip(NAMES, tensors, strict=True)) | {"K": Ks, "view_ids": view_ids}
    arguments |= REFUSALS[message]
    on_device = {name: None if value is None else value.to(device) for name, value in arguments.items()}
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        rasterize(**on_device, size=(8, 8))
    assert str(caught.value).replace(str(on_device["means"].device), "cpu") == message


def test_more_pixels_than_an_array_can_hold_are_refused(device):
    """Their index would overflow."""
    tensors, view_ids, Ks = joined(some_views(counts=(3, 2)), torch.arange(5))
    arguments = dict(zip(NAMES, tensors, strict=True)) | {"K": Ks, "view_ids": view_ids}
    with pytest.raises(ValueError, match="2 x 32768 x 32768 pixels are more than 2147483647: lower the image size"):
        rasterize(**{name: value.to(device) for name, value in arguments.items()}, size=(32768, 32768))
