"""The loop of a stage: views in random order, with progress, log, budget and checkpoints."""

from __future__ import annotations

import logging
import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.config import ResolvedConfig
from mgavatar.errors import DataError
from mgavatar.files import atomic_write
from mgavatar.fitting.budget import Budget, Pacer, duration, geometry_share
from mgavatar.fitting.run import Run
from mgavatar.fitting.stage import Stage
from mgavatar.fitting.summary import Summary
from mgavatar.fitting.views import ViewOrder, Views
from mgavatar.presets import to_toml
from mgavatar.progress import FitProgress, MetricsLog

log = logging.getLogger("mgavatar")


_CLOSE = 1e-6
"""A schedule is over when less of it is left, in iterations."""


class Interrupted(Exception):
    """The fit was stopped by Ctrl-C or by its caller; the avatar as far as it came has been saved.

    Attributes:
        avatar: The avatar as far as it came.
    """

    def __init__(self, message: str, avatar: Avatar) -> None:
        super().__init__(message)
        self.avatar = avatar


class _StopRequest:
    """Turn the first Ctrl-C into a request, so that a step is never cut in two; the second one stops at once.

    Only the main thread receives signals; elsewhere the caller's ``stop`` is the only request.
    """

    def __init__(self, stop: Callable[[], bool] | None) -> None:
        self._stop = stop
        self._interrupted = False
        self._handles_signals = threading.current_thread() is threading.main_thread()

    @property
    def requested(self) -> bool:
        return self._interrupted or (self._stop is not None and self._stop())

    def __enter__(self) -> _StopRequest:
        if self._handles_signals:
            self._previous = signal.signal(signal.SIGINT, self._request)
        return self

    def _request(self, number: int, frame: FrameType | None) -> None:
        self._interrupted = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def __exit__(self, *_: object) -> None:
        if self._handles_signals:
            signal.signal(signal.SIGINT, self._previous)


@dataclass(eq=False, kw_only=True)
class Loop:
    """Show the views in random order to a stage, with progress, log and checkpoints.

    Attributes:
        config: The fit's configuration.
        run: Files of the fit, or None to write nothing.
        log: Receives the terms of the losses.
        background: Colour behind the subject in the images, shape [3], on the fit's device.
        seed: Seed of the order of views and of the random backgrounds.
        summary: Receives time and iterations of each stage.
        budget: Time of the whole fit, or None.
        checkpoint: Contents of the checkpoint that the fit continues from, or None.
        progress: Called after every iteration, or None.
        stop: Asked after every iteration whether to stop, or None.
        finished: States of the stages that are done, which later checkpoints hold too.
    """

    config: ResolvedConfig
    run: Run | None
    log: MetricsLog
    background: Tensor
    seed: int
    summary: Summary
    budget: Budget | None
    checkpoint: dict[str, Any] | None
    progress: Callable[[FitProgress], None] | None = None
    stop: Callable[[], bool] | None = None
    finished: dict[str, Any] = field(default_factory=dict)

    def run_stage(self, stage: Stage, read_views: Callable[[], Views], avatar: Avatar, *, done: int) -> None:
        """Run a stage from iteration ``done`` + 1 to its end.

        Args:
            stage: The stage.
            read_views: Decodes the training images; not called if the stage is done.
            avatar: The avatar that this stage changes, saved when the fit is stopped.
            done: Iterations of the stage that its state already holds.

        Raises:
            Interrupted: If the fit was stopped.
            DataError: If the loss is not finite or a file cannot be written.
        """
        if not is_finished(stage):
            self._iterate(stage, read_views(), avatar, done=done)
        self.finished[stage.name] = stage.state_dict()

    def _iterate(self, stage: Stage, views: Views, avatar: Avatar, *, done: int) -> None:
        order = iter(ViewOrder(len(views.images), self.seed))
        for _ in range(done):  # the order continues where the checkpoint left it
            next(order)
        pacer = self._pacer(stage)
        iteration = done
        started = noted = saved = time.monotonic()
        with _StopRequest(self.stop) as stop:
            while not is_finished(stage):
                iteration += 1
                schedule_step = 1.0 if pacer is None else pacer.schedule_step(stage.position)
                terms = self._step(stage, views, next(order), iteration, schedule_step)
                total = iteration + math.ceil((stage.iterations - stage.position) / schedule_step - _CLOSE)
                if pacer is not None and pacer.calibrated:
                    self._log_pace(stage, total, pacer)
                if self.progress is not None:
                    self.progress(FitProgress(stage.name, iteration, total, terms))
                now = time.monotonic()
                requested, last = stop.requested, is_finished(stage)
                if last or iteration % self.config.log_every == 0:
                    self.log.write(stage=stage.name, iteration=iteration, seconds=round(now - started, 3), **terms)
                if last or requested or now - saved > 60.0 * self.config.checkpoint_minutes:
                    self.summary.stage(
                        stage.name, iterations=iteration, configured=stage.iterations, seconds=now - noted
                    )
                    self._save(stage, iteration)
                    noted, saved = now, time.monotonic()
                if requested:
                    if self.run is not None:
                        avatar.save(self.run.avatar)
                    raise Interrupted(f"stopped in {stage.name} at {iteration}/{total}", avatar)

    def _step(self, stage: Stage, views: Views, view: int, iteration: int, schedule_step: float) -> dict[str, float]:
        background = self._background(iteration) if views.has_mask[view] else self.background
        target = views.target(view, self.background, background)
        terms = stage.step(views.cameras[view], views.timesteps[view], target, background, schedule_step)
        if not np.isfinite(terms["loss"]):
            where = f"{self.run.folder}: " if self.run is not None else ""
            raise DataError(
                f"{where}the {stage.name} loss is not finite at iteration {iteration}; lower the learning rates"
            )
        return terms

    def _pacer(self, stage: Stage) -> Pacer | None:
        if self.budget is None:
            return None
        first = stage.name == "geometry" or not self.config.geometry.enabled
        share = geometry_share(stage.position / stage.iterations) if stage.name == "geometry" else 1.0
        return self.budget.pacer(stage.iterations, share=share, must_fit=first and self.checkpoint is None)

    def _log_pace(self, stage: Stage, total: int, pacer: Pacer) -> None:
        """Log how many iterations the budget allows, once the pacer knows how long one takes."""
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
        """Draw a corner of the colour cube, the strongest contrasts; a resumed fit draws the same ones."""
        corner = np.random.default_rng((self.seed, iteration)).integers(0, 2, 3).astype(np.float32)
        return torch.from_numpy(corner).to(self.background.device)

    def _save(self, stage: Stage, iteration: int) -> None:
        """Write a checkpoint, if the fit writes files."""
        if self.run is None:
            return
        summary = self.summary.state()
        checkpoint = {
            "stage": stage.name,
            "iteration": iteration,
            "config": to_toml(self.config),
            "seed": self.seed,
            "budget": self.budget.seconds if self.budget is not None else None,
            "used": self.budget.used if self.budget is not None else summary["seconds"],
            "summary": summary,
            **self.finished,
            stage.name: stage.state_dict(),
        }
        with atomic_write(self.run.checkpoint) as file:
            torch.save(checkpoint, file)


def is_finished(stage: Stage) -> bool:
    """Return True if a stage's schedule is over."""
    return stage.iterations - stage.position <= _CLOSE
