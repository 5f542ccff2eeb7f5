"""Facts about the capture of an avatar that are stored with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mgavatar.camera import Camera
from mgavatar.capture.subject import Subject
from mgavatar.head.params import HeadParams


@dataclass(frozen=True, eq=False)
class CaptureInfo:
    """Facts about a capture that are stored with its avatar.

    Attributes:
        tracked: Tracked parameters of all timesteps.
        timestep_ids: The capture's own numbers of the timesteps.
        train_timesteps: Rows of the parameters that have training images.
        cameras: Training cameras by their index.
        background: RGB in 0..1, shape [3].
    """

    tracked: HeadParams
    timestep_ids: tuple[int, ...]
    train_timesteps: tuple[int, ...]
    cameras: dict[int, Camera]
    background: np.ndarray

    @staticmethod
    def of(subject: Subject) -> CaptureInfo:
        """Collect the facts about a capture."""
        train = subject.frames["train"]
        cameras: dict[int, Camera] = {}
        for frame in train:
            cameras.setdefault(frame.camera_id, frame.camera)
        seen = tuple(sorted({frame.timestep for frame in train}))
        return CaptureInfo(subject.params, subject.timestep_ids, seen, cameras, subject.background)

    def mean_camera(self) -> Camera:
        """Return the training camera nearest to the mean position of all training cameras."""
        cameras = list(self.cameras.values())
        positions = np.stack([camera.position for camera in cameras])
        return cameras[int(np.argmin(((positions - positions.mean(0)) ** 2).sum(1)))]
