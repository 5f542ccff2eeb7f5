"""Scores of a fitted surface where the true one is known: distances, normals, folds, at each point of the fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.capture.subject import Subject
from mgavatar.head.params import Pose, pad_or_truncate
from mgavatar.kernels.closest_point import closest_points
from mgavatar.kernels.self_intersection import crossing_faces
from mgavatar.scoring.truth import Truth

STEPS = ("start", "beta", "identity_offsets", "pose_offsets")
"""Points of the construction (Section 3.1): as tracked; with the fitted identity and poses; with ``delta mu_id``; with
``delta mu_pose``, which is the fitted surface."""

REACH = 100.0
"""Vertices of the truth that are further from the surface than this are not scored [m]."""


@torch.no_grad()
def score_geometry(avatar: Avatar, subject: Subject, poses: Mapping[int, Pose]) -> dict[str, Any] | None:
    """Compare the fitted surface with the true one.

    Distances run from the truth's vertices that at least three training images see, where the truth says so, to the
    fitted surface. What counts is ``mask_face``, all of them where the truth has no such mask.

    Args:
        avatar: The avatar.
        subject: The capture; ``ground_truth`` has ``vertices`` [T, V, 3] by the capture's own timestep numbers,
            ``faces``, and optionally ``mask_*`` and ``seen``.
        poses: Poses to compare in, by row of the capture's parameters.

    Returns:
        ``mean_mm``, ``median_mm``, ``p95_mm`` of the distances and ``normal_deg``, the mean angle between normals;
        ``flipped_faces``, how many faces of the fitted neutral head look against their direction in the parametric one;
        ``self_intersections``, pairs of its faces that cross, those of the parametric head, and those that are new;
        ``regions``, the distances and angles of every mask, of ``face+scalp`` and of ``all``; ``steps``, the same at
        each of :data:`STEPS`, see :func:`step_meshes`, where the pose offsets' folds are those of the worst pose.
        None without truth, and None for whatever has nothing to score.

    Raises:
        DataError: If the file of the truth is damaged or does not fit the capture.
    """
    if subject.ground_truth is None:
        return None
    truth = Truth.read(subject.ground_truth, subject)
    faces = avatar.head.body.faces
    distances: dict[str, list[np.ndarray]] = {name: [] for name in STEPS}
    angles: dict[str, list[np.ndarray]] = {name: [] for name in STEPS}
    neutral: dict[str, list[Tensor]] = {}
    for timestep, pose in poses.items():
        points = torch.tensor(truth.vertices[subject.timestep_ids[timestep]])
        steps = step_meshes(avatar, subject, timestep, pose)
        for name, verts in steps.posed.items():
            distance, angle = _compare(verts, faces, points, truth.faces)
            distances[name].append(distance)
            angles[name].append(angle)
        for name, verts in steps.neutral.items():
            if not (known := neutral.setdefault(name, [])) or not torch.equal(known[-1], verts):
                known.append(verts)
    parametric = {name: neutral["start" if name == "start" else "beta"][0] for name in STEPS}
    folds = {name: _folds(neutral[name], parametric[name], faces) for name in STEPS}
    scores = {
        name: {**_scores(1e3 * np.stack(distances[name]), np.degrees(np.stack(angles[name])), truth), **folds[name]}
        for name in STEPS
    }
    return {**scores["pose_offsets"], **folds["identity_offsets"], "steps": scores}


@dataclass(frozen=True, eq=False)
class StepMeshes:
    """The mesh at each of :data:`STEPS`, in a pose and before expression and pose; [V, 3], metres."""

    posed: dict[str, Tensor]
    neutral: dict[str, Tensor]


@torch.no_grad()
def step_meshes(avatar: Avatar, subject: Subject, timestep: int, pose: Pose) -> StepMeshes:
    """What the parts of a fitted head make of it, one after the other.

    Args:
        avatar: The avatar, whose parts are switched off; the fit learned them together.
        subject: The capture that lends the tracked parameters of the first step.
        timestep: Row of the capture's parameters.
        pose: The pose of the other steps.
    """
    head, body = avatar.head, avatar.head.body
    pose = pose.to(avatar.device)
    start, tracked = tracked_shape(avatar), subject.params.pose(timestep, n_expr=avatar.head_model.n_expr)
    final = head.posed(pose)
    canonical = final.shaped + final.identity_offsets
    return StepMeshes(
        posed={
            "start": body.posed(start, tracked.to(avatar.device), joints=head.joints(start)),
            "beta": body.posed(final.shaped, pose, joints=head.joints(final.shaped)),
            "identity_offsets": body.posed(canonical, pose, joints=head.joints(canonical)),
            "pose_offsets": final.verts,
        },
        neutral={
            "start": start,
            "beta": final.shaped,
            "identity_offsets": canonical,
            "pose_offsets": canonical + final.pose_offsets,
        },
    )


@torch.no_grad()
def tracked_shape(avatar: Avatar) -> Tensor:
    """The neutral head that the fit began with [m], shape [V, 3]."""
    head = avatar.head
    betas = torch.zeros_like(head.betas)
    if avatar.config.geometry.start_from_tracked_shape:
        betas += torch.from_numpy(pad_or_truncate(avatar.capture.tracked.shape, len(betas))).to(betas)
    return head.body.shaped(betas)


def _scores(distance_mm: np.ndarray, angle_deg: np.ndarray, truth: Truth) -> dict[str, Any]:
    """Scores of what counts and of every region; values have shape [T, V]."""

    def scores(region: np.ndarray) -> dict[str, float | None]:
        distances, angles = distance_mm[:, region], angle_deg[:, region]
        return {
            "mean_mm": _of_finite(np.mean, distances),
            "median_mm": _of_finite(np.median, distances),
            "p95_mm": _of_finite(lambda values: np.percentile(values, 95), distances),
            "normal_deg": _of_finite(np.mean, angles),
        }

    return {**scores(truth.scored), "regions": {name: scores(region) for name, region in truth.regions.items()}}


def _of_finite(statistic: Any, values: np.ndarray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(statistic(finite)) if finite.size else None


def _folds(meshes: list[Tensor], parametric: Tensor, faces: Tensor) -> dict[str, Any]:
    """Faces that are turned over and pairs that cross; of several meshes, one a pose, the largest numbers."""
    before = _pair_codes(parametric, faces)
    pairs = [_pair_codes(verts, faces) for verts in meshes]
    return {
        "flipped_faces": max(_flipped_faces(verts, parametric, faces) for verts in meshes),
        "self_intersections": {
            "fitted": max(len(codes) for codes in pairs),
            "parametric": len(before),
            "added": max(int((~torch.isin(codes, before)).sum()) for codes in pairs),
        },
    }


def _pair_codes(verts: Tensor, faces: Tensor) -> Tensor:
    """One number for each pair of crossing faces."""
    pairs = crossing_faces(verts, faces)
    return pairs[:, 0] * len(faces) + pairs[:, 1]


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
