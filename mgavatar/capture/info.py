"""What an avatar remembers of the capture that it was fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mgavatar.camera import Camera
from mgavatar.capture.subject import Subject
from mgavatar.head.params import HeadParams


@dataclass(frozen=True, eq=False)
class CaptureInfo:
    """What an avatar remembers of the capture that it was fitted to.

    Attributes:
        tracked: Parameters as the capture states them, all timesteps.
        timestep_ids: The capture's own numbers of the timesteps.
        train_timesteps: Rows that the fit has seen.
        cameras: Training cameras by their index.
        background: RGB, shape [3].
    """

    tracked: HeadParams
    timestep_ids: tuple[int, ...]
    train_timesteps: tuple[int, ...]
    cameras: dict[int, Camera]
    background: np.ndarray

    @staticmethod
    def of(subject: Subject) -> CaptureInfo:
        train = subject.frames["train"]
        cameras: dict[int, Camera] = {}
        for frame in train:
            cameras.setdefault(frame.camera_id, frame.camera)
        seen = tuple(sorted({frame.timestep for frame in train}))
        return CaptureInfo(subject.params, subject.timestep_ids, seen, cameras, subject.background)

    def mean_camera(self) -> Camera:
        """The training camera that is nearest to the middle of them all."""
        cameras = list(self.cameras.values())
        positions = np.stack([camera.position for camera in cameras])
        return cameras[int(np.argmin(((positions - positions.mean(0)) ** 2).sum(1)))]
