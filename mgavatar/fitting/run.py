"""Files of one fit: its folder, its avatar, and the checkpoint that it goes on from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mgavatar.config import FitConfig, to_toml
from mgavatar.errors import DataError
from mgavatar.files import existing_file
from mgavatar.fitting.budget import Budget
from mgavatar.fitting.stage import Stage


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


def open_checkpoint(
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


def iterations_done(checkpoint: dict[str, Any] | None, stage: Stage) -> int:
    """Iterations that a checkpoint holds of a stage that is not finished."""
    return int(checkpoint["iteration"]) if checkpoint is not None and checkpoint["stage"] == stage.name else 0


def restore(stage: Stage, checkpoint: dict[str, Any], run: Run) -> None:
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
