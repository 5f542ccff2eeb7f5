"""The loop of a stage: views in random order, with progress, log, budget and checkpoints."""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.config import FitConfig, to_toml
from mgavatar.errors import DataError
from mgavatar.files import atomic_write
from mgavatar.fitting.budget import Budget, Pacer, duration, geometry_share
from mgavatar.fitting.run import Run
from mgavatar.fitting.stage import Stage
from mgavatar.fitting.summary import Summary
from mgavatar.fitting.views import ViewOrder, Views
from mgavatar.progress import MetricsLog, Reporter

log = logging.getLogger("mgavatar")


_CLOSE = 1e-6
"""A schedule is over when less of it is left, in iterations."""


class Interrupted(Exception):
    """The user pressed Ctrl-C; the avatar has been saved."""


class _StopRequest:
    """Turns the first Ctrl-C into a request, so that a step is never cut in two; the second one stops at once."""

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> _StopRequest:
        self.previous = signal.signal(signal.SIGINT, self._request)
        return self

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self.previous)


@dataclass(frozen=True, eq=False)
class Loop:
    """Views in random order through a stage, with progress, log and checkpoints."""

    config: FitConfig
    run: Run
    log: MetricsLog
    background: Tensor
    seed: int
    summary: Summary
    budget: Budget | None
    fresh: bool

    def run_stage(
        self,
        stage: Stage,
        read_views: Callable[[], Views],
        avatar: Avatar,
        *,
        done: int,
        state: Callable[[], dict[str, Any]],
    ) -> None:
        """Iterations ``done`` + 1 to the last; ``state`` is what a checkpoint holds besides its place."""
        if finished(stage):
            return
        views = read_views()
        order = iter(ViewOrder(len(views.images), self.seed))
        for _ in range(done):
            next(order)
        pacer = self._pacer(stage)
        iteration, total = done, stage.iterations
        started = noted = saved = time.monotonic()
        with Reporter(stage.name, stage.iterations, done=done) as reporter, _StopRequest() as stop:
            while not finished(stage):
                iteration += 1
                schedule_step = 1.0 if pacer is None else pacer.schedule_step(stage.position)
                view = next(order)
                background = self._background(iteration) if views.masks is not None else self.background
                target = views.target(view, self.background, background)
                terms = stage.step(views.cameras[view], views.timesteps[view], target, background, schedule_step)
                if not np.isfinite(terms["loss"]):
                    raise DataError(
                        f"{self.run.folder}: the {stage.name} loss is not finite at iteration {iteration}; "
                        "lower the learning rates"
                    )
                total = iteration + math.ceil((stage.iterations - stage.position) / schedule_step - _CLOSE)
                if pacer is not None and pacer.calibrated:
                    self._log_pace(stage, total, pacer)
                note = f"loss {terms['loss']:.4f}  {int(terms['gaussians'])} Gaussians"
                reporter.update(iteration, note, total=total)
                now = time.monotonic()
                if iteration % self.config.log_every == 0 or finished(stage):
                    self.log.write(stage=stage.name, iteration=iteration, seconds=round(now - started, 3), **terms)
                if now - saved > 60.0 * self.config.checkpoint_minutes or stop.requested or finished(stage):
                    self.summary.stage(
                        stage.name, iterations=iteration, configured=stage.iterations, seconds=now - noted
                    )
                    self._save(stage, iteration, state)
                    noted, saved = now, time.monotonic()
                if stop.requested:
                    avatar.save(self.run.avatar)
                    raise Interrupted(f"stopped in {stage.name} at {iteration}/{total}")

    def _pacer(self, stage: Stage) -> Pacer | None:
        if self.budget is None:
            return None
        first = stage.name == "geometry" or not self.config.geometry.enabled
        share = geometry_share(stage.position / stage.iterations) if stage.name == "geometry" else 1.0
        return self.budget.pacer(stage.iterations, share=share, must_fit=first and self.fresh)

    def _log_pace(self, stage: Stage, total: int, pacer: Pacer) -> None:
        """What the budget makes of a stage, once its pacer is known."""
        factor = total / stage.iterations
        text = f"{stage.name} gets {pacer.left:.0f} s more, about {total} of {stage.iterations} iterations"
        if stage.name == "appearance":
            c = self.config.appearance.density
            start, stop, every = (round(factor * value) for value in (c.start, c.stop, c.every))
            text += f"; density control from {start} to {stop}, every {every}"
        if factor > 4.0:
            text += f"; that is {factor:.1f} times the preset's: a larger preset makes more of so much time"
        assert self.budget is not None  # noqa: S101  for the type checker
        log.info("budget %s: %s", duration(self.budget.seconds), text)

    def _background(self, iteration: int) -> Tensor:
        """A corner of the colour cube, the strongest contrasts, by the iteration alone: a resumed run sees the same."""
        corner = np.random.default_rng((self.seed, iteration)).integers(0, 2, 3).astype(np.float32)
        return torch.from_numpy(corner).to(self.background.device)

    def _save(self, stage: Stage, iteration: int, state: Callable[[], dict[str, Any]]) -> None:
        summary = self.summary.state()
        checkpoint = {
            "stage": stage.name,
            "iteration": iteration,
            "config": to_toml(self.config),
            "seed": self.seed,
            "budget": self.budget.seconds if self.budget is not None else None,
            "used": self.budget.used if self.budget is not None else summary["seconds"],
            "summary": summary,
        }
        checkpoint |= state()
        with atomic_write(self.run.checkpoint) as file:
            torch.save(checkpoint, file)


def finished(stage: Stage) -> bool:
    return stage.iterations - stage.position <= _CLOSE
