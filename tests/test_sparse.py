"""Fixed sparse matrices: products, adjoints, refusals."""

import pytest
import torch
from checks import assert_gradcheck, assert_matches_twin, assert_same_bits
from twins import mesh as twins

from mgavatar.kernels.sparse import SparseMatrix, sparse_apply


def entries(rng, n_rows, n_cols, count):
    """Random entries, some at the same place."""
    rows = torch.randint(n_rows, (count,), generator=rng)
    cols = torch.randint(n_cols, (count,), generator=rng)
    return rows, cols, torch.randn(count, generator=rng)


def test_product_known_by_hand():
    """Duplicates are summed and an empty row gives zero."""
    matrix = SparseMatrix.from_coo(
        torch.tensor([2, 0, 2, 2]), torch.tensor([1, 0, 1, 0]), torch.tensor([1.0, 2.0, 3.0, 5.0]), (3, 2)
    )
    x = torch.tensor([10.0, 100.0])
    assert sparse_apply(matrix, x).tolist() == [20.0, 0.0, 450.0]
    assert sparse_apply(matrix.T, torch.tensor([1.0, 7.0, 2.0])).tolist() == [12.0, 8.0]


@pytest.mark.parametrize("channels", [(), (1,), (3,), (13,), (3, 3)])
def test_output_and_gradient_match_the_float64_twin(device, rng, channels):
    """A and its transpose act as the entries say, for any trailing shape."""
    rows, cols, values = entries(rng, 300, 200, 2000)
    matrix = SparseMatrix.from_coo(rows, cols, values, (300, 200)).to(device)
    x = torch.randn(200, *channels, generator=rng).requires_grad_()
    assert_matches_twin(
        lambda x: sparse_apply(matrix, x), lambda x: twins.sparse_apply(rows, cols, values, 300, x), (x,), device=device
    )


def test_long_rows_are_added_in_stages(device, rng):
    """Joint regression: few rows with many entries, few columns in the transpose of its transpose."""
    rows = torch.arange(5).repeat_interleave(7000)
    cols = torch.arange(7000).repeat(5)
    values = torch.rand(35000, generator=rng)
    matrix = SparseMatrix.from_coo(rows, cols, values, (5, 7000)).to(device)
    for m, a, b, n, k in ((matrix, rows, cols, 5, 7000), (matrix.T, cols, rows, 7000, 5)):
        x = torch.randn(k, 3, generator=rng).requires_grad_()
        assert_matches_twin(
            lambda x, m=m: sparse_apply(m, x),
            lambda x, a=a, b=b, n=n: twins.sparse_apply(a, b, values, n, x),
            (x,),
            device=device,
        )


def test_float64_gradient_matches_finite_differences(rng):
    """The adjoint of the float64 build."""
    matrix = SparseMatrix.from_coo(*entries(rng, 8, 6, 20), (8, 6))
    assert_gradcheck(lambda x: sparse_apply(matrix, x), torch.randn(6, 2, generator=rng))


def test_same_bits_for_any_number_of_threads(device, rng):
    """Forward and adjoint do not depend on who adds what."""
    matrix = SparseMatrix.from_coo(*entries(rng, 1000, 10, 20000), (1000, 10)).to(device)
    x = torch.randn(10, 3, generator=rng).requires_grad_()
    assert_same_bits(lambda x: sparse_apply(matrix, x), (x,), device=device)


def test_empty_matrices():
    """No rows, no columns, no entries."""
    none = torch.zeros(0, dtype=torch.long)
    assert sparse_apply(SparseMatrix.from_coo(none, none, torch.zeros(0), (0, 4)), torch.ones(4, 3)).shape == (0, 3)
    assert torch.equal(
        sparse_apply(SparseMatrix.from_coo(none, none, torch.zeros(0), (2, 0)), torch.ones(0, 3)), torch.zeros(2, 3)
    )


def test_numbers_that_are_not_finite_stay_in_their_rows():
    """NaN reaches the rows that read it, and no other."""
    matrix = SparseMatrix.from_coo(torch.tensor([0, 1, 1]), torch.tensor([0, 1, 2]), torch.ones(3), (2, 3))
    out = sparse_apply(matrix, torch.tensor([float("nan"), 1.0, 2.0]))
    assert out[0].isnan()
    assert out[1] == 3.0


@pytest.mark.parametrize(
    ("rows", "cols", "shape", "message"),
    [
        ([0, 3], [0, 0], (3, 1), "row index 0..3"),
        ([-1, 0], [0, 0], (3, 1), "row index -1..0"),
        ([0, 1], [0, 5], (3, 5), "column index 0..5"),
        ([0], [0, 0], (3, 5), "1 rows, 2 columns"),
        ([0, 1], [0, 0], (2**31, 5), "32-bit"),
    ],
)
def test_bad_entries_are_refused(rows, cols, shape, message):
    """Nothing invalid reaches an index."""
    with pytest.raises(ValueError, match=message):
        SparseMatrix.from_coo(torch.tensor(rows), torch.tensor(cols), torch.ones(2), shape)


def test_values_that_do_not_fit_are_refused():
    """Wrong length and wrong dtype."""
    matrix = SparseMatrix.from_coo(torch.tensor([0]), torch.tensor([0]), torch.ones(1), (1, 2))
    with pytest.raises(ValueError, match="applied to values of shape"):
        sparse_apply(matrix, torch.ones(3, 3))
    with pytest.raises(ValueError, match="float32 or float64"):
        sparse_apply(matrix, torch.ones(2, 3, dtype=torch.float16))
