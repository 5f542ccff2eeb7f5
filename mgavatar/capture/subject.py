"""A tracked capture in memory: what every reader returns and what the fit consumes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mgavatar.camera import Camera
from mgavatar.head.params import HeadParams

Split = Literal["train", "val", "test"]

SPLITS: tuple[Split, ...] = ("train", "val", "test")


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a capture.

    Attributes:
        image_path: The image.
        mask_path: Foreground alpha, or None: a mask, or an image with the matte in its alpha channel, which may be the
            image itself.
        camera: Calibration at the size of the file.
        camera_id: Index of the camera in the capture.
        timestep: Row of ``Subject.params``.
        background: Colour to show behind the subject, that of ``Subject.background``, RGB in 0..1.
    """

    image_path: Path
    mask_path: Path | None
    camera: Camera
    camera_id: int
    timestep: int
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)


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
