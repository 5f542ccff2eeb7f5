"""Depth order and work lists: the Gaussians that each tile of the image blends, front to back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from mgavatar.kernels import bridge
from mgavatar.kernels.projection import view_of

wp.set_module_options({"enable_backward": False})

MAX_ISECTS = 2**31 - 1
"""Largest number of intersections: Warp's arrays end here."""

_CHUNKS = 16  # pieces of the depth order that threads count and place on their own


# Visits the tiles of one chunk of the depth order. Neighbours in depth lie anywhere in memory: what the loop will read
# is asked for early. `row` is the Gaussian's first tile in the current tile row, among the counts of this chunk.
_WALK = """
#if !defined(__CUDACC__)
    enum { AHEAD = 16 };
    const int begin = c * chunk, end = begin + chunk < order.shape[0] ? begin + chunk : order.shape[0];
    int* __restrict__ of_chunk = places.data + (long long)c * places.shape[1];
    for (int i = begin; i < end; ++i) {
        if (i + AHEAD < end) __builtin_prefetch(tiles.data + 4LL * order.data[i + AHEAD]);
        const int n = order.data[i];
        const int* t = tiles.data + 4LL * n;
        const int view = view_ids.shape[0] ? view_ids.data[n] : 0;
        int* row = of_chunk + view * tiles_per_view + t[2] * n_columns;
        BEGIN
        for (int j = t[2]; j < t[3]; ++j, row += n_columns)
            for (int column = t[0]; column < t[1]; ++column) {
                VISIT
            }
    }
#endif
"""

_COUNT = _WALK.replace("BEGIN", "").replace("VISIT", "++row[column];")

_PLACE = _WALK.replace("BEGIN", "int isect = first_isects.data[n];").replace(
    "VISIT",
    """const int entry = row[column]++;
                gaussian_ids.data[entry] = n;
                isect_ids.data[entry] = isect++;""",
)


@wp.func_native(_COUNT)
def _count(
    c: int, chunk: int, order: wp.array[wp.int32], tiles: wp.array2d[wp.int32], view_ids: wp.array[wp.int32],
    n_columns: int, tiles_per_view: int, places: wp.array2d[wp.int32],
): ...  # fmt: skip


@wp.func_native(_PLACE)
def _place(
    c: int, chunk: int, order: wp.array[wp.int32], tiles: wp.array2d[wp.int32], view_ids: wp.array[wp.int32],
    n_columns: int, tiles_per_view: int, first_isects: wp.array[wp.int32], places: wp.array2d[wp.int32],
    gaussian_ids: wp.array[wp.int32], isect_ids: wp.array[wp.int32],
): ...  # fmt: skip


@wp.kernel
def _count_kernel(
    # In:
    first: int,
    chunk: int,  # Gaussians per item
    order: wp.array[wp.int32],  # [N] Gaussians by depth
    tiles: wp.array2d[wp.int32],  # [N, 4]
    view_ids: wp.array[wp.int32],  # [N], or empty where there is one view
    n_columns: int,
    tiles_per_view: int,
    # Out:
    counts: wp.array2d[wp.int32],  # [C, T] zero at first
):
    _count(first + wp.tid(), chunk, order, tiles, view_ids, n_columns, tiles_per_view, counts)


@wp.kernel
def _place_kernel(
    # In:
    first: int,
    chunk: int,  # Gaussians per item
    order: wp.array[wp.int32],  # [N] Gaussians by depth
    tiles: wp.array2d[wp.int32],  # [N, 4]
    view_ids: wp.array[wp.int32],  # [N], or empty where there is one view
    n_columns: int,
    tiles_per_view: int,
    first_isects: wp.array[wp.int32],  # [N]
    # Out:
    places: wp.array2d[wp.int32],  # [C, T] next free entry of each tile; read, then moved on
    gaussian_ids: wp.array[wp.int32],  # [M]
    isect_ids: wp.array[wp.int32],  # [M]
):
    _place(
        first + wp.tid(), chunk, order, tiles, view_ids, n_columns, tiles_per_view, first_isects, places, gaussian_ids,
        isect_ids,
    )  # fmt: skip


@wp.kernel
def _emit_kernel(
    # In:
    order: wp.array[wp.int32],  # [N] Gaussians by depth
    offsets: wp.array[wp.int32],  # [N] entries before each Gaussian, in depth order
    first_isects: wp.array[wp.int32],  # [N]
    tiles: wp.array2d[wp.int32],  # [N, 4]
    view_ids: wp.array[wp.int32],  # [N], or empty where there is one view
    n_columns: int,
    tiles_per_view: int,
    # Out:
    entry_tile: wp.array[wp.int32],  # [M] by depth
    entry_isect: wp.array[wp.int32],  # [M] by depth
    owners: wp.array[wp.int32],  # [M] Gaussian of each intersection
):
    i = wp.tid()
    n = order[i]
    entry = offsets[i]
    isect = first_isects[n]
    first_tile = tiles_per_view * view_of(view_ids, n)
    for row in range(tiles[n, 2], tiles[n, 3]):
        for column in range(tiles[n, 0], tiles[n, 1]):
            entry_tile[entry] = first_tile + row * n_columns + column
            entry_isect[entry] = isect
            owners[isect] = n
            entry += 1
            isect += 1


@dataclass(frozen=True)
class WorkLists:
    """The Gaussians of each tile from near to far. A pair of tile and Gaussian is an *intersection*.

    Tiles of several views are numbered view after view; T counts those of all views. Intersections are numbered
    Gaussian after Gaussian, so that the backward pass finds a Gaussian's partial gradients in consecutive rows.

    Attributes:
        isect_offsets: First entry of each tile in the lists, then their length, shape [T + 1], int32.
        gaussian_ids: Gaussian of each entry; entries are grouped by tile, front to back, shape [M], int32.
        isect_ids: Intersection of each entry, shape [M], int32.
        first_isects: First intersection of each Gaussian, whose others follow it, shape [N], int32.
        tiles_per_gauss: Number of tiles that each Gaussian touches, shape [N], int32.
    """

    isect_offsets: Tensor
    gaussian_ids: Tensor
    isect_ids: Tensor
    first_isects: Tensor
    tiles_per_gauss: Tensor


def build_work_lists(
    keys: Tensor, tiles: Tensor, n_columns: int, n_rows: int, *, view_ids: Tensor, n_views: int = 1
) -> WorkLists:
    """Sort Gaussians by depth once, ties by index, and list them in each tile that they touch.

    One sort serves all views: Gaussians are handed to tiles in depth order, so each tile of each view gets its own in
    that order.

    Args:
        keys: Depth of each Gaussian, shape [N], float32.
        tiles: First and last + 1 tile column, then row, of each Gaussian, shape [N, 4], int32.
        n_columns: Tiles across the image.
        n_rows: Tiles down the image.
        view_ids: View of each Gaussian, shape [N], int32, or empty where there is one view.
        n_views: Number of views.

    Returns:
        The lists, on the device of ``keys``.

    Raises:
        ValueError: If there would be more than 2^31 - 1 intersections.
    """
    n = len(keys)
    tiles_per_gauss = (tiles[:, 1] - tiles[:, 0]) * (tiles[:, 3] - tiles[:, 2])
    ends = torch.cumsum(tiles_per_gauss, 0, dtype=torch.int64)
    n_isects = int(ends[-1]) if n else 0
    if n_isects > MAX_ISECTS:
        raise ValueError(
            f"{n_isects} pairs of tile and Gaussian are more than {MAX_ISECTS}: lower the image size, the number of "
            "Gaussians or their scales"
        )
    first_isects = (ends - tiles_per_gauss).int()
    order = bridge.sort_pairs(keys, torch.arange(n, dtype=torch.int32, device=keys.device))[1]
    n_tiles = n_views * n_columns * n_rows
    make = lists_by_sorting if keys.is_cuda else lists_by_counting
    lists = make(order, (tiles, view_ids, n_columns, n_columns * n_rows), first_isects, n_tiles, n_isects)
    return WorkLists(*lists, first_isects, tiles_per_gauss)


Grid = tuple[Tensor, Tensor, int, int]
"""Tiles [N, 4] and views [N] of the Gaussians, tiles across an image and tiles per view."""


def lists_by_counting(
    order: Tensor, grid: Grid, first_isects: Tensor, n_tiles: int, n_isects: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Make the lists on a CPU: count the entries of each tile, then put each Gaussian in its place.

    A chunk of the depth order counts its entries in each tile. Summed tile after tile, and within a tile chunk after
    chunk, the counts say where each chunk begins to write. Chunks share no memory, and the result is a stable sort by
    tile for any number of threads.

    Args:
        order: Gaussians by depth, shape [N], int32.
        grid: Where the Gaussians lie.
        first_isects: First intersection of each Gaussian, shape [N], int32.
        n_tiles: Tiles of all views.
        n_isects: Number of intersections.

    Returns:
        ``isect_offsets``, ``gaussian_ids`` and ``isect_ids`` of :class:`WorkLists`.
    """
    inputs = (max(1, -(-len(order) // _CHUNKS)), order, *grid)
    counts = order.new_zeros(_CHUNKS, n_tiles)
    bridge.launch_ranges(_count_kernel, _CHUNKS, inputs, (counts,), ranges_per_thread=2)
    ends = torch.cumsum(counts.T.reshape(-1), 0, dtype=torch.int32)
    isect_offsets = torch.cat([ends.new_zeros(1), ends[_CHUNKS - 1 :: _CHUNKS]])
    places = ends.view(n_tiles, _CHUNKS).T.contiguous() - counts
    gaussian_ids, isect_ids = order.new_empty(2, n_isects)
    outputs = (places, gaussian_ids, isect_ids)
    bridge.launch_ranges(_place_kernel, _CHUNKS, (*inputs, first_isects), outputs, ranges_per_thread=2)
    return isect_offsets, gaussian_ids, isect_ids


def lists_by_sorting(
    order: Tensor, grid: Grid, first_isects: Tensor, n_tiles: int, n_isects: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Make the same lists on any device: one thread per Gaussian writes its entries, a stable sort groups them by tile.

    Arguments and results are those of :func:`lists_by_counting`.
    """
    all_ends = torch.cat([first_isects[1:], first_isects.new_full((min(1, len(order)),), n_isects)])
    in_order = (all_ends - first_isects)[order]
    offsets = torch.cumsum(in_order, 0, dtype=torch.int32) - in_order
    entry_tile, entry_isect, owners = order.new_empty(3, n_isects)
    if n_isects:
        outputs = (entry_tile, entry_isect, owners)
        bridge.launch(_emit_kernel, len(order), (order, offsets, first_isects, *grid), outputs)
    bits = max(1, (n_tiles - 1).bit_length())
    sorted_tiles, isect_ids = bridge.sort_pairs(entry_tile, entry_isect, bits=bits)
    tiles = torch.arange(n_tiles + 1, dtype=torch.int32, device=order.device)
    isect_offsets = torch.searchsorted(sorted_tiles.contiguous(), tiles, out_int32=True)
    return isect_offsets, owners[isect_ids], isect_ids
