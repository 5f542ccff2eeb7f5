"""Multiresolution hash features, and the optimizer that visits only entries with a gradient."""

import pytest
import torch
from checks import assert_gradcheck, assert_matches_twin, assert_same_bits
from twins import mesh as twins

from mgavatar.kernels.hash_encode import TableGradient, hash_encode
from mgavatar.kernels.hash_grid import HashGrid, HashGridShape

SMALL = HashGridShape(levels=6, base_resolution=4, max_resolution=90, log2_table_size=10)


def table_of(shape, rng):
    """A table of numbers of order one, so that errors show."""
    n_entries = len(HashGrid(shape).table)
    return torch.randn(n_entries, shape.features, generator=rng).requires_grad_()


def inside(rng, n):
    """Points well inside the cube; a small grid's cells are larger than float32's steps."""
    return torch.rand(n, 3, generator=rng).requires_grad_()


def test_levels_known_by_hand():
    """Resolutions are geometric; dense levels keep what they need, in whole blocks of 64."""
    levels = HashGridShape(levels=3, base_resolution=2, max_resolution=8, log2_table_size=8).table_levels()
    assert levels.tolist() == [[2, 0, 27], [4, 64, 125], [8, 192, 256]]


def test_corner_and_middle_known_by_hand():
    """A point on a grid vertex reads that vertex; a cell's middle reads the mean of eight."""
    levels = torch.tensor([[2, 0, 27]], dtype=torch.int32)
    table = torch.arange(27.0)[:, None].repeat(1, 2)
    points = torch.tensor([[0.5, 1.0, 0.0], [0.25, 0.25, 0.25]])
    assert hash_encode(points, table, levels)[:, 0].tolist() == [1 + 3 * 2, (0 + 1 + 3 + 4 + 9 + 10 + 12 + 13) / 8]


@pytest.mark.parametrize("features", [1, 2, 4])
def test_output_and_gradients_match_the_float64_twin(device, rng, features):
    """Dense and hashed levels, through the table and through the points."""
    shape = HashGridShape(levels=6, features=features, base_resolution=4, max_resolution=90, log2_table_size=10)
    levels = shape.table_levels()
    assert_matches_twin(
        lambda p, t: hash_encode(p, t, levels.to(t.device)),
        lambda p, t: twins.hash_encode(p, t, levels),
        (inside(rng, 300), table_of(shape, rng)),
        device=device,
    )


def test_the_finest_level_is_as_exact_as_the_coarsest(device, rng):
    """Resolution 4096 and not a power of two: the place inside the cell keeps its digits."""
    shape = HashGridShape(levels=3, base_resolution=1000, max_resolution=4095, log2_table_size=12)
    levels = shape.table_levels()
    assert_matches_twin(
        lambda p, t: hash_encode(p, t, levels.to(t.device)),
        lambda p, t: twins.hash_encode(p, t, levels),
        (inside(rng, 500), table_of(shape, rng)),
        device=device,
    )


def test_points_on_and_outside_the_box(device, rng):
    """They are held inside, where they get no gradient; NaN counts as 0 and reads no memory outside the table."""
    levels, table = SMALL.table_levels().to(device), table_of(SMALL, rng).detach().to(device)
    ends = torch.tensor([0.0, 1.0])
    held = torch.cartesian_prod(ends, ends, ends).to(device)
    far = torch.where(held == 0, torch.tensor(-1e6, device=device), torch.tensor(1e6, device=device)).requires_grad_()
    out = hash_encode(far, table, levels)
    assert torch.equal(out, hash_encode(held, table, levels))
    out.sum().backward()
    assert not far.grad.any()
    bad = torch.tensor([[torch.nan] * 3, [torch.inf] * 3, [-torch.inf, 0.0, 0.0]], device=device)
    assert torch.equal(hash_encode(bad, table, levels), hash_encode(held[[0, 7, 0]], table, levels))


def test_float64_gradients_match_finite_differences(rng):
    """Both adjoints of the float64 build."""
    shape = HashGridShape(levels=3, base_resolution=2, max_resolution=9, log2_table_size=6)
    points = torch.tensor([[0.31, 0.72, 0.13], [0.93, 0.44, 0.55]])
    assert_gradcheck(lambda p, t: hash_encode(p, t, shape.table_levels()), points, table_of(shape, rng))


def test_same_bits_for_any_number_of_threads(device, rng):
    """Threads own levels, so that every entry adds up its points in their order."""
    levels = SMALL.table_levels().to(device)
    assert_same_bits(lambda p, t: hash_encode(p, t, levels), (inside(rng, 3000), table_of(SMALL, rng)), device=device)


def test_fixed_point_sums_match_and_do_not_depend_on_the_order(device, rng):
    """What CUDA does: integers, so that permuted points give the same bits; any size keeps its digits."""
    levels, points = SMALL.table_levels().to(device), inside(rng, 2000).detach().to(device)
    table = table_of(SMALL, rng).detach().to(device)
    for size in (1e-20, 1.0, 1e20):
        grad = (size * torch.randn(2000, 12, generator=rng)).to(device)
        plain, fixed, shuffled = (TableGradient.like(table) for _ in range(3))
        plain.add(points, grad, levels)
        fixed.add_fixed(points, grad, levels)
        order = torch.randperm(2000, generator=rng).to(device)
        shuffled.add_fixed(points[order], grad[order], levels)
        assert torch.equal(fixed.values, shuffled.values)
        assert torch.equal(fixed.marks, plain.marks)
        assert (fixed.values - plain.values).norm() <= 1e-6 * plain.values.norm()
        fixed.add_fixed(points, -grad, levels)
        assert not fixed.values.any()


def test_a_gradient_that_is_not_a_number_shows(device, rng):
    """It is not lost on the way through integers."""
    levels, table = SMALL.table_levels().to(device), table_of(SMALL, rng).detach().to(device)
    grad = torch.ones(4, 12, device=device)
    grad[2, 5] = torch.nan
    for add in (TableGradient.add, TableGradient.add_fixed):
        sums = TableGradient.like(table)
        add(sums, inside(rng, 4).detach().to(device), grad, levels)
        assert sums.values.isnan().any()


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_steps_match_torch_sparse_adam(device, rng, dtype, tolerance):
    """Several steps, each on other points, against torch's own lazy Adam in double precision."""
    grid = HashGrid(SMALL)
    grid.table.data.copy_(table_of(SMALL, rng).detach())
    twin = torch.nn.Parameter(grid.table.detach().double())
    optimizer = torch.optim.SparseAdam([twin], lr=0.02, betas=(0.9, 0.99), eps=1e-30)
    grid = grid.to(device, dtype)
    for _ in range(5):
        points, goal = torch.rand(40, 3, generator=rng), torch.randn(40, 12, generator=rng)
        (grid(points.to(device, dtype)) * goal.to(device, dtype)).sum().backward()
        (twins.hash_encode(points.double(), twin, SMALL.table_levels()) * goal.double()).sum().backward()
        rows = torch.nonzero(twin.grad.any(1)).flatten()
        twin.grad = torch.sparse_coo_tensor(rows[None], twin.grad[rows], twin.shape, check_invariants=True)
        optimizer.step()
        optimizer.zero_grad()
        grid.adam_step(0.02, eps=1e-30)  # torch adds it before the bias correction
        assert (grid.table.cpu() - twin).abs().max() < tolerance


def test_entries_that_were_not_hit_keep_their_value_and_moments(rng):
    """Also in the step after one in which they were hit."""
    grid = HashGrid(SMALL)
    grid(torch.rand(20, 3, generator=rng)).square().sum().backward()
    grid.adam_step(0.1)
    before = {k: v.clone() for k, v in grid.state_dict().items() if isinstance(v, torch.Tensor)}
    assert before["exp_avg"].any()
    grid(torch.full((1, 3), 0.5)).sum().backward()
    hit = grid.table_gradient() != 0
    assert 6 <= int(hit.any(1).sum()) <= 48
    grid.adam_step(0.1)
    for name, value in before.items():
        now = grid.state_dict()[name]
        assert torch.equal(now[~hit], value[~hit])
        assert (now[hit] != value[hit]).all()
    assert not grid.table_gradient().any()


def test_a_fit_resumes_bit_for_bit(rng):
    """Six steps, or three, a state_dict, and three more."""
    batches = [(torch.rand(50, 3, generator=rng), torch.randn(50, 12, generator=rng)) for _ in range(6)]

    def train(grid, some):
        for points, goal in some:
            (grid(points) - goal).square().sum().backward()
            grid.adam_step(0.01)
        return grid

    straight = train(HashGrid(SMALL, seed=3), batches)
    resumed = HashGrid(SMALL, seed=8)
    resumed.load_state_dict(train(HashGrid(SMALL, seed=3), batches[:3]).state_dict())
    train(resumed, batches[3:])
    assert torch.equal(straight.table, resumed.table)
    assert torch.equal(straight.exp_avg_sq, resumed.exp_avg_sq)


def test_points_get_their_gradient_and_the_table_none_in_torch(rng):
    """The module's table is not one for torch's optimizers; backward twice adds up."""
    grid, points = HashGrid(SMALL), inside(rng, 30)
    grid(points).sum().backward()
    once = grid.table_gradient()
    grid(points).sum().backward()
    assert points.grad.any()
    assert grid.table.grad is None
    assert torch.allclose(grid.table_gradient(), 2 * once)


def test_it_learns(rng):
    """A smooth function of the place is fitted to a hundredth of its size."""
    points = torch.rand(2000, 3, generator=rng)
    goal = torch.sin(5 * points).sum(1)
    grid = HashGrid(SMALL)
    for _ in range(200):
        loss = (grid(points).sum(1) - goal).square().mean()
        loss.backward()
        grid.adam_step(1e-2)
    assert float(loss.detach()) < 1e-4 * float(goal.square().mean())


def test_seeds_give_the_same_table():
    """Drawn on the CPU from a seed, within 1e-4."""
    assert torch.equal(HashGrid(SMALL, seed=1).table, HashGrid(SMALL, seed=1).table)
    assert not torch.equal(HashGrid(SMALL, seed=1).table, HashGrid(SMALL, seed=2).table)
    assert 0.9e-4 < float(HashGrid(SMALL).table.detach().abs().max()) <= 1e-4


def test_no_points():
    """An empty batch has an empty output and no gradient."""
    grid = HashGrid(SMALL)
    out = grid(torch.zeros(0, 3))
    out.sum().backward()
    assert out.shape == (0, 12)
    assert not grid.table_gradient().any()


def test_a_step_between_forward_and_backward_is_noticed(rng):
    """The table that forward read is gone; torch says so."""
    grid = HashGrid(SMALL)
    out = grid(inside(rng, 5))
    grid.adam_step(0.1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.sum().backward()


@pytest.mark.parametrize(
    "bad", [{"levels": 0}, {"features": 9}, {"base_resolution": 0}, {"max_resolution": 8}, {"log2_table_size": 25}]
)
def test_bad_sizes_are_refused(bad):
    """Each size has its bounds."""
    with pytest.raises(ValueError, match=r"hash grid needs|resolutions must|log2_table_size must"):
        HashGridShape(**bad)


def test_bad_points_are_refused():
    """Shape and dtype; a table that is too small for its levels."""
    grid = HashGrid(SMALL)
    with pytest.raises(ValueError, match=r"points must have shape \[N, 3\]"):
        grid(torch.zeros(4, 2))
    with pytest.raises(ValueError, match="points is torch"):
        grid(torch.zeros(4, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="too small"):
        hash_encode(torch.zeros(4, 3), grid.table[:100], SMALL.table_levels())
