"""A tracked capture in memory: what every reader returns and what the fit consumes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mgavatar.camera import Camera
from mgavatar.config import Background
from mgavatar.head.params import HeadParams

Split = Literal["train", "val", "test"]

SPLITS: tuple[Split, ...] = ("train", "val", "test")

BACKGROUNDS: dict[Background, tuple[float, float, float]] = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
"""RGB in 0..1 of the backgrounds that captures are composited on."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a capture.

    Attributes:
        image_path: The image, composited on ``Subject.background``.
        mask_path: 8-bit foreground alpha, or None.
        camera: Calibration at the size of the file.
        camera_id: Index of the camera in the capture.
        timestep: Row of ``Subject.params``.
    """

    image_path: Path
    mask_path: Path | None
    camera: Camera
    camera_id: int
    timestep: int


@dataclass(frozen=True, eq=False)
class Subject:
    """A capture whose files have been checked.

    Attributes:
        root: The capture's folder.
        frames: Images of each split; ``val`` or ``test`` may be empty.
        params: Tracked FLAME parameters of all timesteps of all splits.
        timestep_ids: The capture's own number of each row of ``params``.
        background: Colour behind the subject in the images, RGB in 0..1, shape [3], float32.
        ground_truth: ``ground_truth/*.npz`` beside the images, or None.
    """

    root: Path
    frames: dict[Split, tuple[Frame, ...]]
    params: HeadParams
    timestep_ids: tuple[int, ...]
    background: np.ndarray
    ground_truth: Path | None
