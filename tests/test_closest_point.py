"""Nearest points on a mesh."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from mgavatar.kernels.closest_point import closest_points

TRIANGLE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]], dtype=torch.int32)


@pytest.mark.parametrize(
    ("point", "nearest"),
    [
        ([0.25, 0.25, 0.3], [0.25, 0.25, 0.0]),
        ([0.5, -0.4, 0.2], [0.5, 0.0, 0.0]),
        ([-0.3, -0.2, 0.1], [0.0, 0.0, 0.0]),
        ([1.0, 1.0, -0.5], [0.5, 0.5, 0.0]),
        ([0.2, 0.3, 0.0], [0.2, 0.3, 0.0]),
    ],
    ids=["inside", "edge", "corner", "hypotenuse", "on it"],
)
def test_one_triangle_by_hand(point, nearest, device):
    """Above the face, beyond an edge, beyond a corner."""
    verts, faces = (x.to(device) for x in TRIANGLE)
    closest, face_ids = closest_points(verts, faces, torch.tensor([point], device=device))
    assert torch.allclose(closest.cpu(), torch.tensor([nearest]), atol=1e-6)
    assert face_ids.tolist() == [0]


def test_every_face_by_brute_force(device):
    """The tree finds what trying all faces finds, and the face it names holds the point."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    rng = np.random.default_rng(0)
    corners = ball.vertices * rng.uniform(0.6, 1.4, (len(ball.vertices), 1))
    points = rng.uniform(-0.2, 0.2, (60, 3))
    verts = torch.tensor(corners, dtype=torch.float32, device=device)
    faces = torch.tensor(ball.faces, dtype=torch.int32, device=device)
    closest, face_ids = closest_points(verts, faces, torch.tensor(points, dtype=torch.float32, device=device))
    triangles = corners[ball.faces]
    for point, found, face in zip(points, closest.cpu().numpy(), face_ids.tolist(), strict=True):
        every = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
        distances = np.linalg.norm(every - point, axis=1)
        assert np.linalg.norm(found - point) == pytest.approx(distances.min(), abs=1e-6)
        assert np.allclose(found, every[face], atol=1e-5)


def test_what_is_out_of_reach_has_no_face(device):
    """The point itself, and -1."""
    verts, faces = (x.to(device) for x in TRIANGLE)
    points = torch.tensor([[0.2, 0.2, 0.4], [0.2, 0.2, 0.6]], device=device)
    closest, face_ids = closest_points(verts, faces, points, reach=0.5)
    assert face_ids.tolist() == [0, -1]
    assert torch.equal(closest[1], points[1])


def test_no_points_give_none(device):
    """An empty query is no launch."""
    verts, faces = (x.to(device) for x in TRIANGLE)
    closest, face_ids = closest_points(verts, faces, torch.zeros(0, 3, device=device))
    assert closest.shape == (0, 3)
    assert face_ids.shape == (0,)


@pytest.mark.parametrize("index", [-1, 3])
def test_a_face_without_its_vertices_is_refused(index):
    """Nothing invalid reaches an index."""
    verts, _ = TRIANGLE
    with pytest.raises(ValueError, match="of 3"):
        closest_points(verts, torch.tensor([[0, 1, index]], dtype=torch.int32), torch.zeros(1, 3))
