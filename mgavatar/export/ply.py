"""Splats as PLY files, in the layout that 3D Gaussian splatting writes and every viewer of splats reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from mgavatar.export.bake import Splats
from mgavatar.files import atomic_write, one_line

SH_COLUMNS = 45
"""Number of columns of degrees 1 to 3. Missing degrees are zero: some viewers refuse shorter files."""

COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{channel}" for channel in range(3)),
    *(f"f_rest_{index}" for index in range(SH_COLUMNS)),
    "opacity",
    *(f"scale_{axis}" for axis in range(3)),
    *(f"rot_{part}" for part in range(4)),
)
"""Columns of every splat, float32 each."""

_LEAST = 1e-6
"""Distance of opacities from 0 and 1, which have no finite logit."""

_LEAST_SCALE = 1e-12
"""Smallest standard deviation [m]: 0 has no finite logarithm."""


def write_splats_ply(path: Path, splats: Splats, *, comments: Sequence[str] = ()) -> None:
    """Write splats: opacity as a logit, scale as a logarithm, rotation as wxyz, colours by channel; atomic.

    Args:
        path: The file.
        splats: The splats.
        comments: Lines for the header.

    Raises:
        DataError: If the file cannot be written.
    """
    table = splat_table(splats)
    notes = [one_line(comment).encode("ascii", errors="replace").decode() for comment in comments]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {note}" for note in notes),
        f"element vertex {len(table)}",
        *(f"property float {name}" for name in COLUMNS),
        "end_header",
    ]
    with atomic_write(path) as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(table.tobytes())


def splat_table(splats: Splats) -> np.ndarray:
    """Return the rows of the file, shape [N, 62], little-endian float32."""
    n = len(splats)
    others = np.zeros((n, 3, SH_COLUMNS // 3), np.float32)
    given = splats.sh[:, 1:].permute(0, 2, 1)  # all of red, then all of green, then all of blue
    others[:, :, : given.shape[2]] = given.cpu().numpy()
    opacities = splats.opacities.double().clamp(_LEAST, 1.0 - _LEAST)
    normals = torch.zeros_like(splats.means)
    columns = [
        *(part.cpu().numpy() for part in (splats.means, normals, splats.sh[:, 0])),
        others.reshape(n, SH_COLUMNS),
        opacities.logit()[:, None].cpu().numpy(),
        splats.scales.clamp(min=_LEAST_SCALE).log().cpu().numpy(),
        splats.quats.cpu().numpy(),
    ]
    return np.concatenate(columns, axis=1).astype("<f4")
