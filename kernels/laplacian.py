"""Uniform Laplacian of per-vertex values."""

import torch
from torch import Tensor

from mgavatar.kernels.sparse import SparseMatrix, sparse_apply


def laplacian_matrix(faces: Tensor, n_verts: int) -> SparseMatrix:
    """Build the neighbour-mean Laplacian ``x_i - mean of x over the neighbours of i`` (Eq. 6).

    Neighbours share an edge, counted once however many faces it has, so a rim vertex averages over its rim and inner
    neighbours alike. A vertex without neighbours has a row of zeros.

    Args:
        faces: Vertex indices, shape [F, 3], int32 or int64.
        n_verts: Number of vertices V.

    Returns:
        The matrix, shape [V, V], on the device of ``faces``.

    Raises:
        ValueError: If ``faces`` is not [F, 3] or an index is outside the vertices.
    """
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces must have shape [F, 3], got {tuple(faces.shape)}")
    if faces.numel() and not (int(faces.min()) >= 0 and int(faces.max()) < n_verts):
        raise ValueError(f"faces index {int(faces.min())}..{int(faces.max())} but there are {n_verts} vertices")
    # Each directed edge as one number, so that `unique` counts an edge once however many faces share it, and both
    # directions of it are there even on a rim.
    corners = faces.long()
    pairs = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    keys = torch.unique(torch.cat([pairs[:, 0] * n_verts + pairs[:, 1], pairs[:, 1] * n_verts + pairs[:, 0]]))
    rows, cols = keys // n_verts, keys % n_verts
    degree = torch.bincount(rows, minlength=n_verts)
    linked = torch.nonzero(degree).flatten()
    values = torch.cat(
        [torch.ones(len(linked), device=faces.device, dtype=torch.float64), -1.0 / degree[rows].double()]
    )
    return SparseMatrix.from_coo(torch.cat([linked, rows]), torch.cat([linked, cols]), values, (n_verts, n_verts))


def laplacian(matrix: SparseMatrix, x: Tensor) -> Tensor:
    """Apply the Laplacian to per-vertex values (Eq. 6). Differentiable in ``x``.

    Args:
        matrix: Made by :func:`laplacian_matrix`, shape [V, V].
        x: Values, shape [V] or [V, ...], float32 or float64.

    Returns:
        Values minus their neighbours' mean, shape of ``x``, in its unit.

    Raises:
        ValueError: If ``x`` does not fit the matrix.
    """
    return sparse_apply(matrix, x)
