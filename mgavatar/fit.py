"""From a capture to an avatar: the paper's two stages, one after the other."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from mgavatar.appearance.stage import AppearanceStage
from mgavatar.avatar import Avatar, CaptureInfo, build_appearance
from mgavatar.camera import Camera
from mgavatar.capture.images import read_images, read_masks
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, to_toml
from mgavatar.errors import DataError
from mgavatar.files import atomic_write, existing_file
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.stage import GeometryStage, VertexGaussians
from mgavatar.head.body import FINE_ENOUGH, Body
from mgavatar.head.model import HeadModel
from mgavatar.progress import MetricsLog, Reporter

FINE_EDGE = 4.0
"""An edge of so few pixels [px] is not worth splitting."""

log = logging.getLogger("mgavatar")


class Stage(Protocol):
    """What the loop needs of a stage."""

    name: str
    iterations: int

    def step(self, camera: Camera, timestep: int, target: Tensor, background: Tensor) -> dict[str, float]: ...

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
) -> Avatar:
    """Fit an avatar (Section 3): geometry first, then, with the mesh frozen, appearance.

    Writes ``config.toml``, ``metrics.jsonl``, ``checkpoint.pt`` and the avatar into the run's folder. A checkpoint is
    written every few minutes and when the user interrupts; ``resume`` goes on from it bit for bit.

    Raises:
        Interrupted: After Ctrl-C; the avatar as far as it came has been saved.
    """
    torch.manual_seed(seed)
    config = with_subdivisions(config, head_model, subject)
    checkpoint = _read_checkpoint(run, config, seed) if resume else None
    run.folder.mkdir(parents=True, exist_ok=True)
    if checkpoint is None:
        (run.folder / "config.toml").write_text(to_toml(config), encoding="utf-8")
    capture = CaptureInfo.of(subject)
    metrics = MetricsLog(run.metrics)
    loop = _Loop(config, run, metrics, torch.tensor(subject.background, device=device), seed)
    body = Body(head_model, subdivisions=config.geometry.subdivisions, device=device)
    head = PersonalHead(body, subject.params, config.geometry)
    vertex_gaussians = VertexGaussians(head, config)
    try:
        geometry = GeometryStage(vertex_gaussians, config)
        if checkpoint is not None:
            _restore(geometry, checkpoint, run)
        loop.run_stage(
            geometry,
            Views.of(subject, config.geometry.max_image_size, with_masks=config.random_background),
            Avatar(vertex_gaussians, None, capture, config),
            done=_done(checkpoint, geometry),
            state=lambda: {"geometry": geometry.state_dict()},
        )
        finished = geometry.state_dict()

        appearance = build_appearance(head, config, seed=seed)
        stage = AppearanceStage(appearance, config, seed=seed)
        if checkpoint is not None and "appearance" in checkpoint:
            _restore(stage, checkpoint, run)
        avatar = Avatar(vertex_gaussians, appearance, capture, config)
        loop.run_stage(
            stage,
            Views.of(subject, config.appearance.max_image_size, with_masks=config.random_background),
            avatar,
            done=_done(checkpoint, stage),
            state=lambda: {"geometry": finished, "appearance": stage.state_dict()},
        )
    finally:
        metrics.close()
    avatar.save(run.avatar)
    return avatar


def with_subdivisions(config: FitConfig, head_model: HeadModel, subject: Subject) -> FitConfig:
    """Settle ``auto``: the mesh that the images can show. The number goes into the avatar."""
    if config.geometry.subdivisions != "auto":
        return config
    frame = subject.frames["train"][0]
    camera = frame.camera
    shrink = min(1.0, config.appearance.max_image_size / max(camera.width, camera.height))
    verts, faces = head_model.v_template, head_model.faces
    edge = float(np.linalg.norm(verts[faces] - verts[np.roll(faces, -1, axis=1)], axis=2).mean())
    center = verts.mean(0) + subject.params.translation[frame.timestep]
    depth = float(camera.viewmat[2, :3] @ center + camera.viewmat[2, 3])
    pixels = shrink * camera.K[0, 0] * edge / max(depth, 1e-6)
    times = 1 if len(verts) < FINE_ENOUGH and pixels > FINE_EDGE else 0
    log.info("%d subdivisions: %d vertices, edges of %.1f mm are %.1f px", times, len(verts), 1e3 * edge, pixels)
    return replace(config, geometry=replace(config.geometry, subdivisions=times))


def _done(checkpoint: dict[str, Any] | None, stage: Stage) -> int:
    """Iterations of a stage that a checkpoint holds."""
    if checkpoint is None:
        return 0
    if checkpoint["stage"] == stage.name:
        return int(checkpoint["iteration"])
    return stage.iterations if stage.name == "geometry" else 0


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

    def run_stage(
        self, stage: Stage, views: Views, avatar: Avatar, *, done: int, state: Callable[[], dict[str, Any]]
    ) -> None:
        """Iterations ``done`` + 1 to the last; ``state`` is what a checkpoint holds besides its place."""
        order = iter(ViewOrder(len(views.images), self.seed))
        for _ in range(done):
            next(order)
        started = saved = time.monotonic()
        with Reporter(stage.name, stage.iterations, done=done) as reporter, _StopRequest() as stop:
            for iteration in range(done + 1, stage.iterations + 1):
                view = next(order)
                background = self._background(iteration) if views.masks is not None else self.background
                target = views.target(view, self.background, background)
                terms = stage.step(views.cameras[view], views.timesteps[view], target, background)
                if not np.isfinite(terms["loss"]):
                    raise DataError(
                        f"{self.run.folder}: the {stage.name} loss is not finite at iteration {iteration}; "
                        "lower the learning rates"
                    )
                reporter.update(iteration, f"loss {terms['loss']:.4f}  {int(terms['gaussians'])} Gaussians")
                now = time.monotonic()
                if iteration % self.config.log_every == 0 or iteration == stage.iterations:
                    self.log.write(stage=stage.name, iteration=iteration, seconds=round(now - started, 3), **terms)
                if now - saved > 60.0 * self.config.checkpoint_minutes or stop.requested:
                    self._save(stage, iteration, state)
                    saved = now
                if stop.requested:
                    avatar.save(self.run.avatar)
                    raise Interrupted(f"stopped in {stage.name} at {iteration}/{stage.iterations}")
        if stage.iterations > done:
            self._save(stage, stage.iterations, state)

    def _background(self, iteration: int) -> Tensor:
        """The colour of an iteration; it depends on nothing else, so a resumed run sees the same."""
        color = np.random.default_rng((self.seed, iteration)).random(3, dtype=np.float32)
        return torch.from_numpy(color).to(self.background.device)

    def _save(self, stage: Stage, iteration: int, state: Callable[[], dict[str, Any]]) -> None:
        checkpoint = {"stage": stage.name, "iteration": iteration, "config": to_toml(self.config), "seed": self.seed}
        checkpoint |= state()
        with atomic_write(self.run.checkpoint) as file:
            torch.save(checkpoint, file)


def _restore(stage: Stage, checkpoint: dict[str, Any], run: Run) -> None:
    try:
        stage.load_state_dict(checkpoint[stage.name])
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{run.checkpoint}: was made with another capture or head model; give those again") from error


def _read_checkpoint(run: Run, config: FitConfig, seed: int) -> dict[str, Any]:
    path = existing_file(run.checkpoint)
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        stored, stored_seed = checkpoint["config"], checkpoint["seed"]
    except Exception as error:
        raise DataError(f"{path}: not a checkpoint of `mgavatar fit`; remove the folder and start again") from error
    if stored != to_toml(config):
        raise DataError(f"{path}: was made with another configuration; give --preset {run.folder / 'config.toml'}")
    if stored_seed != seed:
        raise DataError(f"{path}: was made with --seed {stored_seed}, not {seed}; give --seed {stored_seed}")
    return checkpoint
