"""Work lists of the rasterizer: by hand, by counting and by sorting alike, for any number of threads."""

from __future__ import annotations

import pytest
import torch
from checks import threads
from torch import Tensor

from mgavatar.kernels.bridge import sort_pairs
from mgavatar.kernels.tiling import build_work_lists, lists_by_counting, lists_by_sorting

NO_VIEWS = torch.empty(0, dtype=torch.int32)


def random_grid(n: int, n_columns: int, n_rows: int, n_views: int, *, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Depths with ties, rectangles of tiles of which a quarter is empty, and views."""
    g = torch.Generator().manual_seed(seed)
    keys = torch.randint(1, max(2, n // 3), (n,), generator=g).float()
    low = torch.stack([torch.randint(size, (n,), generator=g) for size in (n_columns, n_rows)], 1)
    extent = torch.stack([torch.randint(1, 4, (n,), generator=g) for _ in range(2)], 1)
    high = torch.minimum(low + extent, torch.tensor([n_columns, n_rows]))
    tiles = torch.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], 1).int()
    culled = torch.rand(n, generator=g) < 0.25
    tiles[culled], keys[culled] = 0, 0.0
    view_ids = torch.randint(n_views, (n,), generator=g).int() if n_views > 1 else NO_VIEWS
    return keys, tiles, view_ids


def obvious_lists(keys: Tensor, tiles: Tensor, view_ids: Tensor, n_columns: int, per_view: int) -> list[list[int]]:
    """Gaussians of each touched tile, in order of depth and index, by loops over Python lists."""
    lists: dict[int, list[int]] = {}
    for n in sorted(range(len(keys)), key=lambda n: (float(keys[n]), n)):
        x0, x1, y0, y1 = tiles[n].tolist()
        view = int(view_ids[n]) if len(view_ids) else 0
        for y in range(y0, y1):
            for x in range(x0, x1):
                lists.setdefault(view * per_view + y * n_columns + x, []).append(n)
    return [lists[tile] for tile in sorted(lists)]


def test_two_gaussians_by_hand(device):
    """The nearer one, with the larger index, covers two of three tiles; the other one all three."""
    keys, tiles = torch.tensor([2.0, 1.0]), torch.tensor([[0, 3, 0, 1], [1, 3, 0, 1]], dtype=torch.int32)
    lists = build_work_lists(keys.to(device), tiles.to(device), 3, 1, view_ids=NO_VIEWS.to(device))
    assert lists.isect_offsets.tolist() == [0, 1, 3, 5]
    assert lists.gaussian_ids.tolist() == [0, 1, 0, 1, 0]
    assert lists.isect_ids.tolist() == [0, 3, 1, 4, 2]
    assert lists.first_isects.tolist() == [0, 3]
    assert lists.tiles_per_gauss.tolist() == [3, 2]


@pytest.mark.parametrize(
    ("n", "size", "n_views"), [(3000, (5, 7), 1), (700, (40, 3), 3), (5, (2, 2), 2), (1, (1, 1), 1)]
)
def test_lists_are_those_of_the_obvious_loops(device, n, size, n_views):
    """Depth order in each tile of each view, ties by index; a Gaussian's intersections follow each other."""
    keys, tiles, view_ids = random_grid(n, *size, n_views, seed=n)
    on_device = (tensor.to(device) for tensor in (keys, tiles))
    lists = build_work_lists(*on_device, *size, view_ids=view_ids.to(device), n_views=n_views)
    begins, ends = lists.isect_offsets[:-1].tolist(), lists.isect_offsets[1:].tolist()
    found = [lists.gaussian_ids[a:b].tolist() for a, b in zip(begins, ends, strict=True) if b > a]
    assert found == obvious_lists(keys, tiles, view_ids, size[0], size[0] * size[1])
    owners = torch.arange(n).repeat_interleave(lists.tiles_per_gauss.cpu().long())
    assert torch.equal(owners[lists.isect_ids.cpu().long()], lists.gaussian_ids.cpu().long())
    assert sorted(lists.isect_ids.tolist()) == list(range(len(owners)))


@pytest.mark.parametrize("n_views", [1, 4])
def test_counting_and_sorting_give_the_same_lists(n_views):
    """The CPU's form with any number of threads, and the form of CUDA, run on a CPU."""
    keys, tiles, view_ids = random_grid(2000, 9, 11, n_views, seed=3)
    order = sort_pairs(keys, torch.arange(2000, dtype=torch.int32))[1]
    per_gauss = (tiles[:, 1] - tiles[:, 0]) * (tiles[:, 3] - tiles[:, 2])
    first, total = (torch.cumsum(per_gauss, 0) - per_gauss).int(), int(per_gauss.sum())
    arguments = (order, (tiles, view_ids, 9, 99), first, 99 * n_views, total)
    expected = lists_by_sorting(*arguments)
    for n_threads in (1, 2, 3):
        with threads(n_threads):
            for a, b in zip(lists_by_counting(*arguments), expected, strict=True):
                assert torch.equal(a, b)


@pytest.mark.parametrize("make", [lists_by_counting, lists_by_sorting])
@pytest.mark.parametrize("n", [0, 3])
def test_nothing_to_draw(make, n):
    """No Gaussians, or none that touches a tile: all lists are empty."""
    order, zero = torch.arange(n, dtype=torch.int32), torch.zeros(n, dtype=torch.int32)
    lists = make(order, (zero[:, None].expand(n, 4).contiguous(), NO_VIEWS, 2, 4), zero, 4, 0)
    assert [x.tolist() for x in lists] == [[0] * 5, [], []]
