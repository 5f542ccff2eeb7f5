"""Files of one fit: its folder, its avatar, and the checkpoint that it goes on from."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mgavatar.avatar import Avatar
from mgavatar.config import ResolvedConfig
from mgavatar.errors import DataError
from mgavatar.files import check_writable, existing_file, make_folder, require_new_folder, write_text
from mgavatar.fitting.budget import Budget, duration
from mgavatar.fitting.plan import Decision
from mgavatar.fitting.stage import Stage
from mgavatar.fitting.summary import Summary
from mgavatar.presets import to_toml

log = logging.getLogger("mgavatar")


@dataclass(frozen=True)
class Run:
    """Files of one fit.

    Attributes:
        folder: Folder of everything but the avatar.
        avatar: Path of the avatar.
    """

    folder: Path
    avatar: Path

    @property
    def checkpoint(self) -> Path:
        """Return the path of the checkpoint."""
        return self.folder / "checkpoint.pt"

    @property
    def metrics(self) -> Path:
        """Return the path of the log of the losses."""
        return self.folder / "metrics.jsonl"


def open_run(out: Path, *, resume: bool) -> Run:
    """Decide where a fit writes: ``out`` is a folder, or the path of the avatar itself (``out.pt``).

    Raises:
        DataError: If there is something already, and it is not to be resumed; or nothing to resume; or if nothing can
            be written there.
    """
    folder = out.with_suffix("") if out.suffix == ".pt" else out
    run = Run(folder, out if out.suffix == ".pt" else folder / "avatar.pt")
    if resume:
        if not run.checkpoint.is_file():
            raise DataError(f"{run.checkpoint}: nothing to resume; leave --resume out to start a fit there")
    else:
        require_new_folder(folder, or_else=", or --resume to go on with the fit there")
        if run.avatar.exists():
            raise DataError(f"{run.avatar}: already exists; give --out another name")
    check_writable(folder, kind="folder")
    return run


def open_checkpoint(
    run: Run | None, config: ResolvedConfig, seed: int, budget: Budget | None, *, resume: bool
) -> tuple[dict[str, Any] | None, Budget | None]:
    """Make a new run's folder, or read the checkpoint to continue from.

    Returns:
        The checkpoint, None for a new run, and the budget with what was spent of it before.

    Raises:
        DataError: If the folder cannot be made, or the checkpoint is missing, damaged or of another fit.
    """
    if run is None:
        return None, budget
    if not resume:
        make_folder(run.folder)
        write_text(run.folder / "config.toml", to_toml(config))
        return None, budget
    checkpoint = _read_checkpoint(run, config, seed)
    if budget is None and checkpoint["budget"] is not None:
        budget = Budget(checkpoint["budget"])
    if budget is not None:
        budget.spent = checkpoint["used"]
    return checkpoint, budget


def close_run(
    run: Run | None,
    avatar: Avatar,
    summary: Summary,
    decisions: Sequence[Decision],
    *,
    budget: Budget | None,
    seed: int,
) -> None:
    """Write the avatar and ``summary.json`` of a finished fit, and log what became of its budget."""
    if budget is not None:
        log.info("budget %s: used %.0f s: %s", duration(budget.seconds), budget.used, summary.describe())
    if run is None:
        return
    avatar.save(run.avatar)
    parts = [avatar.vertex_gaussians] + ([avatar.appearance] if avatar.appearance is not None else [])
    summary.write(
        run.folder / "summary.json",
        gaussians=avatar.n_gaussians,
        parameters=sum(parameter.numel() for part in parts for parameter in part.parameters()),
        budget_seconds=budget.seconds if budget is not None else None,
        plan=[dataclasses.asdict(decision) for decision in decisions],
        seed=seed,
        device=str(avatar.device),
    )


def discard_run(run: Run | None) -> None:
    """Remove the files of a fit that made no iteration worth keeping, so that its place is free for another one."""
    if run is not None:
        for path in (run.folder / "config.toml", run.metrics, run.checkpoint):
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # something else is in it
            run.folder.rmdir()


def iterations_done(checkpoint: dict[str, Any] | None, stage: Stage) -> int:
    """Return the number of iterations that a checkpoint holds of a stage that is not finished."""
    return int(checkpoint["iteration"]) if checkpoint is not None and checkpoint["stage"] == stage.name else 0


def restore(stage: Stage, checkpoint: dict[str, Any] | None, run: Run | None) -> None:
    """Load a stage's state from a checkpoint, if there is one that has come as far as this stage.

    Raises:
        DataError: If the state does not fit the stage.
    """
    if checkpoint is None or run is None or (stage.name not in checkpoint and checkpoint["stage"] == "geometry"):
        return
    try:
        stage.load_state_dict(checkpoint[stage.name])
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{run.checkpoint}: does not fit; give the capture and head model that it was made with, "
            "or leave --resume out for a new folder if an earlier version of mgavatar wrote it"
        ) from error


def _read_checkpoint(run: Run, config: ResolvedConfig, seed: int) -> dict[str, Any]:
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
