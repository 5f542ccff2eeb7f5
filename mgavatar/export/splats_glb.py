"""Splats as GLB files with ``KHR_gaussian_splatting``, Khronos' extension of glTF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from mgavatar.export.bake import Splats
from mgavatar.export.glb import POINTS, Glb, as_float32, linear_colors
from mgavatar.gaussians import SH_C0

EXTENSION = "KHR_gaussian_splatting"

_DESCRIPTION = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}


def write_splats_glb(path: Path, splats: Splats, *, extras: dict[str, Any]) -> None:
    """Write splats: rotation as xyzw, scale and opacity as they are, and colours for programs that show points; atomic.

    glTF has no empty arrays: without splats, the file has a scene with nothing in it.

    Args:
        path: The file.
        splats: The splats.
        extras: Notes for readers of the file.

    Raises:
        DataError: If the file cannot be written.
    """
    glb = Glb(extras)
    node: dict[str, Any] = {"name": "avatar"}
    glb.tree |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node], "extensionsUsed": [EXTENSION]}
    if len(splats):
        primitive = {"mode": POINTS, "attributes": _attributes(glb, splats), "extensions": {EXTENSION: _DESCRIPTION}}
        glb.tree["meshes"] = [{"name": "splats", "primitives": [primitive]}]
        node["mesh"] = 0
    else:
        del glb.tree["extensionsUsed"]
    glb.write(path)


def _attributes(glb: Glb, splats: Splats) -> dict[str, int]:
    """Add the arrays and return the index of each attribute's accessor."""
    quats = torch.nn.functional.normalize(splats.quats.double(), dim=1)[:, [1, 2, 3, 0]]
    opacities = splats.opacities.clamp(0.0, 1.0)
    shown = linear_colors(0.5 + SH_C0 * splats.sh[:, 0])
    attributes = {
        "POSITION": glb.add(as_float32(splats.means), bounds=True),
        "COLOR_0": glb.add(as_float32(torch.cat([torch.from_numpy(shown), opacities[:, None].cpu()], 1))),
        f"{EXTENSION}:ROTATION": glb.add(as_float32(quats)),
        f"{EXTENSION}:SCALE": glb.add(as_float32(splats.scales)),
        f"{EXTENSION}:OPACITY": glb.add(as_float32(opacities)),
    }
    for degree in range(splats.degree + 1):
        for coefficient in range(2 * degree + 1):
            values = splats.sh[:, degree**2 + coefficient]
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{coefficient}"] = glb.add(as_float32(values))
    return attributes
