"""Faces that cross other faces of their mesh."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from mgavatar.kernels.self_intersection import crossing_faces

FLOOR = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]
PAIR = [[0, 1, 2], [3, 4, 5]]


def crossing(corners, faces, device="cpu", scale=1.0) -> list[list[int]]:
    verts = scale * torch.tensor(np.array(corners), dtype=torch.float32, device=device)
    return crossing_faces(verts, torch.tensor(np.array(faces), dtype=torch.int32, device=device)).tolist()


@pytest.mark.parametrize(
    ("other", "crosses"),
    [
        ([[0.5, 0.5, -1.0], [0.5, 0.5, 1.0], [3.0, 3.0, 1.0]], True),
        ([[0.3, 0.4, -1.0], [0.4, 0.3, -1.0], [0.3, 0.3, 0.01]], True),
        ([[0.3, 0.4, -1.0], [0.4, 0.3, -1.0], [0.3, 0.3, -0.01]], False),
        ([[0.3, 0.4, -1.0], [0.4, 0.3, -1.0], [0.3, 0.3, 0.0]], False),
        ([[2.0, 2.0, -1.0], [2.0, 2.0, 1.0], [3.0, 3.0, 0.0]], False),
        ([[1.0, 0.0, -1.0], [1.0, 0.0, 1.0], [1.0, -2.0, 0.0]], False),
        ([[0.1, 0.1, 0.0], [1.0, 0.1, 0.0], [0.1, 1.0, 0.0]], False),
        ([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, 0.5, 0.0]], False),
        ([[-5.0, 0.5, -1.0], [5.0, 0.5, -1.0], [0.5, 0.6, 9.0]], True),
    ],
    ids=[
        "a side",
        "a tip",
        "too short",
        "touching",
        "beyond the edge",
        "on the edge",
        "in one plane",
        "a point",
        "right through",
    ],
)
@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_two_triangles_by_hand(other, crosses, scale, device):
    """Through the inside and back, in any order and in metres or millimetres."""
    expected = [[0, 1]] if crosses else []
    for first, second in ((FLOOR, other), (other, FLOOR), (other[::-1], FLOOR)):
        assert crossing([*first, *second], PAIR, device, scale) == expected


def test_neighbours_do_not_cross(device):
    """A folded strip: its faces share a side or a corner, by index or by place, and meet nowhere else."""
    fold = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.9, 0.9, 0.3]]
    assert crossing(fold, [[0, 1, 2], [2, 1, 3]], device) == []
    by_place = [*fold[:3], fold[2], fold[1], fold[3]]
    assert crossing(by_place, PAIR, device) == []
    through = [*FLOOR, [0.5, 0.5, -1.0], [0.5, 0.5, 1.0]]
    assert crossing(through, [[0, 1, 2], [0, 3, 4]], device) == []  # they cross, and have a corner in common
    apart = [*FLOOR, FLOOR[0], [0.5, 0.5, -1.0], [0.5, 0.5, 1.0]]
    assert crossing(apart, PAIR, device) == [[0, 1]]  # the same corner twice is no neighbour


def test_closed_surfaces(device):
    """A ball does not cross itself; two balls do where they overlap, and no longer when they are apart."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    assert crossing(ball.vertices, ball.faces, device) == []
    for shift, meet in ((0.03, True), (0.21, False)):
        moved = ball.vertices + np.array([shift, 0.0013, 0.0007])
        pairs = crossing([*ball.vertices, *moved], faces, device)
        assert (len(pairs) > 0) == meet
        assert all(first < len(ball.faces) <= second for first, second in pairs)


def _twin(verts: np.ndarray, faces: np.ndarray) -> list[list[int]]:
    """Every pair: solve for where each side of one meets the plane of the other, in barycentric coordinates."""

    def meets(p, q, triangle):
        a, b, c = triangle
        system = np.stack([b - a, c - a, p - q], axis=1)
        if abs(np.linalg.det(system)) < 1e-14:
            return False
        u, v, t = np.linalg.solve(system, p - a)
        return u > 0 and v > 0 and u + v < 1 and 0 < t < 1

    pairs = []
    for i, j in np.stack(np.triu_indices(len(faces), 1), axis=1).tolist():
        if set(faces[i]) & set(faces[j]):
            continue
        one, two = verts[faces[i]], verts[faces[j]]
        sides = [(one[k], one[k - 1], two) for k in range(3)] + [(two[k], two[k - 1], one) for k in range(3)]
        if any(meets(*side) for side in sides):
            pairs.append([i, j])
    return pairs


def test_a_crumpled_ball_against_its_twin(device):
    """The same pairs as solving for every side and every face in double precision."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    rng = np.random.default_rng(0)
    verts = (ball.vertices + rng.normal(0.0, 0.03, ball.vertices.shape)).astype(np.float32)
    expected = _twin(verts.astype(np.float64), ball.faces)
    assert len(expected) > 50
    assert crossing(verts, ball.faces, device) == expected


def test_no_faces_and_wrong_meshes():
    """None of none; what is no mesh is refused."""
    verts = torch.tensor(FLOOR)
    assert crossing_faces(verts, torch.zeros(0, 3, dtype=torch.int32)).shape == (0, 2)
    for bad, faces, message in (
        (verts, torch.tensor([[0, 1, 3]], dtype=torch.int32), "outside"),
        (verts * torch.nan, torch.tensor([[0, 1, 2]], dtype=torch.int32), "not finite"),
        (verts, torch.tensor([[0, 1, 2]]), "int32"),
    ):
        with pytest.raises(ValueError, match=message):
            crossing_faces(bad, faces)
