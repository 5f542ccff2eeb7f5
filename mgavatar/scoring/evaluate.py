"""Scores of an avatar on a capture: images that the fit has not seen, and geometry where the truth is known."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from mgavatar.avatar import Avatar
from mgavatar.capture.images import read_images
from mgavatar.capture.subject import Frame, Split, Subject
from mgavatar.errors import DataError
from mgavatar.files import write_json
from mgavatar.head.params import HeadParams, Pose
from mgavatar.scoring.baselines import NaiveBaselines
from mgavatar.scoring.geometry import REACH, score_geometry
from mgavatar.scoring.image_metrics import image_metrics
from mgavatar.scoring.lpips import NO_WEIGHTS, Lpips, load_lpips
from mgavatar.scoring.truth import Truth, read_ground_truth

T = TypeVar("T")
Progress = Callable[[int, int], None]

TASKS: dict[Split, str] = {"train": "training-views", "val": "novel-view", "test": "self-reenactment"}
GEOMETRY_TIMESTEPS = 12
NO_TRUTH = "the capture has no ground truth"

log = logging.getLogger("mgavatar")


def evaluate(
    avatar: Avatar,
    subject: Subject,
    *,
    splits: Sequence[Split] = ("val", "test"),
    avatar_path: Path | None = None,
    lpips_weights: Path | None = None,
    max_frames: int | None = None,
    bad_truth: Literal["refuse", "warn"] = "refuse",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Score an avatar on a capture; the result is ``metrics.json``.

    Images are compared at full size, clamped to 0..1, with the 8-bit files; scores are averaged over images. Poses
    are those of :func:`evaluation_pose`.

    Args:
        avatar: The avatar.
        subject: The capture; images of ``val`` and ``test`` that are in ``train`` too are left out with a warning.
        splits: Splits to score.
        avatar_path: File of the avatar, for the record.
        lpips_weights: The state dict of ``lpips.LPIPS(net="vgg")``, or None.
        max_frames: Score at most so many images per split, spread over it; ``sampled_from`` then states their number.
        bad_truth: Refuse ground truth that cannot be scored, or warn and leave the geometry out.
        progress: Called with the number of images scored and their total.

    Returns:
        ``avatar``, ``data``, ``device``; ``splits`` with ``psnr`` [dB], ``ssim``, ``lpips`` and, under ``naive``, the
        PSNR [dB] of baselines that know nothing of heads; ``geometry``, or None with a ``geometry_reason``;
        ``seconds_per_frame``, the median time from pose to image. Splits without images are left out, and so are
        baselines that lack the images that they need.

    Raises:
        DataError: If no split has images that training has not seen, or a file is missing or damaged.
    """
    truth, geometry_reason = _read_truth(subject, bad_truth)
    held_out = {split: _held_out(subject, split) for split in splits if subject.frames[split]}
    _warn_of_training_images(subject, held_out)
    frames = {split: spread(own, max_frames) for split, own in held_out.items() if own}
    total = sum(len(chosen) for chosen in frames.values())
    if not held_out:
        raise DataError(f"{subject.root}: no images in {', '.join(splits)}; choose another split")
    if not total:
        raise DataError(f"{subject.root}: every image in {', '.join(splits)} is a training image; hold some out")
    lpips = None if lpips_weights is None else load_lpips(lpips_weights, device=avatar.device)
    _warn_of_cut_expression(avatar, subject)
    scorer = _Scorer(avatar, subject, lpips)
    results: dict[str, dict[str, Any]] = {}
    done = 0
    for split, chosen in frames.items():
        scores = []
        for frame in chosen:
            scores.append(scorer.score(frame))
            done += 1
            if progress is not None:
                progress(done, total)
        results[split] = _summary(split, chosen, scores, has_lpips=lpips is not None)
        if len(chosen) < len(held_out[split]):
            results[split]["sampled_from"] = len(held_out[split])
    geometry = None
    if truth is not None:
        geometry, geometry_reason = _score_truth(avatar, subject, truth)
    return {
        "avatar": str(avatar_path) if avatar_path is not None else None,
        "data": str(subject.root),
        "device": str(avatar.device),
        "splits": results,
        "geometry": geometry,
        "geometry_reason": geometry_reason,
        "seconds_per_frame": float(np.median(scorer.seconds)),
    }


def evaluate_sample(
    avatar: Avatar, subject: Subject, *, avatar_path: Path | None, max_frames: int | None = 24
) -> dict[str, Any]:
    """Score a fit that has just ended on some held-out images, or on training images if none are held out.

    Ground truth that cannot be scored costs the score of the geometry and a warning, not the whole score.
    """
    held_out: tuple[Split, ...] = tuple(split for split in ("val", "test") if _held_out(subject, split))
    return evaluate(
        avatar,
        subject,
        avatar_path=avatar_path,
        splits=held_out or ("train",),
        max_frames=max_frames,
        bad_truth="warn",
    )


def _read_truth(subject: Subject, bad_truth: Literal["refuse", "warn"]) -> tuple[Truth | None, str | None]:
    """Return the ground truth, or None and the reason for it."""
    try:
        truth = read_ground_truth(subject)
    except DataError as error:
        if bad_truth == "refuse":
            raise
        log.warning("geometry is not scored: %s", error)
        return None, str(error)
    return truth, NO_TRUTH if truth is None else None


def _score_truth(avatar: Avatar, subject: Subject, truth: Truth) -> tuple[dict[str, Any] | None, str | None]:
    """Return the scores of the geometry, or None and the reason for it."""
    scores = score_geometry(avatar, subject, truth, _geometry_poses(avatar, subject))
    if scores["mean_mm"] is not None:
        return scores, None
    reason = f"{subject.ground_truth}: no scored vertex lies within {REACH:.0f} m of the fitted surface"
    log.warning("geometry is not scored: %s", reason)
    return None, reason


def write_metrics(path: Path, metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``, whole or not at all.

    Raises:
        DataError: If the file cannot be written.
    """
    write_json(path, metrics)


def spread(items: Sequence[T], count: int | None) -> tuple[T, ...]:
    """Pick at most ``count`` items, evenly spaced from the first to the last; all of them if None."""
    if count is None or len(items) <= count:
        return tuple(items)
    return tuple(items[index] for index in np.linspace(0, len(items) - 1, count).round().astype(int))


def _held_out(subject: Subject, split: Split) -> tuple[Frame, ...]:
    """Return the images of a split that are no training images; all images of the training split itself."""
    frames = subject.frames[split]
    if split == "train":
        return frames
    places = {(frame.camera_id, frame.timestep) for frame in subject.frames["train"]}
    files = {frame.image_path.resolve() for frame in subject.frames["train"]}
    return tuple(
        frame
        for frame in frames
        if (frame.camera_id, frame.timestep) not in places and frame.image_path.resolve() not in files
    )


def _warn_of_training_images(subject: Subject, held_out: dict[Split, tuple[Frame, ...]]) -> None:
    for split, kept in held_out.items():
        if known := len(subject.frames[split]) - len(kept):
            log.warning("%s: %d images of %s are training images and not scored", subject.root, known, split)


def is_own_capture(avatar: Avatar, subject: Subject) -> bool:
    """Return True if the avatar was fitted to this capture: the same timesteps with the same parameters."""
    own = avatar.capture
    if own.timestep_ids != subject.timestep_ids:
        return False
    for entry in fields(HeadParams):
        a, b = getattr(own.tracked, entry.name), getattr(subject.params, entry.name)
        if (a is None) != (b is None) or (a is not None and not np.array_equal(a, b)):
            return False
    return True


def evaluation_pose(avatar: Avatar, subject: Subject, timestep: int) -> Pose:
    """Return the pose to score a timestep with: as refined where the fit has seen it, else as tracked."""
    if timestep in avatar.capture.train_timesteps and is_own_capture(avatar, subject):
        return avatar.head.pose(timestep)
    return subject.params.pose(timestep, n_expr=avatar.head_model.n_expr)


def _geometry_poses(avatar: Avatar, subject: Subject) -> dict[int, Pose]:
    """Return the poses of up to twelve training timesteps, spread over the capture, as images are scored with them."""
    timesteps = sorted({frame.timestep for frame in subject.frames["train"]})
    return {t: evaluation_pose(avatar, subject, t) for t in spread(timesteps, GEOMETRY_TIMESTEPS)}


def _warn_of_cut_expression(avatar: Avatar, subject: Subject) -> None:
    n_expr = avatar.head_model.n_expr
    dropped = subject.params.expr[:, n_expr:]
    if dropped.any():
        log.warning(
            "%s: expression columns from %d on are not used, because the avatar's head has no more; they reach %.3g",
            subject.root,
            n_expr,
            np.abs(dropped).max(),
        )


class _Scorer:
    """Scores of single frames, and the times that drawing them took."""

    def __init__(self, avatar: Avatar, subject: Subject, lpips: Lpips | None) -> None:
        self.avatar, self.subject, self.lpips = avatar, subject, lpips
        self.naive = NaiveBaselines(subject)
        self.seconds: list[float] = []

    def score(self, frame: Frame) -> dict[str, float | None]:
        pose = evaluation_pose(self.avatar, self.subject, frame.timestep)
        start = time.perf_counter()
        image = self.avatar.render(pose, frame.camera).image.clamp(0.0, 1.0)
        image.cpu()  # waits for the device
        self.seconds.append(time.perf_counter() - start)
        target = read_images([frame], threads=1)[0].float() / 255.0
        return {**image_metrics(image, target.to(image.device), self.lpips), **self.naive.scores(frame, target)}


def _summary(
    split: Split, frames: Sequence[Frame], scores: list[dict[str, float | None]], *, has_lpips: bool
) -> dict[str, Any]:
    naive = {name: _mean(scores, name) for name in ("white", "mean_image", "nearest_frame")}
    return {
        "task": TASKS[split],
        "frames": len(frames),
        "cameras": len({frame.camera_id for frame in frames}),
        "timesteps": len({frame.timestep for frame in frames}),
        "psnr": _mean(scores, "psnr"),
        "ssim": _mean(scores, "ssim"),
        "lpips": _mean(scores, "lpips"),
        "lpips_reason": None if has_lpips else NO_WEIGHTS,
        "naive": {name: value for name, value in naive.items() if value is not None},
    }


def _mean(scores: list[dict[str, float | None]], name: str) -> float | None:
    """Return the mean over the images that have this score, or None."""
    values = [value for score in scores if (value := score[name]) is not None]
    return float(np.mean(values)) if values else None
