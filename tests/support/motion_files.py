"""Writers of motion in the formats of other programs, from one made-up performance; no code is shared with readers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Performance:
    """FLAME parameters of T frames, rotation vectors in radians: what every writer writes as far as its format can."""

    expr: np.ndarray
    root: np.ndarray
    neck: np.ndarray
    jaw: np.ndarray
    left_eye: np.ndarray
    right_eye: np.ndarray
    place: np.ndarray

    @property
    def eyes(self) -> np.ndarray:
        return np.hstack([self.left_eye, self.right_eye])


def performance(n_frames: int = 7, *, n_expr: int = 100, seed: int = 5) -> Performance:
    """A performance of random, smooth enough numbers."""
    rng = np.random.default_rng(seed)

    def joint(scale: float) -> np.ndarray:
        return rng.normal(0.0, scale, (n_frames, 3))

    return Performance(
        rng.normal(0.0, 0.5, (n_frames, n_expr)),
        joint(0.2),
        joint(0.1),
        joint(0.05),
        joint(0.1),
        joint(0.1),
        joint(0.05),
    )


def write_emoca(path: Path, made: Performance) -> Path:
    """EMOCA's and DECA's codes: 50 expressions, a pose of root and jaw, 100 shape coefficients, and pictures' codes."""
    n = len(made.expr)
    np.savez(
        path,
        shapecode=np.zeros((n, 100), np.float32),
        expcode=made.expr[:, :50].astype(np.float32),
        posecode=np.hstack([made.root, made.jaw]).astype(np.float32),
        detailcode=np.zeros((n, 128), np.float32),
    )
    return path


def write_smirk(path: Path, made: Performance) -> Path:
    """SMIRK's outputs, as its users save them: root and jaw apart, and two eyelids."""
    np.savez(
        path,
        expression_params=made.expr[:, :50].astype(np.float32),
        pose_params=made.root.astype(np.float32),
        jaw_params=made.jaw.astype(np.float32),
        eyelid_params=np.zeros((len(made.expr), 2), np.float32),
        shape_params=np.zeros((len(made.expr), 300), np.float32),
    )
    return path


def write_diffposetalk(path: Path, made: Performance) -> Path:
    """DiffPoseTalk's coefficients: 50 expressions, a pose of root and jaw, one identity."""
    pose = np.concatenate([made.root, made.jaw], axis=-1)
    np.savez(path, exp=made.expr[:, :50].astype(np.float32), pose=pose.astype(np.float32), shape=np.zeros(100))
    return path
