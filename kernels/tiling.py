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
    gaussian_ids: wp.array[wp.int32],  # [M] by intersection
):
    i = wp.tid()
    n = order[i]
    # Entries follow the depth order, so that a stable sort by tile keeps it. Intersections follow the Gaussians'
    # own order, so that the backward pass finds a Gaussian's partial gradients in consecutive rows.
    entry = offsets[i]
    isect = first_isects[n]
    first_tile = tiles_per_view * view_of(view_ids, n)
    for row in range(tiles[n, 2], tiles[n, 3]):
        for column in range(tiles[n, 0], tiles[n, 1]):
            entry_tile[entry] = first_tile + row * n_columns + column
            entry_isect[entry] = isect
            gaussian_ids[isect] = n
            entry += 1
            isect += 1


@wp.kernel
def _tile_bounds_kernel(
    # In:
    sorted_tiles: wp.array[wp.int32],  # [M]
    # Out:
    tile_begin: wp.array[wp.int32],  # [T] zero where the tile is empty
    tile_end: wp.array[wp.int32],  # [T] zero where the tile is empty
):
    m = wp.tid()
    tile = sorted_tiles[m]
    if m == 0 or sorted_tiles[m - 1] != tile:
        tile_begin[tile] = m
    if m + 1 == sorted_tiles.shape[0] or sorted_tiles[m + 1] != tile:
        tile_end[tile] = m + 1


@dataclass(frozen=True)
class WorkLists:
    """The Gaussians of each tile from near to far. A pair of tile and Gaussian is an *intersection*.

    Tiles of several views are numbered view after view; T counts those of all views.

    Attributes:
        tile_begin: First entry of each tile in ``isect_ids``, shape [T], int32.
        tile_end: One past its last entry, shape [T], int32.
        isect_ids: Intersections grouped by tile, front to back, shape [M], int32.
        gaussian_ids: Gaussian of each intersection, shape [M], int32.
        first_isects: First intersection of each Gaussian, whose others follow it, shape [N], int32.
        tiles_per_gauss: Number of tiles that each Gaussian touches, shape [N], int32.
    """

    tile_begin: Tensor
    tile_end: Tensor
    isect_ids: Tensor
    gaussian_ids: Tensor
    first_isects: Tensor
    tiles_per_gauss: Tensor


def build_work_lists(
    keys: Tensor, tiles: Tensor, n_columns: int, n_rows: int, *, view_ids: Tensor, n_views: int = 1
) -> WorkLists:
    """Sort Gaussians by depth once, ties by index, and list them in each tile that they touch.

    One sort serves all views: the sort by tile is stable, so each tile of each view gets its own in depth order.

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
    device = keys.device
    tiles_per_view = n_columns * n_rows
    n_tiles = n_views * tiles_per_view
    tiles_per_gauss = (tiles[:, 1] - tiles[:, 0]) * (tiles[:, 3] - tiles[:, 2])
    order = bridge.sort_pairs(keys, torch.arange(n, dtype=torch.int32, device=device))[1]
    in_order = tiles_per_gauss[order]
    ends = torch.cumsum(in_order, 0, dtype=torch.int64)
    n_isects = int(ends[-1]) if n else 0
    if n_isects > MAX_ISECTS:
        raise ValueError(
            f"{n_isects} pairs of tile and Gaussian are more than {MAX_ISECTS}: lower the image size, the number of "
            "Gaussians or their scales"
        )
    offsets = (ends - in_order).int()
    first_isects = (torch.cumsum(tiles_per_gauss, 0, dtype=torch.int64) - tiles_per_gauss).int()
    entry_tile, isect_ids, gaussian_ids = torch.empty(3, n_isects, dtype=torch.int32, device=device)
    bounds = torch.zeros(2, n_tiles, dtype=torch.int32, device=device)
    if n_isects:
        inputs = [order, offsets, first_isects, tiles, view_ids, n_columns, tiles_per_view]
        bridge.launch(_emit_kernel, n, inputs, [entry_tile, isect_ids, gaussian_ids])
        bits = max(1, (n_tiles - 1).bit_length())
        entry_tile, isect_ids = bridge.sort_pairs(entry_tile, isect_ids, bits=bits)
        bridge.launch(_tile_bounds_kernel, n_isects, [entry_tile], [bounds[0], bounds[1]])
    return WorkLists(bounds[0], bounds[1], isect_ids, gaussian_ids, first_isects, tiles_per_gauss)
