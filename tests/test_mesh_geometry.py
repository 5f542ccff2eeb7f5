"""Normals and edge lengths of meshes: values by hand, the float64 twins, collapsed faces, refusals."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from checks import assert_matches_twin, threads
from twins import mesh as twins

from mgavatar.head import mesh_math
from mgavatar.kernels.mesh_geometry import corner_sum, face_normals, vertex_edge_lengths, vertex_normals

CORNER = torch.tensor([[0, 2, 1], [0, 1, 3]])
"""Two faces that meet at a right angle along the x axis, the second one twice as large; vertex 4 has no face."""

VERTS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2], [9, 9, 9]])


def crumpled(rng, n=60, n_faces=150):
    """Random faces over random vertices, with one face twice, one collapsed, and vertices that have no face."""
    faces = torch.randint(n - 3, (n_faces, 3), generator=rng)
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    return 0.1 * torch.randn(n, 3, generator=rng), torch.cat([faces, faces[:1], torch.tensor([[5, 5, 5]])]).int()


def test_a_corner_by_hand():
    """Areas are the weights: 1 down and 2 backwards."""
    assert face_normals(VERTS, CORNER).tolist() == [[0, 0, -1], [0, -1, 0]]
    normals = vertex_normals(VERTS, CORNER)
    shared = [0.0, -2 / 5**0.5, -1 / 5**0.5]
    assert normals[0].tolist() == pytest.approx(shared)
    assert normals[1].tolist() == pytest.approx(shared)
    assert normals[2:].tolist() == [[0, 0, -1], [0, -1, 0], [0, 0, 0]]
    first, second = (2 + 2**0.5) / 3, (3 + 5**0.5) / 3
    both = (first + second) / 2
    assert vertex_edge_lengths(VERTS, CORNER).tolist() == pytest.approx([both, both, first, second, 0.0])


@pytest.mark.parametrize("name", ["face_normals", "vertex_normals", "vertex_edge_lengths"])
def test_output_matches_the_float64_twin(name, device, rng):
    """A crumpled mesh; there is no gradient to compare."""
    op = {"face_normals": face_normals, "vertex_normals": vertex_normals, "vertex_edge_lengths": vertex_edge_lengths}
    assert_matches_twin(op[name], getattr(twins, name), crumpled(rng), device=device)


def test_the_numpy_form_says_the_same(rng):
    """One formula, two homes: float64 arrays of the built-in head, tensors of the fit."""
    verts, faces = crumpled(rng)
    expected = vertex_normals(verts.double(), faces).numpy()
    np.testing.assert_allclose(mesh_math.vertex_normals(verts.double().numpy(), faces.numpy()), expected, atol=1e-12)


@pytest.mark.parametrize("size", [1e-7, 1e-3, 1e3, 1e6])
def test_size_does_not_change_normals(size, rng):
    """From a tenth of a micrometre to a thousand kilometres."""
    verts, faces = crumpled(rng)
    expected = vertex_normals(verts.double(), faces)
    found = vertex_normals(size * verts, faces)
    assert (found.double() - expected).abs().max() < 1e-5


def test_faces_without_area_have_no_normal():
    """Equal corners, corners in a row, and a face so small that its area underflows: zero, and finite."""
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [1e-15, 0, 0], [0, 1e-15, 0]])
    faces = torch.tensor([[0, 0, 1], [0, 1, 2], [0, 3, 4]])
    assert not face_normals(verts, faces).any()
    assert not vertex_normals(verts, faces).any()
    assert vertex_edge_lengths(verts, faces).isfinite().all()


def test_same_bits_from_run_to_run(device, rng):
    """Many faces at few vertices, kernels and torch with one thread and with two."""
    verts, faces = (x.to(device) for x in crumpled(rng, n=50, n_faces=20000))
    before = torch.get_num_threads()
    results = []
    for n in (1, 2, 2, 3):
        torch.set_num_threads(n)
        with threads(n):
            results.append(vertex_normals(verts, faces))
    torch.set_num_threads(before)
    assert all(torch.equal(result, results[0]) for result in results)


def test_prepared_corners_give_the_same(rng):
    """The matrix of a mesh serves all its poses."""
    verts, faces = crumpled(rng)
    corners = corner_sum(faces, len(verts))
    assert torch.equal(vertex_normals(verts, faces, corners=corners), vertex_normals(verts, faces))
    assert torch.equal(vertex_edge_lengths(verts, faces, corners=corners), vertex_edge_lengths(verts, faces))


def test_there_is_no_gradient():
    """Not even where the vertices want one."""
    verts = VERTS.clone().requires_grad_()
    for op in (face_normals, vertex_normals, vertex_edge_lengths):
        assert not op(verts, CORNER).requires_grad


def test_bad_input_is_refused():
    """Shapes, indices, a matrix of another mesh."""
    with pytest.raises(ValueError, match="verts must have shape"):
        face_normals(VERTS[:, :2], CORNER)
    with pytest.raises(ValueError, match="faces must have shape"):
        vertex_normals(VERTS, CORNER[:, :2])
    with pytest.raises(ValueError, match=r"row index 0..5 is outside"):
        vertex_edge_lengths(VERTS, CORNER.clone().index_fill_(1, torch.tensor([2]), 5))
    with pytest.raises(ValueError, match="corners has shape"):
        vertex_normals(VERTS, CORNER, corners=corner_sum(CORNER[:1], 5))
