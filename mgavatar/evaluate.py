"""Scores of an avatar on a capture: images it has not seen, and geometry where the truth is known."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.capture.images import read_images
from mgavatar.capture.subject import Frame, HeadParams, Split, Subject
from mgavatar.errors import DataError
from mgavatar.files import atomic_write, float_array, read_npz
from mgavatar.head.body import Pose, pose_of
from mgavatar.kernels.closest_point import closest_points
from mgavatar.losses import ssim
from mgavatar.lpips import NO_WEIGHTS, Lpips, load_lpips
from mgavatar.trivial import TrivialPredictors, psnr

T = TypeVar("T")
Progress = Callable[[int, int], None]

TASKS: dict[Split, str] = {"train": "training-views", "val": "novel-view", "test": "self-reenactment"}
GEOMETRY_TIMESTEPS = 12
REACH = 100.0
"""Vertices of the truth that are further from the surface than this are not scored [m]."""

log = logging.getLogger("mgavatar")


def evaluate(
    avatar: Avatar,
    subject: Subject,
    *,
    avatar_path: Path,
    splits: Sequence[Split],
    lpips_weights: Path | None = None,
    max_frames: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Score an avatar on a capture; the result is ``metrics.json``.

    Images are compared at full size, clamped to 0..1, with the 8-bit files; scores are averaged over images. Poses
    are those of :func:`evaluation_pose`.

    Args:
        avatar: The avatar.
        subject: The capture.
        avatar_path: Where the avatar comes from, for the record.
        splits: What to score.
        lpips_weights: The state dict of ``lpips.LPIPS(net="vgg")``, or None.
        max_frames: Score at most so many images of each split, spread over it; ``sampled_from`` then says of how many.
        progress: Called with the number of images scored and their total.

    Returns:
        ``avatar``, ``data``, ``device``; ``splits`` with ``psnr`` [dB], ``ssim``, ``lpips`` and, under ``trivial``, the
        PSNR [dB] of predictors that know nothing of heads; ``geometry`` or None; ``seconds_per_frame``, the median
        time from pose to image. Splits without images are left out, and so are trivial predictors that have nothing to
        predict with.

    Raises:
        DataError: If no split has images, or a file is missing or damaged.
    """
    frames = {split: spread(subject.frames[split], max_frames) for split in splits if subject.frames[split]}
    total = sum(len(chosen) for chosen in frames.values())
    if not total:
        raise DataError(f"{subject.root}: no images in {', '.join(splits)}; choose another split")
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
        if len(chosen) < len(subject.frames[split]):
            results[split]["sampled_from"] = len(subject.frames[split])
    return {
        "avatar": str(avatar_path),
        "data": str(subject.root),
        "device": str(avatar.device),
        "splits": results,
        "geometry": score_geometry(avatar, subject),
        "seconds_per_frame": float(np.median(scorer.seconds)),
    }


def evaluate_sample(avatar: Avatar, subject: Subject, *, avatar_path: Path, max_frames: int = 24) -> dict[str, Any]:
    """A quick score after a fit: some of the held-out images, or of the training images if none are held out."""
    held_out: tuple[Split, ...] = tuple(split for split in ("val", "test") if subject.frames[split])
    return evaluate(avatar, subject, avatar_path=avatar_path, splits=held_out or ("train",), max_frames=max_frames)


def write_metrics(path: Path, metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``; atomic."""
    with atomic_write(path) as file:
        file.write((json.dumps(metrics, indent=2) + "\n").encode())


def spread(items: Sequence[T], count: int | None) -> tuple[T, ...]:
    """At most ``count`` items, evenly spaced from the first to the last; all of them if None."""
    if count is None or len(items) <= count:
        return tuple(items)
    return tuple(items[index] for index in np.linspace(0, len(items) - 1, count).round().astype(int))


def is_own_capture(avatar: Avatar, subject: Subject) -> bool:
    """Whether a capture is the one that the avatar was fitted to: the same timesteps with the same parameters."""
    own = avatar.capture
    if own.timestep_ids != subject.timestep_ids:
        return False
    for entry in fields(HeadParams):
        a, b = getattr(own.tracked, entry.name), getattr(subject.params, entry.name)
        if (a is None) != (b is None) or (a is not None and not np.array_equal(a, b)):
            return False
    return True


def evaluation_pose(avatar: Avatar, subject: Subject, timestep: int) -> Pose:
    """The pose to score a timestep with: as refined where the fit has seen it, else as tracked."""
    if timestep in avatar.capture.train_timesteps and is_own_capture(avatar, subject):
        return avatar.head.pose(timestep)
    return pose_of(subject.params, timestep, avatar.head_model.n_expr)


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
    """Scores one frame after the other and keeps the times."""

    def __init__(self, avatar: Avatar, subject: Subject, lpips: Lpips | None) -> None:
        self.avatar, self.subject, self.lpips = avatar, subject, lpips
        self.trivial = TrivialPredictors(subject)
        self.seconds: list[float] = []

    def score(self, frame: Frame) -> dict[str, float | None]:
        pose = evaluation_pose(self.avatar, self.subject, frame.timestep)
        start = time.perf_counter()
        image = self.avatar.render(pose, frame.camera).image.clamp(0.0, 1.0)
        on_cpu = image.cpu()  # waits for the device
        self.seconds.append(time.perf_counter() - start)
        target = read_images([frame], threads=1)[0].float() / 255.0
        on_device = target.to(image.device)
        return {
            "psnr": psnr(on_cpu, target),
            "ssim": float(ssim(image, on_device)),
            "lpips": None if self.lpips is None else float(self.lpips(image, on_device)),
            **self.trivial.scores(frame, target),
        }


def _summary(
    split: Split, frames: Sequence[Frame], scores: list[dict[str, float | None]], *, has_lpips: bool
) -> dict[str, Any]:
    trivial = {name: _mean(scores, name) for name in ("white", "mean_image", "nearest_frame")}
    return {
        "task": TASKS[split],
        "frames": len(frames),
        "cameras": len({frame.camera_id for frame in frames}),
        "timesteps": len({frame.timestep for frame in frames}),
        "psnr": _mean(scores, "psnr"),
        "ssim": _mean(scores, "ssim"),
        "lpips": _mean(scores, "lpips"),
        "lpips_reason": None if has_lpips else NO_WEIGHTS,
        "trivial": {name: value for name, value in trivial.items() if value is not None},
    }


def _mean(scores: list[dict[str, float | None]], name: str) -> float | None:
    """Mean over the images that have this score."""
    values = [value for score in scores if (value := score[name]) is not None]
    return float(np.mean(values)) if values else None


@torch.no_grad()
def score_geometry(avatar: Avatar, subject: Subject) -> dict[str, Any] | None:
    """Compare the fitted surface with the true one.

    Distances run from the truth's vertices, ``mask_face`` of those that at least three training images see where the
    truth says so, to the fitted surface, at up to twelve training timesteps.

    Args:
        avatar: The avatar.
        subject: The capture; ``ground_truth`` has ``vertices`` [T, V, 3] by the capture's own timestep numbers,
            ``faces``, and optionally ``mask_*`` and ``seen``.

    Returns:
        ``mean_mm``, ``median_mm`` and ``p95_mm`` of the distances; ``normal_deg``, the mean angle between normals;
        ``flipped_faces``, how many faces of the fitted head look against their direction in the parametric one;
        ``regions``, the mean distance [mm] of every mask, None where nothing of it is seen. None without truth.

    Raises:
        DataError: If the file of the truth is damaged or does not fit the capture.
    """
    if subject.ground_truth is None:
        return None
    truth = Truth.read(subject.ground_truth, subject)
    head = avatar.head
    faces = head.body.faces
    timesteps = sorted({frame.timestep for frame in subject.frames["train"]})
    distances, angles = [], []
    for timestep in spread(timesteps, GEOMETRY_TIMESTEPS):
        verts = avatar.verts(evaluation_pose(avatar, subject, timestep))
        points = torch.tensor(truth.vertices[subject.timestep_ids[timestep]])
        distance, angle = _compare(verts, faces, points, truth.faces)
        distances.append(distance)
        angles.append(angle)
    distance_mm, angle_deg = 1e3 * np.stack(distances), np.degrees(np.stack(angles))
    chosen = distance_mm[:, truth.scored]
    return {
        "mean_mm": _finite_mean(chosen),
        "median_mm": float(np.nanmedian(chosen)),
        "p95_mm": float(np.nanpercentile(chosen, 95)),
        "normal_deg": _finite_mean(angle_deg[:, truth.scored]),
        "flipped_faces": _flipped_faces(head.canonical(), head.body.shaped(head.betas), faces),
        "regions": {name: _finite_mean(distance_mm[:, region]) for name, region in truth.regions.items()},
    }


def _finite_mean(values: np.ndarray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else None


class Truth:
    """``ground_truth/*.npz``, checked."""

    def __init__(self, vertices: np.ndarray, faces: Tensor, seen: np.ndarray, masks: dict[str, np.ndarray]) -> None:
        self.vertices, self.faces = vertices, faces
        self.regions = {name: mask & seen for name, mask in masks.items()}
        self.scored = self.regions.get("face", seen)

    @staticmethod
    def read(path: Path, subject: Subject) -> Truth:
        arrays = read_npz(
            path, wanted=lambda key: key in ("vertices", "faces", "seen") or key.startswith("mask_")
        ).arrays
        if not {"vertices", "faces"} <= set(arrays):
            raise DataError(f"{path}: needs vertices (T, V, 3) and faces (F, 3)")
        vertices, faces = float_array(arrays["vertices"], where=f"{path}: vertices"), arrays["faces"]
        if vertices.ndim != 3 or vertices.shape[2] != 3 or len(vertices) <= max(subject.timestep_ids):
            raise DataError(
                f"{path}: vertices has shape {vertices.shape}; a row of (V, 3) is needed for each timestep up to "
                f"{max(subject.timestep_ids)}"
            )
        n_verts = vertices.shape[1]
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu" or not _within(faces, n_verts):
            raise DataError(f"{path}: faces must be (F, 3) indices of its {n_verts} vertices")
        for name, values in arrays.items():
            if name not in ("vertices", "faces") and (values.shape != (n_verts,) or values.dtype.kind not in "biuf"):
                raise DataError(f"{path}: {name} has shape {values.shape}, one value for each of {n_verts} is needed")
        seen = arrays["seen"] >= 3 if "seen" in arrays else np.ones(n_verts, bool)
        masks = {
            name.removeprefix("mask_"): arrays[name].astype(bool) for name in sorted(arrays) if name[:5] == "mask_"
        }
        truth = Truth(vertices, torch.tensor(faces.astype(np.int64)), seen, masks)
        if not truth.scored.any():
            raise DataError(f"{path}: mask_face and seen leave no vertex to score")
        return truth


def _within(faces: np.ndarray, n_verts: int) -> bool:
    return faces.size > 0 and 0 <= int(faces.min()) <= int(faces.max()) < n_verts


def _compare(verts: Tensor, faces: Tensor, points: Tensor, point_faces: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Distances [m] from points to a mesh and angles [rad] between the normals there; NaN where there is none."""
    truth_normals = vertex_normals(points, point_faces).to(verts.device)
    points = points.to(verts.device)
    closest, face_ids = closest_points(verts, faces, points, reach=REACH)
    found = face_ids >= 0
    distance = (closest - points).norm(dim=1).where(found, torch.nan)
    normals = face_normals(verts, faces)[face_ids.clamp(min=0).long()]
    known = found & (normals.norm(dim=1) > 0.5) & (truth_normals.norm(dim=1) > 0.5)
    angle = torch.acos((normals * truth_normals).sum(1).clamp(-1.0, 1.0)).where(known, torch.nan)
    return distance.cpu().numpy(), angle.cpu().numpy()


def face_normals(verts: Tensor, faces: Tensor) -> Tensor:
    """Unit normals of faces, shape [F, 3]; zero where a face has no area."""
    a, b, c = verts[faces.long()].unbind(1)
    return torch.nn.functional.normalize(torch.cross(b - a, c - a, dim=1), dim=1, eps=1e-30)


def vertex_normals(verts: Tensor, faces: Tensor) -> Tensor:
    """Unit normals of vertices, areas as weights, shape [V, 3]; zero where a vertex has no face."""
    a, b, c = verts[faces].unbind(1)
    doubled = torch.cross(b - a, c - a, dim=1)
    total = torch.zeros_like(verts)
    for corner in range(3):
        total.index_add_(0, faces[:, corner], doubled)
    return torch.nn.functional.normalize(total, dim=1, eps=1e-30)


def _flipped_faces(verts: Tensor, reference: Tensor, faces: Tensor) -> int:
    return int(((face_normals(verts, faces) * face_normals(reference, faces)).sum(1) < 0).sum())
