"""From a capture to an avatar: the paper's two stages, one after the other."""

from __future__ import annotations

import dataclasses
import logging
from typing import Any

import torch

from mgavatar.appearance.model import build_appearance
from mgavatar.appearance.stage import AppearanceStage
from mgavatar.avatar import Avatar
from mgavatar.capture.info import CaptureInfo
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, settled
from mgavatar.fitting.budget import Budget, TooShort, duration
from mgavatar.fitting.loop import Loop
from mgavatar.fitting.plan import plan
from mgavatar.fitting.run import Run, iterations_done, open_checkpoint, restore
from mgavatar.fitting.summary import Summary
from mgavatar.fitting.views import Views
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.stage import GeometryStage
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.head.body import Body
from mgavatar.head.model import HeadModel
from mgavatar.progress import MetricsLog

log = logging.getLogger("mgavatar")


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
    checkpoint, budget = open_checkpoint(run, config, seed, budget, resume=resume)
    summary = Summary(checkpoint["summary"] if checkpoint else None)
    capture = CaptureInfo.of(subject)
    metrics = MetricsLog(run.metrics)
    background = torch.tensor(subject.background, device=device)
    loop = Loop(config, run, metrics, background, seed, summary, budget, fresh=checkpoint is None)
    body = Body(head_model, subdivisions=settled(config.geometry.subdivisions), device=device)
    head = PersonalHead(body, subject.params, config.geometry)
    vertex_gaussians = VertexGaussians(head, config)
    finished: dict[str, Any] = {}
    try:
        if config.geometry.enabled:
            geometry = GeometryStage(vertex_gaussians, config)
            if checkpoint is not None:
                restore(geometry, checkpoint, run)
            loop.run_stage(
                geometry,
                lambda: Views.of(subject, config.geometry.max_image_size, with_masks=config.random_background),
                Avatar(vertex_gaussians, None, capture, config),
                done=iterations_done(checkpoint, geometry),
                state=lambda: {"geometry": geometry.state_dict()},
            )
            finished = {"geometry": geometry.state_dict()}

        appearance = build_appearance(head, config, seed=seed)
        stage = AppearanceStage(appearance, config, seed=seed)
        if checkpoint is not None and "appearance" in checkpoint:
            restore(stage, checkpoint, run)
        avatar = Avatar(vertex_gaussians, appearance, capture, config)
        loop.run_stage(
            stage,
            lambda: Views.of(subject, config.appearance.max_image_size, with_masks=config.random_background),
            avatar,
            done=iterations_done(checkpoint, stage),
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
        log.info("budget %s: used %.0f s: %s", duration(budget.seconds), budget.used, summary.describe())
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


def _n_learned(avatar: Avatar) -> int:
    """Learned numbers of an avatar."""
    parts = [avatar.vertex_gaussians] + ([avatar.appearance] if avatar.appearance is not None else [])
    return sum(parameter.numel() for part in parts for parameter in part.parameters())
