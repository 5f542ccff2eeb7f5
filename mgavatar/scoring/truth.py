"""The true surface that a capture may come with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mgavatar.capture.subject import Subject
from mgavatar.errors import DataError
from mgavatar.files import float_array, read_npz

_SEEN_BY = 3
"""Number of training images that must see a vertex before it is scored."""

_LARGEST = 10.0
"""Extent that no head has [m]: vertices that span more are in millimetres or in units of their own."""


class Truth:
    """The true surface of a capture, from ``ground_truth/*.npz``, checked.

    Attributes:
        vertices: Shape [T, V, 3], metres, by the capture's own timestep numbers.
        faces: Vertex indices, shape [F, 3], int64.
        regions: Vertices of each mask that are seen, each of shape [V]; ``face+scalp`` where both masks exist; ``all``.
        scored: Vertices that count: ``face``, or ``all`` where there is no such mask; shape [V].
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
        """Read and check the file.

        Raises:
            DataError: If it is missing or damaged, does not fit the capture, or has no vertex to score.
        """
        arrays = read_npz(path, wanted=_is_wanted).arrays
        if not {"vertices", "faces"} <= set(arrays):
            raise DataError(f"{path}: needs vertices (T, V, 3) and faces (F, 3)")
        vertices = _checked_vertices(arrays["vertices"], subject, path=path)
        n_verts = vertices.shape[1]
        faces = _checked_faces(arrays["faces"], n_verts, path=path)
        per_vertex = {name: values for name, values in arrays.items() if name not in ("vertices", "faces")}
        for name, values in per_vertex.items():
            if values.shape != (n_verts,) or values.dtype.kind not in "biuf":
                raise DataError(f"{path}: {name} has shape {values.shape}, one value for each of {n_verts} is needed")
        seen = per_vertex["seen"] >= _SEEN_BY if "seen" in per_vertex else np.ones(n_verts, bool)
        masks = {
            name.removeprefix("mask_"): per_vertex[name].astype(bool)
            for name in sorted(per_vertex)
            if name.startswith("mask_")
        }
        truth = Truth(vertices, faces, seen, masks)
        if not truth.scored.any():
            raise DataError(f"{path}: mask_face and seen leave no vertex to score; correct them or remove the file")
        return truth


def read_ground_truth(subject: Subject) -> Truth | None:
    """Read the capture's true surface; None if it comes without one.

    Raises:
        DataError: If the file is damaged, does not fit the capture, or has no vertex to score.
    """
    return None if subject.ground_truth is None else Truth.read(subject.ground_truth, subject)


def check_ground_truth(subject: Subject) -> None:
    """Refuse a capture whose true surface cannot be scored, before a fit spends time on it.

    Raises:
        DataError: As :func:`read_ground_truth`.
    """
    read_ground_truth(subject)


def _is_wanted(key: str) -> bool:
    return key in ("vertices", "faces", "seen") or key.startswith("mask_")


def _checked_vertices(values: np.ndarray, subject: Subject, *, path: Path) -> np.ndarray:
    vertices = float_array(values, where=f"{path}: vertices")
    last = max(subject.timestep_ids)
    if vertices.ndim != 3 or vertices.shape[2] != 3 or len(vertices) <= last:
        raise DataError(
            f"{path}: vertices has shape {vertices.shape}; a row of (V, 3) is needed for each timestep up to {last}"
        )
    extent = float(np.ptp(vertices[last], axis=0).max(initial=0.0)) if vertices.shape[1] else 0.0
    if extent > _LARGEST:
        raise DataError(f"{path}: vertices spans {extent:.3g} units; vertices must be in metres (a head spans 0.3)")
    return vertices


def _checked_faces(values: np.ndarray, n_verts: int, *, path: Path) -> Tensor:
    is_triangles = values.ndim == 2 and values.shape[1] == 3 and values.dtype.kind in "iu" and values.size > 0
    if not is_triangles or not 0 <= int(values.min()) <= int(values.max()) < n_verts:
        raise DataError(f"{path}: faces must be (F, 3) indices of its {n_verts} vertices")
    return torch.tensor(values.astype(np.int64))
