"""From a capture to an avatar: the paper's two stages, one after the other (Section 3).

This file is the paper's table of contents; each step names its equations and the module that has them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import torch

from mgavatar.appearance.model import Appearance, build_appearance
from mgavatar.appearance.stage import AppearanceStage
from mgavatar.avatar import Avatar
from mgavatar.capture.info import CaptureInfo
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, ResolvedConfig
from mgavatar.fitting.budget import Budget, TooShort
from mgavatar.fitting.loop import Loop
from mgavatar.fitting.plan import plan
from mgavatar.fitting.run import Run, close_run, discard_run, iterations_done, open_checkpoint, restore
from mgavatar.fitting.seeding import ParameterInit
from mgavatar.fitting.summary import Summary
from mgavatar.fitting.views import Views
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.stage import GeometryStage
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.head.body import Body
from mgavatar.head.model import HeadModel
from mgavatar.progress import FitProgress, MetricsLog

log = logging.getLogger("mgavatar")


def fit_avatar(
    subject: Subject,
    head_model: HeadModel,
    config: FitConfig,
    run: Run | None,
    *,
    device: torch.device,
    seed: int = 0,
    resume: bool = False,
    budget: Budget | None = None,
    progress: Callable[[FitProgress], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Avatar:
    """Fit an avatar: geometry first, then, with the mesh frozen, appearance.

    Writes ``config.toml``, ``metrics.jsonl``, ``checkpoint.pt``, ``summary.json`` and the avatar of ``run``. A
    checkpoint is written every few minutes and when the fit is stopped; ``resume`` continues from it bit for bit. With
    a ``budget`` the schedules of both stages are as long as its time allows.

    Args:
        subject: The capture.
        head_model: Head model that the capture was tracked with.
        config: The request; the plan decides each ``auto``.
        run: Files of the fit, or None to write nothing.
        device: Device of all computations.
        seed: Seed of all random draws; torch's global generator is left alone.
        resume: Continue from the checkpoint of ``run``.
        budget: Time of the whole fit, or None for the configured iterations.
        progress: Called after every iteration.
        stop: Asked after every iteration; True ends the fit as Ctrl-C does.

    Returns:
        The avatar, on ``device``.

    Raises:
        TooShort: If the budget does not allow even the least number of iterations.
        Interrupted: If the fit was stopped; the avatar as far as it came has been saved, and is its attribute.
        DataError: If an image is damaged, a loss is not finite, a file cannot be written, or a checkpoint does not fit.
    """
    resolved, decisions = plan(config, head_model, subject)
    for decision in decisions:
        log.info("plan: %s", decision)
    checkpoint, budget = open_checkpoint(run, resolved, seed, budget, resume=resume)
    summary = Summary(checkpoint["summary"] if checkpoint else None)
    metrics = MetricsLog(run.metrics if run is not None else None)
    loop = Loop(
        config=resolved,
        run=run,
        log=metrics,
        background=torch.tensor(subject.background, device=device),
        seed=seed,
        summary=summary,
        budget=budget,
        checkpoint=checkpoint,
        progress=progress,
        stop=stop,
    )
    init = ParameterInit(seed)
    try:
        vertex_gaussians = fit_geometry(subject, head_model, resolved, loop, init, device=device)
        avatar = fit_appearance(subject, vertex_gaussians, resolved, loop, init)
    except TooShort:
        discard_run(run)
        raise
    close_run(run, avatar, summary, decisions, budget=budget, seed=seed)
    return avatar


def fit_geometry(
    subject: Subject,
    head_model: HeadModel,
    config: ResolvedConfig,
    loop: Loop,
    init: ParameterInit,
    *,
    device: torch.device,
) -> VertexGaussians:
    """Fit the personal head mesh with vertex-bound Gaussians (Section 3.1).

    Returns:
        The Gaussians on the refined head, which is ``VertexGaussians.head``.
    """
    # The template: FLAME, subdivided (head/body.py).
    body = Body(head_model, subdivisions=config.geometry.subdivisions, device=device)
    with init:
        # Eq. 1, canonical positions, and Eq. 2, pose offsets: RefineNet (geometry/refine_net.py).
        # Eq. 3, animated positions: both offsets, then blend skinning (geometry/head.py).
        head = PersonalHead(body, subject.params, config.geometry, train_rows=CaptureInfo.of(subject).train_timesteps)
        # One Gaussian per vertex with reduced freedom (geometry/vertex_gaussians.py).
        vertex_gaussians = VertexGaussians(head, config)
    if config.geometry.enabled:
        # Eq. 4 to 6, image, offset and Laplacian losses, and Eq. 7, their sum (geometry/stage.py).
        stage = GeometryStage(vertex_gaussians, config)
        restore(stage, loop.checkpoint, loop.run)
        loop.run_stage(
            stage,
            lambda: Views.of(subject, config.geometry.max_image_size, with_masks=config.random_background),
            Avatar(vertex_gaussians, None, CaptureInfo.of(subject), config),
            done=iterations_done(loop.checkpoint, stage),
        )
    return vertex_gaussians


def fit_appearance(
    subject: Subject,
    vertex_gaussians: VertexGaussians,
    config: ResolvedConfig,
    loop: Loop,
    init: ParameterInit,
) -> Avatar:
    """Fit the appearance with face-bound Gaussians on the frozen mesh (Section 3.2).

    Returns:
        The avatar.
    """
    with init:
        # Eq. 8, binding to faces (appearance/face_gaussians.py); Eq. 9, ColorNet (appearance/color_net.py);
        # Eq. 10, OffsetNet (appearance/offset_net.py).
        appearance: Appearance = build_appearance(vertex_gaussians.head, config, seed=loop.seed)
    # Eq. 11, the objective, and density control (appearance/stage.py, appearance/density.py).
    stage = AppearanceStage(appearance, config, seed=loop.seed)
    restore(stage, loop.checkpoint, loop.run)
    avatar = Avatar(vertex_gaussians, appearance, CaptureInfo.of(subject), config)
    loop.run_stage(
        stage,
        lambda: Views.of(subject, config.appearance.max_image_size, with_masks=config.random_background),
        avatar,
        done=iterations_done(loop.checkpoint, stage),
    )
    return avatar
