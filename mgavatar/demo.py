"""``mgavatar demo``: a synthetic capture, its avatar, a driven video and scores, from nothing."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mgavatar.avatar import Avatar
from mgavatar.capture.read import read_capture
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, check
from mgavatar.device import find_device
from mgavatar.driving.read import read_driving
from mgavatar.driving.render import render
from mgavatar.errors import DataError
from mgavatar.files import atomic_write, make_folder, require_new_folder
from mgavatar.head.procedural.build import build_head
from mgavatar.pipeline import check_seed, fit
from mgavatar.progress import FitReporter, Reporter
from mgavatar.scoring.evaluate import write_metrics
from mgavatar.synthetic.capture import make_synthetic_capture

DRIVING_FRAMES = 60
FPS = 25.0


def run_demo(out: Path, config: FitConfig, *, device: str, seed: int) -> dict[str, Any]:
    """Make a capture, fit, drive, score and report in a new folder.

    Args:
        out: Folder to make; it gets ``capture``, ``run``, ``driving.npz``, ``driven.mp4`` (or ``.gif`` without PyAV)
            and ``metrics.json``.
        config: Configuration of the fit.
        device: ``"auto"``, ``"cpu"``, ``"cuda"``, or a device of torch's.
        seed: Seed of the person and of the fit.

    Returns:
        The scores, as :func:`mgavatar.evaluate` returns them.

    Raises:
        DataError: If ``out`` exists and is not empty, or cannot be made, or the fit was stopped.
    """
    check_seed(seed)
    check(config)
    find_device(device)
    require_new_folder(out)
    make_folder(out)
    head = build_head()
    with Reporter("capture", 16 * 12) as reporter:
        make_synthetic_capture(out / "capture", seed=seed, head=head, progress=lambda done, _: reporter.update(done))
    subject = read_capture(out / "capture")
    with FitReporter() as fit_reporter:
        result = fit(
            subject,
            head,
            config,
            out=out / "run",
            device=device,
            seed=seed,
            progress=fit_reporter,
            score_images=None,
        )
    if not result.finished:
        raise KeyboardInterrupt
    if result.scores is None:
        raise DataError(f"{out}: the fit could not be scored")
    write_metrics(out / "metrics.json", result.scores)
    _drive(result.avatar, subject, out)
    return result.scores


def _drive(avatar: Avatar, subject: Subject, out: Path) -> None:
    """Write a driving sequence in VHAP's keys and render it as a video."""
    path = out / "driving.npz"
    with atomic_write(path) as file:
        np.savez(file, **demo_motion(avatar))  # type: ignore[arg-type]
    with Reporter("render", DRIVING_FRAMES) as reporter:
        film = out / ("driven.mp4" if find_spec("av") else "driven.gif")
        render(avatar, read_driving(path), out=film, progress=lambda done, _: reporter.update(done))


def demo_motion(avatar: Avatar) -> dict[str, np.ndarray]:
    """Return a driving sequence of a person who talks, smiles, blinks, turns and looks around.

    It loops without a jump. Expressions are directions of the built-in head.

    Args:
        avatar: Avatar whose head model is the built-in one.

    Returns:
        Parameters of ``DRIVING_FRAMES`` frames in VHAP's keys, with ``fps`` and ``expr_basis``.
    """
    t = np.linspace(0.0, 2.0 * np.pi, DRIVING_FRAMES, endpoint=False)
    names = avatar.head_model.expr_names
    expr = np.zeros((DRIVING_FRAMES, avatar.head_model.n_expr), np.float32)

    def move(name: str, values: np.ndarray) -> None:
        for side in (f"{name}_L", f"{name}_R"):
            expr[:, names.index(side)] = values

    first_half, second_half = np.clip(np.sin(t), 0.0, 1.0), np.clip(-np.sin(t), 0.0, 1.0)
    move("smile", first_half)
    move("cheek_raise", 0.5 * first_half)
    move("brow_outer_up", 0.4 * second_half)
    move("squint", np.full_like(t, 0.35))
    move("blink", np.clip(24.0 * np.cos(t + 0.4) - 23.0, 0.0, 1.0))
    zero = np.zeros_like(t)
    speech = 0.06 * (1.0 - np.cos(5.0 * t)) * (0.6 + 0.4 * np.cos(t))
    turn = np.stack([0.10 * np.sin(2.0 * t), 0.30 * np.sin(t), 0.06 * np.sin(t + 1.0)], 1)
    gaze = np.stack([0.05 * np.sin(3.0 * t), 0.20 * np.sin(2.0 * t + 0.5), zero], 1)
    return {
        "expr": expr,
        "rotation": np.zeros((DRIVING_FRAMES, 3), np.float32),
        "neck_pose": turn.astype(np.float32),
        "jaw_pose": np.stack([speech, zero, zero], 1).astype(np.float32),
        "eyes_pose": np.concatenate([gaze, gaze], 1).astype(np.float32),
        "translation": np.zeros((DRIVING_FRAMES, 3), np.float32),
        "fps": np.array(FPS, np.float32),
        "expr_basis": np.array(avatar.head_model.expr_basis),
    }
