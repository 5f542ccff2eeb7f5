"""The true surface that a capture may bring along."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mgavatar.capture.subject import Subject
from mgavatar.errors import DataError
from mgavatar.files import float_array, read_npz

_SEEN_BY = 3
"""So many training images must see a vertex of the truth."""


class Truth:
    """``ground_truth/*.npz``, checked.

    Attributes:
        vertices: Shape [T, V, 3], metres, by the capture's own timestep numbers.
        faces: Vertex indices, shape [F, 3], int64.
        regions: Vertices of every mask that are seen, each shape [V]; ``face+scalp`` where both exist; ``all``.
        scored: What counts: ``face``, or ``all`` where there is no such mask.
    """

    def __init__(self, vertices: np.ndarray, faces: Tensor, seen: np.ndarray, masks: dict[str, np.ndarray]) -> None:
        self.vertices, self.faces = vertices, faces
        self.regions = {name: mask & seen for name, mask in masks.items()}
        if {"face", "scalp"} <= set(masks):
            self.regions["face+scalp"] = self.regions["face"] | self.regions["scalp"]
        self.scored = self.regions.get("face", seen)
        self.regions["all"] = seen

    @staticmethod
    def read(path: Path, subject: Subject) -> Truth:
        arrays = read_npz(
            path, wanted=lambda key: key in ("vertices", "faces", "seen") or key.startswith("mask_")
        ).arrays
        if not {"vertices", "faces"} <= set(arrays):
            raise DataError(f"{path}: needs vertices (T, V, 3) and faces (F, 3)")
        vertices, faces = float_array(arrays["vertices"], where=f"{path}: vertices"), arrays["faces"]
        if vertices.ndim != 3 or vertices.shape[2] != 3 or len(vertices) <= max(subject.timestep_ids):
            raise DataError(
                f"{path}: vertices has shape {vertices.shape}; a row of (V, 3) is needed for each timestep up to "
                f"{max(subject.timestep_ids)}"
            )
        n_verts = vertices.shape[1]
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu" or not _within(faces, n_verts):
            raise DataError(f"{path}: faces must be (F, 3) indices of its {n_verts} vertices")
        for name, values in arrays.items():
            if name not in ("vertices", "faces") and (values.shape != (n_verts,) or values.dtype.kind not in "biuf"):
                raise DataError(f"{path}: {name} has shape {values.shape}, one value for each of {n_verts} is needed")
        seen = arrays["seen"] >= _SEEN_BY if "seen" in arrays else np.ones(n_verts, bool)
        masks = {
            name.removeprefix("mask_"): arrays[name].astype(bool) for name in sorted(arrays) if name[:5] == "mask_"
        }
        truth = Truth(vertices, torch.tensor(faces.astype(np.int64)), seen, masks)
        if not truth.scored.any():
            raise DataError(f"{path}: mask_face and seen leave no vertex to score")
        return truth


def _within(faces: np.ndarray, n_verts: int) -> bool:
    return faces.size > 0 and 0 <= int(faces.min()) <= int(faces.max()) < n_verts
