"""Measurements beside the rasterizer for ``tools/bench_trade.py``: the SSIM term and the hash grid of ColorNet."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from statistics import median

import torch
from torch import Tensor
from torch.nn import functional
from trade_raster import BALANCED, Row, Scene, psnr

from mgavatar.appearance.color_net import ColorNet
from mgavatar.avatar import Avatar
from mgavatar.config import ColorNetConfig, ResolvedColorNetConfig
from mgavatar.kernels.rasterize import Rendering, rasterize
from mgavatar.kernels.ssim import compare_images

_C1, _C2, _SIGMA = 0.01**2, 0.03**2, 1.5

LEVELS, LOG2_SIZES = (16, 8, 4), (19, 16, 14)
"""Levels and table sizes of the hash grid; the paper's first."""

HELD_OUT = 8
"""One in this many points is held out from the regression."""


def window_ssim(image: Tensor, target: Tensor, size: int) -> Tensor:
    """Compute the mean SSIM in plain torch, with a Gaussian window of ``size`` pixels and zero padding.

    Images have the shape [3, H, W].
    """
    x = torch.arange(size, dtype=image.dtype) - size // 2
    w = torch.exp(-(x**2) / (2 * _SIGMA**2))
    w = w / w.sum()

    def blur(maps: Tensor) -> Tensor:
        down, along = (w.reshape(shape).expand(len(maps), *shape[1:]) for shape in ((1, 1, size, 1), (1, 1, 1, size)))
        maps = functional.conv2d(maps[None], down, padding=(size // 2, 0), groups=len(maps))
        return functional.conv2d(maps, along, padding=(0, size // 2), groups=maps.shape[1])[0]

    mu_x, mu_y, xx, yy, xy = blur(torch.cat([image, target, image**2, target**2, image * target])).chunk(5)
    light = (2 * mu_x * mu_y + _C1) / (mu_x**2 + mu_y**2 + _C1)
    structure = (2 * (xy - mu_x * mu_y) + _C2) / (xx - mu_x**2 + yy - mu_y**2 + _C2)
    return (light * structure).mean()


def _kernel_ssim(image: Tensor, target: Tensor, scale: int) -> Tensor:
    if scale > 1:
        image, target = (functional.avg_pool2d(x[None], scale)[0] for x in (image, target))
    return compare_images(image, target)[1]


def _ssim_step(function: Callable[[Tensor, Tensor], Tensor], image: Tensor, target: Tensor) -> tuple[float, Tensor]:
    leaf = image.clone().requires_grad_()
    value = function(leaf, target)
    value.backward()
    assert leaf.grad is not None  # noqa: S101  for the type checker
    return float(value.detach()), leaf.grad


def _interleaved(steps: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, tuple[float, float]]:
    """Time steps that take turns; return the median time [ms] and the median ratio to the first of each."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    for step in steps.values():
        step()
    for _ in range(rounds):
        for name, step in steps.items():
            start = time.perf_counter()
            step()
            times[name].append(time.perf_counter() - start)
    base = times[next(iter(steps))]
    return {
        name: (1e3 * median(taken), median(t / b for t, b in zip(taken, base, strict=True)))
        for name, taken in times.items()
    }


def ssim_rows(scene: Scene, *, rounds: int) -> list[Row]:
    """Measure the SSIM term between an avatar's image and the capture: window in plain torch, scale in the kernel."""
    image = _drawn(scene).image.clamp(0.0, 1.0)
    value, exact = _ssim_step(partial(window_ssim, size=11), image.double(), scene.target.double())
    groups: dict[str, dict[str, Callable[[Tensor, Tensor], Tensor]]] = {
        "SSIM window": {str(size): partial(window_ssim, size=size) for size in (11, 7)},
        "SSIM scale": {name: partial(_kernel_ssim, scale=scale) for name, scale in (("1", 1), ("1/2", 2))},
    }
    rows = []
    for knob, functions in groups.items():
        steps = {name: partial(_ssim_step, function, image, scene.target) for name, function in functions.items()}
        times = _interleaved(steps, 4 * rounds)
        for index, (name, step) in enumerate(steps.items()):
            own, gradient = step()
            error = float((gradient.double() - exact).norm() / exact.norm())
            form = "plain torch" if knob == "SSIM window" else "the kernel"
            rows.append(
                Row(
                    knob=knob,
                    value=name,
                    default=index == 0,
                    ms=times[name][0],
                    ratio=times[name][1],
                    gradient={"image": error},
                    note=f"{form}; SSIM {own:.4f}, exact {value:.4f}",
                )
            )
    return rows


def _drawn(scene: Scene) -> Rendering:
    """Draw a scene with the program's defaults."""
    camera = scene.camera
    viewmat, K = (torch.tensor(matrix, dtype=torch.float32) for matrix in (camera.viewmat, camera.K))
    size = (camera.width, camera.height)
    return rasterize(*scene.gaussians, viewmat=viewmat, K=K, size=size, background=scene.background, settings=BALANCED)


def canonical_positions(avatar: Avatar) -> Tensor:
    """Return the positions at which ColorNet is evaluated [m], shape [N, 3]."""
    if avatar.appearance is None:
        return avatar.head.canonical().detach()
    return avatar.appearance.gaussians.canonical_means(avatar.appearance.frozen.frames)


def seen_colors(scenes: Sequence[Scene]) -> tuple[Tensor, Tensor]:
    """Look up the captured colour of each Gaussian.

    A Gaussian is seen where it lies at most 1 % of its distance behind the drawn surface.

    Returns:
        Mean colour over the views that see a Gaussian, shape [N, 3], and True where any view does, shape [N].
    """
    n = len(scenes[0].gaussians[0])
    total, count = torch.zeros(n, 3), torch.zeros(n)
    for scene in scenes:
        drawn = _drawn(scene)
        viewmat, K = (torch.tensor(m, dtype=torch.float32) for m in (scene.camera.viewmat, scene.camera.K))
        points = scene.gaussians[0] @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = (points @ K.T)[:, :2] / points[:, 2:]
        grid = (2.0 * pixels / torch.tensor([scene.camera.width, scene.camera.height]) - 1.0)[None, None]
        maps = torch.cat([scene.target, drawn.depths[None], drawn.alphas[None]])[None]
        values = functional.grid_sample(maps, grid, align_corners=False)[0, :, 0].T
        covered = (grid[0, 0].abs() < 1.0).all(1) & (values[:, 4] > 0.9) & (points[:, 2] > 0.0)
        seen = covered & (points[:, 2] < 1.01 * values[:, 3] / values[:, 4].clamp(min=0.1))
        total[seen] += values[seen, :3]
        count += seen
    return total / count.clamp(min=1.0)[:, None], count > 0


class _Regression:
    """A ColorNet that learns the colours of points, without view directions."""

    def __init__(self, points: Tensor, colors: Tensor, config: ResolvedColorNetConfig) -> None:
        low, high = points.min(0).values, points.max(0).values
        margin = 0.05 * (high - low)
        torch.manual_seed(0)
        self.net = ColorNet(low - margin, high + margin, config, seed=0)
        self.optimizer = torch.optim.Adam(self.net.mlp.parameters(), lr=config.lr, eps=1e-15)
        self.lr = config.lr
        held = torch.arange(len(points)) % HELD_OUT == 0
        self.points, self.colors = points[~held], colors[~held]
        self.held_points, self.held_colors = points[held], colors[held]
        self.directions = torch.zeros_like(self.points)

    def step(self) -> None:
        """Take one step of both optimizers."""
        error = functional.mse_loss(self.net(self.points, self.directions), self.colors)
        self.optimizer.zero_grad(set_to_none=True)
        error.backward()
        self.optimizer.step()
        self.net.grid.adam_step(self.lr)

    @torch.no_grad()
    def scores(self) -> tuple[float, float, float]:
        """Return PSNR [dB] and largest error of the learned points, and PSNR of those held out."""
        fitted = self.net(self.points, self.directions)
        others = self.net(self.held_points, torch.zeros_like(self.held_points))
        worst = float((fitted - self.colors).abs().max())
        return psnr(fitted, self.colors), worst, psnr(others, self.held_colors)


def hash_rows(avatar: Avatar, scenes: Sequence[Scene], *, steps: int) -> list[Row]:
    """Measure levels and table size of the hash grid: time of a step, and colours that ColorNet learns in a few steps.

    The colours are those of the capture at the canonical positions of the Gaussians that a scene shows.
    """
    colors, seen = seen_colors(scenes)
    if not bool(seen.any()):  # no Gaussian covers a pixel: any colours serve to time the grid
        colors, seen = scenes[0].gaussians[4].clamp(0.0, 1.0), torch.ones_like(seen)
    points = canonical_positions(avatar)[seen]
    paper = ResolvedColorNetConfig(**vars(ColorNetConfig()))
    configs = {("hash levels", str(n)): replace(paper, levels=n) for n in LEVELS}
    configs |= {("hash table", f"2^{n}"): replace(paper, log2_table_size=n) for n in LOG2_SIZES}
    distinct = list(dict.fromkeys(configs.values()))
    fits = {str(index): _Regression(points, colors[seen], config) for index, config in enumerate(distinct)}
    times = _interleaved({name: fit.step for name, fit in fits.items()}, steps)
    rows = []
    for (knob, value), config in configs.items():
        name = str(distinct.index(config))
        fitted, worst, held_out = fits[name].scores()
        rows.append(
            Row(
                knob=knob,
                value=value,
                default=config == paper,
                ms=times[name][0],
                ratio=times[name][1],
                psnr=fitted,
                worst=worst,
                gradient={},
                note=f"PSNR of colours learned in {steps} steps; of points held out {held_out:.1f} dB",
            )
        )
    return rows
