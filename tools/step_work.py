"""Both stages of a fit at three sizes, warmed up on a synthetic capture, for ``tools/bench_fit.py`` to time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from mgavatar.appearance.model import build_appearance
from mgavatar.appearance.stage import AppearanceStage
from mgavatar.capture.read import read_capture
from mgavatar.config import FitConfig
from mgavatar.fitting.plan import plan
from mgavatar.fitting.stage import Stage
from mgavatar.fitting.views import Views
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.stage import GeometryStage
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.head.body import Body
from mgavatar.head.procedural.build import build_head
from mgavatar.presets import preset
from mgavatar.synthetic.capture import make_synthetic_capture

WARM_UP = 30
"""Iterations of a stage before it is timed: enough for sizes and opacities to leave their initial values."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """Amount of work.

    Attributes:
        name: Preset of about this size.
        image: Width and height [px].
        gaussians: Number of face-bound Gaussians to grow to.
        config: Configuration of the fit.
    """

    name: str
    image: tuple[int, int]
    gaussians: int
    config: FitConfig


def sizes() -> Iterator[Size]:
    """Yield ``quick``, ``balanced`` and ``paper`` with fixed values for every setting that costs time."""
    quick = preset("quick")
    paper = FitConfig()
    a = paper.appearance
    balanced = replace(
        paper,
        random_background=True,
        appearance=replace(
            a,
            color_net=replace(a.color_net, levels=12, max_resolution=1024, log2_table_size=17),
            offset_net=replace(a.offset_net, resolution=128),
        ),
    )
    yield Size(name="quick", image=(256, 256), gaussians=40_000, config=quick)
    yield Size(name="balanced", image=(400, 550), gaussians=100_000, config=balanced)
    yield Size(name="paper", image=(550, 802), gaussians=200_000, config=paper)


class Bench:
    """Both stages of a fit that can be stepped one iteration at a time."""

    def __init__(self, size: Size, folder: Path, device: torch.device) -> None:
        """Make a capture of six training images in ``folder`` and set up the head."""
        torch.manual_seed(0)
        self.size = size
        self.device = device
        make_synthetic_capture(folder, cameras=4, timesteps=3, size=size.image)
        subject = read_capture(folder)
        head_model = build_head()
        self.config, _ = plan(size.config, head_model, subject)
        self.background = torch.tensor(subject.background, device=device)
        self.views = Views.of(subject, 8192, with_masks=self.config.random_background)
        body = Body(head_model, subdivisions=self.config.geometry.subdivisions, device=device)
        self.head = PersonalHead(body, subject.params, self.config.geometry)

    def step(self, stage: Stage, iteration: int) -> None:
        """Take one optimizer step with one view, as the loop of a fit does."""
        view = iteration % len(self.views.images)
        background = self.background
        if self.views.masks is not None:
            background = torch.rand(3, generator=torch.Generator().manual_seed(iteration)).to(self.device)
        target = self.views.target(view, self.background, background)
        stage.step(self.views.cameras[view], self.views.timesteps[view], target, background)

    def geometry(self) -> GeometryStage:
        """Build the geometry stage and warm it up."""
        stage = GeometryStage(VertexGaussians(self.head, self.config), self.config)
        for iteration in range(WARM_UP):
            self.step(stage, iteration)
        return stage

    def appearance(self) -> AppearanceStage:
        """Build the appearance stage, warm it up and grow it to the number of Gaussians of its size."""
        appearance = build_appearance(self.head, self.config, seed=0)
        stage = AppearanceStage(appearance, self.config, seed=0)
        for iteration in range(WARM_UP):
            self.step(stage, iteration)
        control = stage.density
        usual = control.config
        control.config = replace(usual, gradient=0.0, max_gaussians=self.size.gaussians)
        before = 0
        while before < len(appearance.gaussians) < self.size.gaussians:
            before = len(appearance.gaussians)
            refine(stage)
            for iteration in range(WARM_UP):
                self.step(stage, iteration)
        control.config = usual
        return stage


def refine(stage: AppearanceStage) -> None:
    """Run one event of density control."""
    appearance = stage.appearance
    stage.density.refine(stage.optimizer, appearance.frozen.frames.scales)
    appearance.rebind()
