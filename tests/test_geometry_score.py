"""Scores of a surface whose truth is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from ball_head import ball_head
from tiny_avatar import tiny_avatar
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.capture.subject import Subject
from mgavatar.errors import DataError
from mgavatar.scoring.evaluate import evaluate, evaluate_sample
from mgavatar.scoring.geometry import STEPS, score_geometry
from mgavatar.scoring.truth import check_ground_truth, read_ground_truth

DISTANCES = {"mean_mm", "median_mm", "p95_mm", "normal_deg"}
FOLDS = {"flipped_faces", "self_intersections"}


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Avatar, Subject]:
    return tiny_avatar(tmp_path)


def _score(avatar: Avatar, subject: Subject) -> dict[str, Any]:
    truth = read_ground_truth(subject)
    assert truth is not None
    return score_geometry(avatar, subject, truth, {t: avatar.head.pose(t) for t in range(3)})


def _with_truth(avatar: Avatar, subject: Subject, path: Path, *, out: float = 0.001, **more: np.ndarray) -> Subject:
    """The capture with the avatar's own surface, moved ``out`` along its normals [m], as its truth."""
    verts = []
    for t in range(len(subject.params)):
        posed = avatar.verts(avatar.head.pose(t))
        verts.append((posed + out * avatar.head.body.normals(posed)).numpy())
    np.savez(path, **{"vertices": np.stack(verts), "faces": avatar.head.body.faces.numpy(), **more})
    return replace(subject, ground_truth=path)


def test_geometry_of_a_known_offset(pair: tuple[Avatar, Subject], tmp_path: Path) -> None:
    """A truth one millimetre outside a convex mesh is one millimetre away from it."""
    avatar, subject = pair
    assert read_ground_truth(subject) is None
    score = _score(avatar, _with_truth(avatar, subject, tmp_path / "truth.npz"))
    assert set(score) == {*DISTANCES, *FOLDS, "regions", "steps"}
    for name in ("mean_mm", "median_mm", "p95_mm"):
        assert score[name] == pytest.approx(1.0, abs=1e-3)
    assert 1.0 < score["normal_deg"] < 30.0  # between a ball of 80 faces and its vertices' normals
    assert score["flipped_faces"] == 0
    assert score["self_intersections"] == {"fitted": 0, "parametric": 0, "added": 0}
    assert score["regions"] == {"all": {name: score[name] for name in DISTANCES}}
    inside_out = avatar.head.body.faces.numpy()[:, ::-1]
    turned = _score(avatar, _with_truth(avatar, subject, tmp_path / "turned.npz", faces=inside_out))
    assert turned["normal_deg"] == pytest.approx(180.0 - score["normal_deg"], abs=0.01)


def test_scores_are_those_of_trimesh(pair: tuple[Avatar, Subject], tmp_path: Path) -> None:
    """Distances and angles of a crumpled truth agree with an independent search in double precision."""
    avatar, subject = pair
    faces = avatar.head.body.faces.numpy()
    rng = np.random.default_rng(1)
    fitted = [avatar.verts(avatar.head.pose(t)).numpy() for t in range(len(subject.params))]
    true = [verts + rng.normal(0.0, 0.01, verts.shape).astype(np.float32) for verts in fitted]
    score = _score(avatar, _with_truth(avatar, subject, tmp_path / "truth.npz", vertices=np.stack(true)))
    distances, angles = [], []
    for verts, points in zip(fitted[:3], true[:3], strict=True):
        mesh, surface = (trimesh.Trimesh(values, faces, process=False) for values in (verts, points))
        _, distance, face_ids = trimesh.proximity.closest_point_naive(mesh, points)
        normals = np.zeros_like(points, np.float64)
        np.add.at(normals, faces, surface.face_normals[:, None] * surface.area_faces[:, None, None])
        cosine = (mesh.face_normals[face_ids] * normals).sum(1) / np.linalg.norm(normals, axis=1)
        distances.append(1e3 * distance)
        angles.append(np.degrees(np.arccos(cosine)))
    assert score["mean_mm"] == pytest.approx(np.mean(distances), rel=1e-4)
    assert score["median_mm"] == pytest.approx(np.median(distances), rel=1e-4)
    assert score["p95_mm"] == pytest.approx(np.percentile(distances, 95), rel=1e-4)
    assert score["normal_deg"] == pytest.approx(np.mean(angles), abs=0.5)


def test_regions_that_are_seen(pair: tuple[Avatar, Subject], tmp_path: Path) -> None:
    """The face is what counts, where three images see it; every mask has its own figures, and so have unions."""
    avatar, subject = pair
    n = avatar.head.body.n_verts
    rng = np.random.default_rng(0)
    part, seen = rng.integers(0, 3, n), rng.integers(0, 6, n)
    base = _with_truth(avatar, subject, tmp_path / "base.npz").ground_truth
    assert base is not None
    inner, outer = np.load(base)["vertices"], _posed_out(avatar, subject, 0.004)
    away = np.where((part == 0)[:, None], inner, outer)
    away = np.where((seen >= 3)[:, None], away, 2.0 * away)  # what is not seen counts nowhere
    masks = {"mask_face": part == 0, "mask_scalp": part == 1, "mask_hidden": seen < 3, "seen": seen}
    score = _score(avatar, _with_truth(avatar, subject, tmp_path / "truth.npz", vertices=away, **masks))
    regions = score["regions"]
    assert set(regions) == {"face", "scalp", "hidden", "face+scalp", "all"}
    assert {name: score[name] for name in DISTANCES} == regions["face"]
    assert score["mean_mm"] == pytest.approx(1.0, abs=1e-3)
    assert regions["scalp"]["mean_mm"] == pytest.approx(4.0, abs=1e-3)
    assert regions["hidden"] == dict.fromkeys(DISTANCES)
    counts = np.bincount(part[seen >= 3])
    both, every = (1.0 * counts[0] + 4.0 * more for more in (counts[1], counts[1] + counts[2]))
    assert regions["face+scalp"]["mean_mm"] == pytest.approx(both / (counts[0] + counts[1]), abs=1e-3)
    assert regions["all"]["mean_mm"] == pytest.approx(every / counts.sum(), abs=1e-3)
    assert regions["all"]["p95_mm"] == pytest.approx(4.0, abs=1e-3)


def _posed_out(avatar: Avatar, subject: Subject, out: float) -> np.ndarray:
    verts = [avatar.verts(avatar.head.pose(t)) for t in range(len(subject.params))]
    return np.stack([(v + out * avatar.head.body.normals(v)).numpy() for v in verts])


def test_normals_that_are_not_known_are_null(pair: tuple[Avatar, Subject], tmp_path: Path) -> None:
    """A truth whose faces leave a region without normals has distances there, and no angle."""
    avatar, subject = pair
    faces = avatar.head.body.faces.numpy()
    mask = np.arange(avatar.head.body.n_verts) == 7
    loose = faces[~(faces == 7).any(axis=1)]
    score = _score(avatar, _with_truth(avatar, subject, tmp_path / "t.npz", out=0.0, faces=loose, mask_face=mask))
    assert score["normal_deg"] is None
    assert score["mean_mm"] == pytest.approx(0.0, abs=1e-3)


def _offsets(
    avatar: Avatar,
    monkeypatch: pytest.MonkeyPatch,
    identity: Tensor | None = None,
    by_pose: Callable[[Tensor], Tensor] | None = None,
) -> None:
    """Make RefineNet give these offsets [m]."""
    if identity is not None:
        monkeypatch.setattr(avatar.head.refine, "identity_offsets", lambda features: identity)
    if by_pose is not None:
        monkeypatch.setattr(avatar.head.refine, "pose_offsets", lambda features, pose: by_pose(pose))


def test_steps_switch_the_parts_on_one_after_the_other(
    pair: tuple[Avatar, Subject], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As tracked; then identity and refined poses; then 2 mm from Phi_id and 1 mm from Phi_pose."""
    fresh, subject = pair
    avatar, _ = tiny_avatar(tmp_path / "again")
    avatar.head.betas += 1.0
    avatar.head.poses["translation"] += torch.tensor([0.004, 0.0, 0.0])
    normals = avatar.head.body.normals(avatar.head.shaped())
    _offsets(avatar, monkeypatch, 0.002 * normals, lambda pose: 0.001 * normals)
    known = _with_truth(avatar, subject, tmp_path / "truth.npz", out=0.0)
    score = _score(avatar, known)
    steps = score["steps"]
    assert tuple(steps) == STEPS
    for step in steps.values():
        assert set(step) == {*DISTANCES, *FOLDS, "regions"}
        assert step["regions"]["all"] == {name: step[name] for name in DISTANCES}
    assert steps["pose_offsets"]["mean_mm"] == pytest.approx(0.0, abs=1e-3)
    assert steps["identity_offsets"]["mean_mm"] == pytest.approx(1.0, rel=0.06)
    assert steps["beta"]["mean_mm"] == pytest.approx(3.0, rel=0.06)
    assert {name: score[name] for name in DISTANCES} == {name: steps["pose_offsets"][name] for name in DISTANCES}
    as_tracked = _score(fresh, known)
    assert {name: steps["start"][name] for name in DISTANCES} == {name: as_tracked[name] for name in DISTANCES}
    assert abs(steps["start"]["mean_mm"] - steps["beta"]["mean_mm"]) > 0.1


def test_flipped_faces_are_counted(
    pair: tuple[Avatar, Subject], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fitted head that is the mirror image of its template: faces whose normal is mostly along y and z turn over."""
    avatar, subject = pair
    shaped = avatar.head.shaped()
    subject = _with_truth(avatar, subject, tmp_path / "truth.npz")
    _offsets(avatar, monkeypatch, shaped * torch.tensor([-2.0, 0.0, 0.0]))
    a, b, c = shaped.numpy()[avatar.head.body.faces.numpy()].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    expected = int((normals[:, 0] ** 2 < normals[:, 1] ** 2 + normals[:, 2] ** 2).sum())
    score = _score(avatar, subject)
    assert 0 < expected < len(normals)
    assert score["flipped_faces"] == expected
    counts = {name: step["flipped_faces"] for name, step in score["steps"].items()}
    assert counts == {"start": 0, "beta": 0, "identity_offsets": expected, "pose_offsets": expected}


def test_crossing_faces_that_the_offsets_added(
    pair: tuple[Avatar, Subject], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vertex that is pushed out at the other side of the ball; in one pose only, where Phi_pose does so."""
    avatar, subject = pair
    known = _with_truth(avatar, subject, tmp_path / "truth.npz")
    shaped = avatar.head.shaped()
    spike = torch.zeros_like(shaped)
    spike[0] = -2.3 * shaped[0]
    jaw = avatar.head.pose(1).jaw_pose
    _offsets(avatar, monkeypatch, by_pose=lambda pose: spike * float(torch.equal(pose[3:6], jaw)))
    score = _score(avatar, known)
    assert score["self_intersections"] == {"fitted": 0, "parametric": 0, "added": 0}
    assert score["steps"]["pose_offsets"]["self_intersections"]["added"] >= 3
    _offsets(avatar, monkeypatch, spike, lambda pose: torch.zeros_like(shaped))
    added = score["steps"]["pose_offsets"]["self_intersections"]
    assert _score(avatar, known)["self_intersections"] == added


def test_crossings_of_the_head_model_are_not_the_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two balls in one another cross before any offset; what is new is counted apart."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    twice = trimesh.util.concatenate([ball, ball.copy().apply_translation([0.031, 0.007, 0.003])])
    avatar, subject = tiny_avatar(tmp_path, model=ball_head(twice))
    known = _with_truth(avatar, subject, tmp_path / "truth.npz")
    before = _score(avatar, known)["self_intersections"]
    assert before["fitted"] == before["parametric"] > 5
    assert before["added"] == 0
    apart = torch.zeros_like(avatar.head.shaped())
    apart[len(ball.vertices) :, 0] = 0.5
    _offsets(avatar, monkeypatch, apart)
    assert _score(avatar, known)["self_intersections"] == {**before, "fitted": 0}
    across = torch.zeros_like(apart)
    across[len(ball.vertices) :, 1] = 0.05
    _offsets(avatar, monkeypatch, across)
    moved = _score(avatar, known)["self_intersections"]
    assert 0 < moved["added"] <= moved["fitted"]


def test_evaluate_scores_the_geometry_in_the_poses_of_the_images(pair: tuple[Avatar, Subject], tmp_path: Path) -> None:
    """``metrics.json`` has the keys that it promises, from training timesteps as refined."""
    avatar, subject = pair
    avatar.head.poses["jaw_pose"] += 0.3
    known = _with_truth(avatar, subject, tmp_path / "truth.npz", out=0.0)
    geometry = evaluate(avatar, known, avatar_path=Path("a.pt"), splits=("val",))["geometry"]
    assert geometry == _score(avatar, known)
    assert geometry["mean_mm"] == pytest.approx(0.0, abs=1e-3)
    assert geometry["steps"]["start"]["mean_mm"] > 0.1


DAMAGED = [
    ({"vertices": np.zeros((2, 5, 3), np.float32)}, "a row of (V, 3) is needed for each timestep up to 3"),
    ({"vertices": np.full((4, 42, 3), np.nan, np.float32)}, "NaN or infinite"),
    ({"vertices": np.linspace(0.0, 240.0, 504, dtype=np.float32).reshape(4, 42, 3)}, "must be in metres"),
    ({"faces": np.array([[0, 1, 42]])}, "faces must be (F, 3) indices of its 42 vertices"),
    ({"seen": np.zeros(3)}, "seen has shape (3,)"),
    ({"seen": np.zeros(42)}, "leave no vertex to score"),
]


@pytest.mark.parametrize(("more", "message"), DAMAGED)
def test_damaged_truths_are_refused_before_any_work(
    pair: tuple[Avatar, Subject],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    more: dict[str, np.ndarray],
    message: str,
) -> None:
    """By the check that comes before a fit, and by ``evaluate`` before it draws anything."""
    avatar, subject = pair
    damaged = _with_truth(avatar, subject, tmp_path / "truth.npz", **more)
    monkeypatch.setattr(avatar, "render", lambda *_: pytest.fail("drew an image"))
    for work in (
        lambda: check_ground_truth(damaged),
        lambda: evaluate(avatar, damaged, avatar_path=Path("a.pt"), splits=("val",)),
    ):
        with pytest.raises(DataError, match=r"truth\.npz") as caught:
            work()
        assert message in str(caught.value)


@pytest.mark.parametrize(("more", "message"), DAMAGED)
def test_a_finished_fit_is_scored_without_a_truth_that_is_damaged(
    pair: tuple[Avatar, Subject],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    more: dict[str, np.ndarray],
    message: str,
) -> None:
    """Images keep their scores; the geometry has a reason in the place of its own, and a warning."""
    avatar, subject = pair
    damaged = _with_truth(avatar, subject, tmp_path / "truth.npz", **more)
    metrics = evaluate_sample(avatar, damaged, avatar_path=Path("a.pt"), max_frames=1)
    assert metrics["splits"]["val"]["psnr"] > 0
    assert metrics["geometry"] is None
    assert message in metrics["geometry_reason"]
    assert f"geometry is not scored: {metrics['geometry_reason']}" in caplog.text


def test_a_truth_out_of_reach_has_no_scores(
    pair: tuple[Avatar, Subject], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A surface that lies a kilometre away in one piece is no nearer to any vertex than the reach of the search."""
    avatar, subject = pair
    known = _with_truth(avatar, subject, tmp_path / "truth.npz")
    assert known.ground_truth is not None
    away = np.load(known.ground_truth)["vertices"] + np.float32(1000.0)
    known = _with_truth(avatar, subject, tmp_path / "truth.npz", vertices=away)
    metrics = evaluate(avatar, known, avatar_path=Path("a.pt"), splits=("val",))
    assert metrics["geometry"] is None
    assert "no scored vertex lies within 100 m of the fitted surface" in metrics["geometry_reason"]
    assert metrics["geometry_reason"] in caplog.text
