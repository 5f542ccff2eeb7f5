"""Midpoint subdivision of a head: topology, linearity, joints, masks, seams and time."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from ball_head import ball_head

from mgavatar.head.load import read_head_model
from mgavatar.head.model import HeadModel
from mgavatar.head.subdivide import subdivide


@pytest.fixture
def head() -> HeadModel:
    return ball_head()


def test_one_triangle_by_hand():
    head = ball_head()
    single = replace(
        head,
        faces=np.array([[0, 1, 2]], np.int32),
        ft=np.array([[2, 1, 0]], np.int32),
        masks={"two": np.arange(len(head.v_template)) < 2},
    )
    fine, parents = subdivide(single)
    n = len(head.v_template)
    np.testing.assert_array_equal(fine.faces, [[0, n, n + 1], [n, 1, n + 2], [n + 1, n + 2, 2], [n, n + 2, n + 1]])
    np.testing.assert_array_equal(parents[n:], [[0, 1], [0, 2], [1, 2]])
    np.testing.assert_array_equal(np.flatnonzero(fine.masks["two"]), [0, 1, n])
    np.testing.assert_allclose(fine.v_template[n], (head.v_template[0] + head.v_template[1]) / 2, rtol=1e-6)
    corner = fine.ft[0]  # of the face that keeps vertex 0, whose texture coordinate is 2
    assert corner[0] == 2
    np.testing.assert_allclose(fine.vt[corner[1]], (head.vt[2] + head.vt[1]) / 2, rtol=1e-6)


def test_counts_and_orientation(head):
    """V + E vertices, 4F faces, the same surface with the same orientation."""
    fine, parents = subdivide(head)
    assert len(fine.v_template) == len(parents) == 42 + 120
    assert fine.faces.shape == fine.ft.shape == (320, 3)
    assert fine.faces.dtype == fine.ft.dtype == parents.dtype == np.int32
    base, split = (trimesh.Trimesh(h.v_template, h.faces, process=False) for h in (head, fine))
    np.testing.assert_allclose(split.area, base.area, rtol=1e-5)
    np.testing.assert_allclose(split.volume, base.volume, rtol=1e-5)
    np.testing.assert_allclose(split.face_normals, np.repeat(base.face_normals, 4, axis=0), atol=1e-4)
    assert split.is_watertight


def test_agrees_with_trimesh(head):
    """The same vertices, as a set, as trimesh's own subdivision."""
    fine, _ = subdivide(head)
    verts, faces = trimesh.remesh.subdivide(head.v_template.astype(np.float64), head.faces)
    assert len(faces) == len(fine.faces)
    ours, theirs = (np.unique(np.round(v, 5), axis=0) for v in (fine.v_template.astype(np.float64), verts))
    np.testing.assert_allclose(ours, theirs, atol=2e-5)


def test_every_array_is_the_mean_of_its_parents(head):
    fine, parents = subdivide(head)
    n = len(head.v_template)
    np.testing.assert_array_equal(parents[:n], np.stack([np.arange(n)] * 2, axis=1))
    for name in ("v_template", "shapedirs", "posedirs", "lbs_weights"):
        base, values = getattr(head, name), getattr(fine, name)
        assert values.dtype == np.float32
        np.testing.assert_array_equal(values[:n], base)
        np.testing.assert_allclose(values, 0.5 * (base[parents[:, 0]] + base[parents[:, 1]]), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(fine.lbs_weights.sum(axis=1), 1.0, atol=1e-6)


def test_joints_stay(head):
    fine, _ = subdivide(head)
    np.testing.assert_array_equal(fine.J_regressor[:, len(head.v_template) :], 0.0)
    np.testing.assert_allclose(fine.J_regressor @ fine.v_template, head.J_regressor @ head.v_template, atol=1e-7)


def test_seams_stay_seams(head):
    """A face's texture coordinates are the means of that face's own corners, on either side of a seam."""
    assert len(head.vt) > len(head.v_template)
    fine, _ = subdivide(head)
    corners = head.vt[head.ft]
    middle = fine.vt[fine.ft].reshape(-1, 4, 3, 2)[:, 3]
    ab, bc, ca = (0.5 * (corners[:, i] + corners[:, (i + 1) % 3]) for i in range(3))
    np.testing.assert_allclose(middle, np.stack([ab, bc, ca], axis=1), rtol=1e-5, atol=1e-6)


def test_twice_and_provenance(head):
    fine, _ = subdivide(subdivide(head)[0])
    assert len(fine.faces) == 16 * len(head.faces)
    kept = ("n_shape", "n_expr", "expr_basis", "expr_names", "name")
    assert [getattr(fine, key) for key in kept] == [getattr(head, key) for key in kept]


def test_flame_sized_head_takes_less_than_two_seconds():
    sphere = trimesh.creation.uv_sphere(radius=0.1, count=[71, 72])
    head = ball_head(sphere, n_shape=300, n_expr=100)
    start = time.process_time()  # not slowed by what else the machine does
    fine, _ = subdivide(head)
    assert time.process_time() - start < 2.0
    assert len(fine.v_template) > 19_000
    assert fine.shapedirs.shape[2] == 400


def test_real_head(real_data):
    head = read_head_model(real_data / "head_models/ict_head.npz")
    fine, parents = subdivide(head)
    assert len(fine.faces) == 4 * len(head.faces)
    np.testing.assert_allclose(fine.v_template, head.v_template[parents].mean(axis=1), atol=1e-7)
    assert fine.masks["face"].sum() > 3 * head.masks["face"].sum()
