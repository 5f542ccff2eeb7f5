"""Depth order and work lists: which splats each tile of the image blends, front to back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from mgavatar.kernels import bridge
from mgavatar.kernels.projection import view_of

wp.set_module_options({"enable_backward": False})

MAX_ITEMS = 2**31 - 1
"""Warp's arrays end here."""


@wp.kernel
def _emit_kernel(
    # In:
    order: wp.array[wp.int32],  # [N] Gaussians by depth
    offsets: wp.array[wp.int32],  # [N] entries before each Gaussian, in depth order
    first_item: wp.array[wp.int32],  # [N]
    tiles: wp.array2d[wp.int32],  # [N, 4]
    view_ids: wp.array[wp.int32],  # [N], or empty where there is one view
    n_columns: int,
    tiles_per_view: int,
    # Out:
    entry_tile: wp.array[wp.int32],  # [M] by depth
    entry_item: wp.array[wp.int32],  # [M] by depth
    item_splat: wp.array[wp.int32],  # [M]
):
    i = wp.tid()
    n = order[i]
    entry = offsets[i]
    item = first_item[n]
    first_tile = tiles_per_view * view_of(view_ids, n)
    for row in range(tiles[n, 2], tiles[n, 3]):
        for column in range(tiles[n, 0], tiles[n, 1]):
            entry_tile[entry] = first_tile + row * n_columns + column
            entry_item[entry] = item
            item_splat[item] = n
            entry += 1
            item += 1


@wp.kernel
def _tile_bounds_kernel(
    # In:
    sorted_tiles: wp.array[wp.int32],  # [M]
    # Out:
    tile_begin: wp.array[wp.int32],  # [T] zero where the tile is empty
    tile_end: wp.array[wp.int32],  # [T]
):
    m = wp.tid()
    tile = sorted_tiles[m]
    if m == 0 or sorted_tiles[m - 1] != tile:
        tile_begin[tile] = m
    if m + 1 == sorted_tiles.shape[0] or sorted_tiles[m + 1] != tile:
        tile_end[tile] = m + 1


@dataclass(frozen=True)
class WorkLists:
    """For each tile, its splats from near to far; each (tile, splat) pair is an *item*.

    The tiles of several views follow each other, view after view: T is their number in all views.

    Attributes:
        tile_begin: First entry of ``items`` of each tile, shape [T], int32.
        tile_end: One past the last, shape [T], int32.
        items: Items grouped by tile, front to back, shape [M], int32.
        item_splat: Splat of each item, shape [M], int32.
        first_item: First item of each splat; items are numbered splat after splat, shape [N], int32.
        n_items: Items of each splat, shape [N], int32.
    """

    tile_begin: Tensor
    tile_end: Tensor
    items: Tensor
    item_splat: Tensor
    first_item: Tensor
    n_items: Tensor


def build_work_lists(
    keys: Tensor, tiles: Tensor, n_columns: int, n_rows: int, *, view_ids: Tensor, n_views: int = 1
) -> WorkLists:
    """Sort splats by depth once, ties by index, and hand them to the tiles that they touch.

    One sort serves all views: the sort by tile is stable, so each tile of each view gets its own in depth order.

    Args:
        keys: Depth of each splat, shape [N], float32.
        tiles: First and last + 1 tile column, then row, of each splat, shape [N, 4], int32.
        n_columns: Tiles across the image.
        n_rows: Tiles down the image.
        view_ids: View of each splat, shape [N], int32, or empty where there is one view.
        n_views: Number of views.

    Raises:
        ValueError: If there would be more than 2^31 - 1 items.
    """
    n = len(keys)
    device = keys.device
    tiles_per_view = n_columns * n_rows
    n_tiles = n_views * tiles_per_view
    n_items = (tiles[:, 1] - tiles[:, 0]) * (tiles[:, 3] - tiles[:, 2])
    order = bridge.sort_pairs(keys, torch.arange(n, dtype=torch.int32, device=device))[1]
    in_order = n_items[order]
    ends = torch.cumsum(in_order, 0, dtype=torch.int64)
    total = int(ends[-1]) if n else 0
    if total > MAX_ITEMS:
        raise ValueError(
            f"{total} pairs of tile and Gaussian are more than {MAX_ITEMS}: lower the image size, the number of "
            "Gaussians or their scales"
        )
    offsets = (ends - in_order).int()
    # Numbered splat after splat, so that a splat's partial gradients lie together.
    first_item = (torch.cumsum(n_items, 0, dtype=torch.int64) - n_items).int()
    entry_tile, items, item_splat = torch.empty(3, total, dtype=torch.int32, device=device)
    bounds = torch.zeros(2, n_tiles, dtype=torch.int32, device=device)
    if total:
        emitted = [entry_tile, items, item_splat]
        inputs = [order, offsets, first_item, tiles, view_ids, n_columns, tiles_per_view]
        bridge.launch(_emit_kernel, n, inputs, emitted)
        bits = max(1, (n_tiles - 1).bit_length())
        entry_tile, items = bridge.sort_pairs(entry_tile, items, bits=bits)
        bridge.launch(_tile_bounds_kernel, total, [entry_tile], [bounds[0], bounds[1]])
    return WorkLists(bounds[0], bounds[1], items, item_splat, first_item, n_items)
