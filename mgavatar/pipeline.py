"""The whole of a fit: check everything first, fit, score, report."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mgavatar.avatar import Avatar
from mgavatar.capture.images import check_images
from mgavatar.capture.placement import check_placement
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, check
from mgavatar.device import find_device
from mgavatar.errors import DataError
from mgavatar.files import one_line
from mgavatar.fitting.budget import Budget, parse_budget
from mgavatar.fitting.fit import fit_avatar
from mgavatar.fitting.loop import Interrupted
from mgavatar.fitting.run import Run, open_run
from mgavatar.head.model import HeadModel
from mgavatar.presets import preset
from mgavatar.progress import FitProgress
from mgavatar.reporting.page import write_report
from mgavatar.scoring.evaluate import evaluate_sample
from mgavatar.scoring.truth import check_ground_truth

SAMPLE = 24
"""Images per split that a fit is scored on at its end."""

MAX_SEED = 2**31 - 1

log = logging.getLogger("mgavatar")


@dataclass(frozen=True, eq=False)
class FitResult:
    """The outcome of a fit.

    Attributes:
        avatar: The avatar; as far as it came if the fit was stopped.
        finished: False if the fit was stopped; ``resume=True`` continues it.
        stopped_at: Stage and iteration at which the fit was stopped, for example ``"stopped in geometry at 5/12"``.
        scores: Scores on a sample of the held-out images, as :func:`mgavatar.evaluate` returns them, or None.
        path: File of the avatar, or None if nothing was written.
        report: The HTML report, or None.
    """

    avatar: Avatar
    finished: bool
    stopped_at: str | None
    scores: dict[str, Any] | None
    path: Path | None
    report: Path | None


def fit(
    subject: Subject,
    head_model: HeadModel,
    config: FitConfig | None = None,
    *,
    out: Path | str | None = None,
    device: str | torch.device = "cpu",
    seed: int = 0,
    resume: bool = False,
    budget: str | Budget | None = None,
    progress: Callable[[FitProgress], None] | None = None,
    stop: Callable[[], bool] | None = None,
    score_images: int | None = SAMPLE,
) -> FitResult:
    """Fit an avatar to a capture, score it and write a report.

    All that can be known to be wrong is refused before the first iteration. Nothing is printed, messages go to the
    logger ``mgavatar``, and torch's global generator is left alone. Ctrl-C, if this is the main thread, and ``stop``
    end the fit after the current iteration, with everything saved.

    Args:
        subject: The capture, from :func:`mgavatar.read_capture`.
        head_model: Head model that the capture was tracked with, from :func:`mgavatar.load_head_model`.
        config: Configuration, from :func:`mgavatar.preset`; the preset ``quick`` by default.
        out: Folder for the avatar, its report and checkpoints, or the path of the avatar, ending in ``.pt``, whose
            other files go to the folder of the same name. Nothing is written if None.
        device: ``"auto"``, ``"cpu"``, ``"cuda"``, or a device of torch's.
        seed: Seed of all random draws; a fit repeats bit for bit on one machine.
        resume: Continue the fit in ``out``.
        budget: Time after which the avatar is written, such as ``"5m"``, counted from this call.
        progress: Called after every iteration.
        stop: Asked after every iteration; True stops the fit.
        score_images: Score at most so many images per split; all of them if None.

    Returns:
        The avatar with its scores and the paths of its files.

    Raises:
        DataError: If the capture, the configuration or ``out`` cannot work; the message says what to do.
    """
    if isinstance(budget, str):
        budget = Budget(parse_budget(budget))
    if config is None:
        config = preset("quick")
    check(config)
    check_seed(seed)
    chosen = find_device(device)
    run = open_run(Path(out), resume=resume) if out is not None else None
    check_ground_truth(subject)
    check_images(subject)
    _warn_of_truncated_parameters(subject, head_model)
    check_placement(subject, head_model)
    try:
        avatar = fit_avatar(
            subject,
            head_model,
            config,
            run,
            device=chosen,
            seed=seed,
            resume=resume,
            budget=budget,
            progress=progress,
            stop=stop,
        )
    except Interrupted as stopped:
        stopped.avatar.freeze()
        path = run.avatar if run is not None else None
        return FitResult(stopped.avatar, False, str(stopped), None, path, None)
    avatar.freeze()
    scores, report = _score_and_report(avatar, subject, run, score_images)
    return FitResult(avatar, True, None, scores, run.avatar if run is not None else None, report)


def check_seed(seed: int) -> None:
    """Refuse a seed that not every random generator takes.

    Raises:
        DataError: If it is negative or too large.
    """
    if not 0 <= seed <= MAX_SEED:
        raise DataError(f"--seed {seed}: must lie between 0 and {MAX_SEED}")


def _warn_of_truncated_parameters(subject: Subject, head_model: HeadModel) -> None:
    """Log the tracked parameters that the head model has no directions for."""
    params = subject.params
    widths = {"shape": (params.shape, head_model.n_shape), "expr": (params.expr, head_model.n_expr)}
    for name, (values, n) in widths.items():
        if np.any(values[..., n:]):
            log.warning(
                "%s: %s has %d columns, %s takes %d: the rest is cut; is it the head model that the capture was "
                "tracked with?",
                subject.root,
                name,
                values.shape[-1],
                head_model.name,
                n,
            )


def _score_and_report(
    avatar: Avatar, subject: Subject, run: Run | None, score_images: int | None
) -> tuple[dict[str, Any] | None, Path | None]:
    """Score a finished fit and write its report; whatever goes wrong here must not cost the fit."""
    path = run.avatar if run is not None else None
    scores, report = None, None
    try:
        scores = evaluate_sample(avatar, subject, avatar_path=path, max_frames=score_images)
    except Exception as error:
        log.warning("the avatar is complete, but could not be scored: %s", one_line(error))
    if run is None:
        return scores, None
    try:
        report = write_report(run.folder, avatar, subject, scores, history=run.metrics)
    except Exception as error:
        log.warning("the avatar is complete, but its report could not be written: %s", one_line(error))
    return scores, report
