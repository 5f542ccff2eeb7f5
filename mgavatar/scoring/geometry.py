"""Scores of a fitted surface where the true one is known: distances, normals and folds, for each part of the fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.capture.subject import Subject
from mgavatar.head.params import Pose, pad_or_truncate
from mgavatar.kernels.closest_point import closest_points
from mgavatar.kernels.mesh_geometry import face_normals, vertex_normals
from mgavatar.kernels.self_intersection import crossing_faces
from mgavatar.scoring.truth import Truth

STEPS = ("start", "beta", "identity_offsets", "pose_offsets")
"""Points of the construction (Section 3.1): as tracked; with the fitted identity and poses; with ``delta mu_id``; with
``delta mu_pose``, which is the fitted surface."""

REACH = 100.0
"""Vertices of the truth that are further from the surface than this are not scored [m]."""


@torch.no_grad()
def score_geometry(avatar: Avatar, subject: Subject, truth: Truth, poses: Mapping[int, Pose]) -> dict[str, Any]:
    """Compare the fitted surface with the true one.

    Distances run from the vertices of the truth to the fitted surface, in every pose. Vertices that fewer than three
    training images see are left out where the truth says how many do. The scored region is ``mask_face``, or the whole
    surface where there is no such mask.

    Args:
        avatar: The avatar.
        subject: The capture that the truth belongs to.
        truth: The true surface, by the capture's own timestep numbers.
        poses: Poses to compare in, by row of the capture's parameters.

    Returns:
        ``mean_mm``, ``median_mm``, ``p95_mm`` of the distances and ``normal_deg``, the mean angle between normals;
        ``flipped_faces``, the number of faces of the fitted neutral head that look against their direction in the
        parametric one; ``self_intersections``, the number of pairs of faces that cross in the fitted neutral head, in
        the parametric one, and in the first but not in the second; ``regions``, the distances and angles of every mask,
        of ``face+scalp`` and of ``all``; ``steps``, the same keys at each of :data:`STEPS` (see :func:`step_meshes`),
        where the folds of the pose offsets are those of the worst pose. A score is None where it has no vertex.
    """
    faces = avatar.head.body.faces
    distances: dict[str, list[np.ndarray]] = {name: [] for name in STEPS}
    angles: dict[str, list[np.ndarray]] = {name: [] for name in STEPS}
    neutral: dict[str, list[Tensor]] = {name: [] for name in STEPS}
    for timestep, pose in poses.items():
        # The truth has a row for every timestep of the recording, the parameters only for those of the capture.
        points = torch.tensor(truth.vertices[subject.timestep_ids[timestep]])
        meshes = step_meshes(avatar, subject, timestep, pose)
        for name in STEPS:
            distance, angle = _compare(meshes.posed[name], faces, points, truth.faces)
            distances[name].append(distance)
            angles[name].append(angle)
            # Only the pose offsets change a neutral mesh from pose to pose. Equal meshes are kept once, because the
            # search for crossing faces takes longer than everything else here.
            kept = neutral[name]
            if not kept or not torch.equal(kept[-1], meshes.neutral[name]):
                kept.append(meshes.neutral[name])
    folds = {}
    scores = {}
    for name in STEPS:
        # A fold counts against the parametric head with the same identity: the tracked one before the fit, else the
        # fitted one. So a fold that the head model has by itself is not blamed on the offsets.
        parametric = neutral["start" if name == "start" else "beta"][0]
        folds[name] = _folds(neutral[name], parametric, faces)
        distance_mm, angle_deg = 1e3 * np.stack(distances[name]), np.degrees(np.stack(angles[name]))
        scores[name] = {**_scores(distance_mm, angle_deg, truth), **folds[name]}
    # Distances of the whole fit, but folds of the neutral head: those of the pose offsets differ from pose to pose.
    return {**scores["pose_offsets"], **folds["identity_offsets"], "steps": scores}


@dataclass(frozen=True, eq=False)
class StepMeshes:
    """The mesh at each of :data:`STEPS`, in a pose and before expression and pose; [V, 3], metres."""

    posed: dict[str, Tensor]
    neutral: dict[str, Tensor]


@torch.no_grad()
def step_meshes(avatar: Avatar, subject: Subject, timestep: int, pose: Pose) -> StepMeshes:
    """Build the fitted head part by part.

    The fit learns its parts together, so these are not stages of the fit but the fitted head with parts switched off.

    Args:
        avatar: The avatar.
        subject: The capture, whose tracked parameters the first step shows.
        timestep: Row of the capture's parameters.
        pose: The pose of the other steps.
    """
    head, body = avatar.head, avatar.head.body
    pose = pose.to(avatar.device)
    tracked_pose = subject.params.pose(timestep, n_expr=avatar.head_model.n_expr).to(avatar.device)
    start = tracked_shape(avatar)
    final = head.posed(pose)
    canonical = final.shaped + final.identity_offsets
    return StepMeshes(
        posed={
            "start": body.posed(start, tracked_pose, joints=head.joints(start)),
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
    """Return the neutral head that the fit began with [m], shape [V, 3]."""
    head = avatar.head
    betas = torch.zeros_like(head.betas)
    if avatar.config.geometry.start_from_tracked_shape:
        betas += torch.from_numpy(pad_or_truncate(avatar.capture.tracked.shape, len(betas))).to(betas)
    return head.body.shaped(betas)


def _scores(distance_mm: np.ndarray, angle_deg: np.ndarray, truth: Truth) -> dict[str, Any]:
    """Summarise distances and angles, each of shape [T, V], over the scored region and over every region."""

    def scores(region: np.ndarray) -> dict[str, float | None]:
        distances, angles = distance_mm[:, region], angle_deg[:, region]
        return {
            "mean_mm": _statistic(np.mean, distances),
            "median_mm": _statistic(np.median, distances),
            "p95_mm": _statistic(lambda values: np.percentile(values, 95), distances),
            "normal_deg": _statistic(np.mean, angles),
        }

    regions = {name: scores(region) for name, region in truth.regions.items()}
    return {**scores(truth.scored), "regions": regions}


def _statistic(statistic: Callable[[np.ndarray], Any], values: np.ndarray) -> float | None:
    """Return a statistic of the values that are not NaN, or None if there are none."""
    known = values[np.isfinite(values)]
    return float(statistic(known)) if known.size else None


def _folds(meshes: list[Tensor], parametric: Tensor, faces: Tensor) -> dict[str, Any]:
    """Count flipped faces and crossing pairs; of several meshes, one per pose, take the largest numbers."""
    before = _pair_codes(parametric, faces)
    pairs = [_pair_codes(verts, faces) for verts in meshes]
    added = [codes[~torch.isin(codes, before)] for codes in pairs]
    return {
        "flipped_faces": max(_flipped_faces(verts, parametric, faces) for verts in meshes),
        "self_intersections": {
            "fitted": max(len(codes) for codes in pairs),
            "parametric": len(before),
            "added": max(len(codes) for codes in added),
        },
    }


def _pair_codes(verts: Tensor, faces: Tensor) -> Tensor:
    """Return one number per pair of crossing faces, so that pairs of two meshes can be compared as sets."""
    pairs = crossing_faces(verts, faces)
    return pairs[:, 0] * len(faces) + pairs[:, 1]


def _compare(verts: Tensor, faces: Tensor, points: Tensor, point_faces: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return distances [m] from points to a mesh and angles [rad] between the normals there; NaN where unknown."""
    truth_normals = vertex_normals(points, point_faces).to(verts.device)
    points = points.to(verts.device)
    closest, face_ids = closest_points(verts, faces, points, reach=REACH)
    found = face_ids >= 0
    distance = (closest - points).norm(dim=1).where(found, torch.nan)
    normals = face_normals(verts, faces)[face_ids.clamp(min=0).long()]  # of any face where none was found
    # Normals of degenerate faces and of vertices without a face are zero instead of unit vectors.
    known = found & (normals.norm(dim=1) > 0.5) & (truth_normals.norm(dim=1) > 0.5)
    cosine = (normals * truth_normals).sum(1).clamp(-1.0, 1.0)
    angle = torch.acos(cosine).where(known, torch.nan)
    return distance.cpu().numpy(), angle.cpu().numpy()


def _flipped_faces(verts: Tensor, reference: Tensor, faces: Tensor) -> int:
    """Count the faces whose normals point against those of the reference."""
    cosine = (face_normals(verts, faces) * face_normals(reference, faces)).sum(1)
    return int((cosine < 0).sum())
