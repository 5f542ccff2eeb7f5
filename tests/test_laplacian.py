"""The neighbour-mean Laplacian."""

import pytest
import torch
from checks import assert_gradcheck, assert_matches_twin, assert_same_bits
from twins import mesh as twins

from mgavatar.kernels.laplacian import laplacian, laplacian_matrix

SQUARE = torch.tensor([[0, 1, 2], [0, 2, 3]])


def grid(n):
    """Faces of an n x n grid of vertices."""
    at = torch.arange(n * n).reshape(n, n)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    return torch.cat([torch.stack([a, b, c], -1).reshape(-1, 3), torch.stack([a, c, d], -1).reshape(-1, 3)])


def test_square_known_by_hand():
    """The shared edge counts once; vertex 1 has neighbours 0 and 2."""
    x = torch.tensor([1.0, 2.0, 4.0, 8.0])
    out = laplacian(laplacian_matrix(SQUARE, 4), x)
    assert torch.allclose(out, torch.tensor([1 - 14 / 3, 2 - 2.5, 4 - 11 / 3, 8 - 2.5]))


def test_output_and_gradient_match_the_float64_twin(device, rng):
    """A grid with a rim, an isolated vertex, and a face listed twice and inside out."""
    faces = torch.cat([grid(12), torch.tensor([[0, 1, 13], [13, 1, 0]])])
    x = torch.randn(145, 3, generator=rng).requires_grad_()
    matrix = laplacian_matrix(faces, 145).to(device)
    assert_matches_twin(lambda x: laplacian(matrix, x), lambda x: twins.laplacian(faces, x), (x,), device=device)


def test_isolated_vertices_and_collapsed_faces_give_zero():
    """A face that names a vertex twice adds no neighbour of itself; nothing divides by zero."""
    matrix = laplacian_matrix(torch.tensor([[0, 0, 1], [2, 2, 2]]), 4)
    assert laplacian(matrix, torch.tensor([1.0, 3.0, 5.0, 7.0])).tolist() == [-2.0, 2.0, 0.0, 0.0]


def test_far_coordinates_stay_exact(rng):
    """At 1e6 the result is as good as float32 positions are: half a unit in the last place of them."""
    x = (torch.randn(144, 3, generator=rng) + 1e6).requires_grad_()
    matrix = laplacian_matrix(grid(12), 144)
    error = laplacian(matrix, x).double() - twins.laplacian(grid(12), x.double())
    assert error.abs().max() < 0.25  # a unit in the last place of 1e6 is 0.06, and six of them are added up


def test_float64_gradient_matches_finite_differences(rng):
    """The adjoint of the float64 build."""
    matrix = laplacian_matrix(SQUARE, 5)
    assert_gradcheck(lambda x: laplacian(matrix, x), torch.randn(5, 3, generator=rng))


def test_same_bits_for_any_number_of_threads(device, rng):
    """Forward and adjoint do not depend on who adds what."""
    matrix = laplacian_matrix(grid(30), 900).to(device)
    assert_same_bits(
        lambda x: laplacian(matrix, x), (torch.randn(900, 3, generator=rng).requires_grad_(),), device=device
    )


def test_bad_faces_are_refused():
    """Shape and range."""
    with pytest.raises(ValueError, match=r"\[F, 3\]"):
        laplacian_matrix(torch.zeros(4, 4, dtype=torch.long), 4)
    with pytest.raises(ValueError, match="there are 3 vertices"):
        laplacian_matrix(SQUARE, 3)
