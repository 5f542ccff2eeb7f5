"""From a capture to an avatar: the paper's two stages, one after the other."""

from __future__ import annotations

import dataclasses
import logging
import math
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from mgavatar.appearance.stage import AppearanceStage
from mgavatar.avatar import Avatar, CaptureInfo, build_appearance
from mgavatar.budget import Budget, Pace, TooShort, duration, geometry_share
from mgavatar.camera import Camera
from mgavatar.capture.images import read_images, read_masks
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, to_toml
from mgavatar.errors import DataError
from mgavatar.files import atomic_write, existing_file
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.stage import GeometryStage, VertexGaussians
from mgavatar.head.body import Body
from mgavatar.head.model import HeadModel
from mgavatar.plan import plan
from mgavatar.progress import MetricsLog, Reporter
from mgavatar.summary import Summary

_CLOSE = 1e-6
"""A schedule is over when less of it is left, in iterations."""

log = logging.getLogger("mgavatar")


class Stage(Protocol):
    """What the loop needs of a stage: its schedule has ``iterations``, and it is at ``position`` of them."""

    name: str
    iterations: int
    position: float

    def step(
        self, camera: Camera, timestep: int, target: Tensor, background: Tensor, advance: float = 1.0
    ) -> dict[str, float]: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


@dataclass(frozen=True, eq=False)
class Views:
    """Training images in memory, as bytes.

    Attributes:
        images: Shape [N, 3, H, W], uint8, on the CPU.
        masks: Coverage, shape [N, H, W], uint8, or None where a view has none.
        cameras: N cameras at the size of ``images``.
        timesteps: N rows of the capture's parameters.
    """

    images: Tensor
    masks: Tensor | None
    cameras: list[Camera]
    timesteps: list[int]

    @staticmethod
    def of(subject: Subject, max_size: int, *, with_masks: bool) -> Views:
        """Decode the training split, reduced until its longer side has at most ``max_size`` pixels."""
        frames = subject.frames["train"]
        first = frames[0].camera
        scale = min(1.0, max_size / max(first.width, first.height))
        size = (max(1, round(first.width * scale)), max(1, round(first.height * scale)))
        cameras = [frame.camera.scaled(*size) for frame in frames]
        masked = with_masks and all(frame.mask_path is not None for frame in frames)
        masks = read_masks(frames, size=size) if masked else None
        return Views(read_images(frames, size=size), masks, cameras, [frame.timestep for frame in frames])

    def target(self, view: int, background: Tensor, new_background: Tensor) -> Tensor:
        """A view in 0..1, shape [3, H, W], moved from one background colour to another."""
        image = self.images[view].to(background.device).float() / 255.0
        if self.masks is None:
            return image
        clear = 1.0 - self.masks[view].to(background.device).float() / 255.0
        return image + clear * (new_background - background)[:, None, None]


class ViewOrder:
    """Endless shuffled passes over the views."""

    def __init__(self, n_views: int, seed: int) -> None:
        self.n_views = n_views
        self.rng = np.random.default_rng(seed)
        self.left: list[int] = []

    def __iter__(self) -> Iterator[int]:
        while True:
            if not self.left:
                self.left = self.rng.permutation(self.n_views).tolist()
            yield self.left.pop()


class Interrupted(Exception):
    """The user pressed Ctrl-C; the avatar has been saved."""


@dataclass(frozen=True)
class Run:
    """Files of one fit.

    Attributes:
        folder: ``RUN``.
        avatar: Where the avatar goes.
    """

    folder: Path
    avatar: Path

    @property
    def checkpoint(self) -> Path:
        return self.folder / "checkpoint.pt"

    @property
    def metrics(self) -> Path:
        return self.folder / "metrics.jsonl"


def open_run(out: Path, *, resume: bool) -> Run:
    """Decide where a fit writes: ``out`` is a folder, or the path of the avatar itself (``out.pt``).

    Raises:
        DataError: If there is something already, and it is not to be resumed; or nothing to resume.
    """
    folder = out.with_suffix("") if out.suffix == ".pt" else out
    run = Run(folder, out if out.suffix == ".pt" else folder / "avatar.pt")
    if resume:
        if not run.checkpoint.is_file():
            raise DataError(f"{run.checkpoint}: nothing to resume; leave --resume out to start a fit there")
        return run
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder}: is a file; give --out another folder")
    if folder.is_dir() and any(folder.iterdir()):
        raise DataError(f"{folder}: is not empty; give --out another folder, or --resume to go on with the fit there")
    if run.avatar.exists():
        raise DataError(f"{run.avatar}: exists; give --out another name")
    return run


def fit(
    subject: Subject,
    head_model: HeadModel,
    config: FitConfig,
    run: Run,
    *,
    device: torch.device,
    seed: int = 0,
    resume: bool = False,
    budget: Budget | None = None,
) -> Avatar:
    """Fit an avatar (Section 3): geometry first, then, with the mesh frozen, appearance.

    Writes ``config.toml``, ``metrics.jsonl``, ``checkpoint.pt``, ``summary.json`` and the avatar into the run's folder.
    A checkpoint is written every few minutes and when the user interrupts; ``resume`` goes on from it bit for bit. With
    a ``budget`` the schedules of both stages are made as long as its time allows, and what is left of it when resumed.

    Raises:
        TooShort: If the budget does not allow even the least number of iterations.
        Interrupted: After Ctrl-C; the avatar as far as it came has been saved.
    """
    torch.manual_seed(seed)
    config, decisions = plan(config, head_model, subject)
    for decision in decisions:
        log.info("plan: %s", decision)
    checkpoint, budget = _opened(run, config, seed, budget, resume=resume)
    summary = Summary(checkpoint["summary"] if checkpoint else None)
    capture = CaptureInfo.of(subject)
    metrics = MetricsLog(run.metrics)
    background = torch.tensor(subject.background, device=device)
    loop = _Loop(config, run, metrics, background, seed, summary, budget, fresh=checkpoint is None)
    body = Body(head_model, subdivisions=config.geometry.subdivisions, device=device)
    head = PersonalHead(body, subject.params, config.geometry)
    vertex_gaussians = VertexGaussians(head, config)
    finished: dict[str, Any] = {}
    try:
        if config.geometry.enabled:
            geometry = GeometryStage(vertex_gaussians, config)
            if checkpoint is not None:
                _restore(geometry, checkpoint, run)
            loop.run_stage(
                geometry,
                lambda: Views.of(subject, config.geometry.max_image_size, with_masks=config.random_background),
                Avatar(vertex_gaussians, None, capture, config),
                done=_done(checkpoint, geometry),
                state=lambda: {"geometry": geometry.state_dict()},
            )
            finished = {"geometry": geometry.state_dict()}

        appearance = build_appearance(head, config, seed=seed)
        stage = AppearanceStage(appearance, config, seed=seed)
        if checkpoint is not None and "appearance" in checkpoint:
            _restore(stage, checkpoint, run)
        avatar = Avatar(vertex_gaussians, appearance, capture, config)
        loop.run_stage(
            stage,
            lambda: Views.of(subject, config.appearance.max_image_size, with_masks=config.random_background),
            avatar,
            done=_done(checkpoint, stage),
            state=lambda: finished | {"appearance": stage.state_dict()},
        )
    except TooShort:
        for path in (run.folder / "config.toml", run.metrics, run.checkpoint):
            path.unlink(missing_ok=True)  # nothing is lost, and --out is free for a longer fit
        raise
    finally:
        metrics.close()
    avatar.save(run.avatar)
    if budget is not None:
        log.info("budget %s: used %.0f s: %s", duration(budget.seconds), budget.used, summary.told())
    summary.write(
        run.folder / "summary.json",
        gaussians=avatar.n_gaussians,
        parameters=_n_learned(avatar),
        budget_seconds=budget.seconds if budget is not None else None,
        plan=[dataclasses.asdict(decision) for decision in decisions],
        seed=seed,
        device=str(device),
    )
    return avatar


def _opened(
    run: Run, config: FitConfig, seed: int, budget: Budget | None, *, resume: bool
) -> tuple[dict[str, Any] | None, Budget | None]:
    """The checkpoint to go on from, if any, and what it has left of the budget; a new run's folder otherwise."""
    if not resume:
        run.folder.mkdir(parents=True, exist_ok=True)
        (run.folder / "config.toml").write_text(to_toml(config), encoding="utf-8")
        return None, budget
    checkpoint = _read_checkpoint(run, config, seed)
    if budget is None and checkpoint["budget"] is not None:
        budget = Budget(checkpoint["budget"])
    if budget is not None:
        budget.spent = checkpoint["used"]
    return checkpoint, budget


def _done(checkpoint: dict[str, Any] | None, stage: Stage) -> int:
    """Iterations that a checkpoint holds of a stage that is not finished."""
    return int(checkpoint["iteration"]) if checkpoint is not None and checkpoint["stage"] == stage.name else 0


def _n_learned(avatar: Avatar) -> int:
    """Learned numbers of an avatar."""
    parts = [avatar.vertex_gaussians] + ([avatar.appearance] if avatar.appearance is not None else [])
    return sum(parameter.numel() for part in parts for parameter in part.parameters())


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
class _Loop:
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
        if _finished(stage):
            return
        views = read_views()
        order = iter(ViewOrder(len(views.images), self.seed))
        for _ in range(done):
            next(order)
        pace = self._pace(stage)
        iteration, total = done, stage.iterations
        started = noted = saved = time.monotonic()
        with Reporter(stage.name, stage.iterations, done=done) as reporter, _StopRequest() as stop:
            while not _finished(stage):
                iteration += 1
                advance = 1.0 if pace is None else pace.advance(stage.position)
                view = next(order)
                background = self._background(iteration) if views.masks is not None else self.background
                target = views.target(view, self.background, background)
                terms = stage.step(views.cameras[view], views.timesteps[view], target, background, advance)
                if not np.isfinite(terms["loss"]):
                    raise DataError(
                        f"{self.run.folder}: the {stage.name} loss is not finite at iteration {iteration}; "
                        "lower the learning rates"
                    )
                total = iteration + math.ceil((stage.iterations - stage.position) / advance - _CLOSE)
                if pace is not None and pace.just_known:
                    self._tell_pace(stage, total, pace)
                note = f"loss {terms['loss']:.4f}  {int(terms['gaussians'])} Gaussians"
                reporter.update(iteration, note, total=total)
                now = time.monotonic()
                if iteration % self.config.log_every == 0 or _finished(stage):
                    self.log.write(stage=stage.name, iteration=iteration, seconds=round(now - started, 3), **terms)
                if now - saved > 60.0 * self.config.checkpoint_minutes or stop.requested or _finished(stage):
                    self.summary.stage(
                        stage.name, iterations=iteration, configured=stage.iterations, seconds=now - noted
                    )
                    self._save(stage, iteration, state)
                    noted, saved = now, time.monotonic()
                if stop.requested:
                    avatar.save(self.run.avatar)
                    raise Interrupted(f"stopped in {stage.name} at {iteration}/{total}")

    def _pace(self, stage: Stage) -> Pace | None:
        if self.budget is None:
            return None
        first = stage.name == "geometry" or not self.config.geometry.enabled
        share = geometry_share(stage.position / stage.iterations) if stage.name == "geometry" else 1.0
        return self.budget.pace(stage.iterations, share=share, must_fit=first and self.fresh)

    def _tell_pace(self, stage: Stage, total: int, pace: Pace) -> None:
        """What the budget makes of a stage, once its pace is known."""
        factor = total / stage.iterations
        text = f"{stage.name} gets {pace.left:.0f} s more, about {total} of {stage.iterations} iterations"
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


def _finished(stage: Stage) -> bool:
    return stage.iterations - stage.position <= _CLOSE


def _restore(stage: Stage, checkpoint: dict[str, Any], run: Run) -> None:
    try:
        stage.load_state_dict(checkpoint[stage.name])
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{run.checkpoint}: does not fit; give the capture and head model that it was made with, "
            "or leave --resume out for a new folder if an earlier version of mgavatar wrote it"
        ) from error


def _read_checkpoint(run: Run, config: FitConfig, seed: int) -> dict[str, Any]:
    path = existing_file(run.checkpoint)
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        stored, stored_seed = checkpoint["config"], checkpoint["seed"]
        _ = checkpoint["summary"], checkpoint["budget"], checkpoint["used"]
    except Exception as error:
        raise DataError(f"{path}: not a checkpoint of `mgavatar fit`; remove the folder and start again") from error
    if stored != to_toml(config):
        raise DataError(f"{path}: was made with another configuration; give --preset {run.folder / 'config.toml'}")
    if stored_seed != seed:
        raise DataError(f"{path}: was made with --seed {stored_seed}, not {seed}; give --seed {stored_seed}")
    return checkpoint
