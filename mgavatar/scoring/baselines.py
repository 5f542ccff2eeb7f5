"""Naive baselines, which know nothing of heads: a score below theirs means nothing."""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mgavatar.capture.images import read_images
from mgavatar.capture.subject import Frame, Subject
from mgavatar.head.params import HeadParams
from mgavatar.scoring.image_metrics import psnr

_AT_ONCE = 16

_ARM = 0.1
"""Length that makes angles comparable with distances [m]: a radian weighs as much as 0.1 m."""

_EXPRESSION = 0.002
"""Typical motion of the face by one unit of expression [m]."""


class NaiveBaselines:
    """A white image, the mean training image, and the nearest training image, scored in the same way as an avatar.

    The nearest image is that of the same camera in the nearest tracked pose, see :func:`pose_distances`. A camera that
    training lacks is replaced by the nearest one.
    """

    def __init__(self, subject: Subject) -> None:
        self._train = subject.frames["train"]
        self._camera_positions = {frame.camera_id: frame.camera.position for frame in self._train}
        self._distances = lru_cache(maxsize=64)(partial(pose_distances, subject.params))
        self._read = lru_cache(maxsize=16)(_read_float)
        self._mean = lru_cache(maxsize=4)(self._mean_image)

    def scores(self, frame: Frame, target: Tensor) -> dict[str, float | None]:
        """Return the PSNR of each baseline for one image.

        Args:
            frame: Frame of the image.
            target: The image in 0..1, shape [3, H, W].

        Returns:
            PSNR by baseline [dB], None for a baseline without a training image to use.
        """
        mean = self._mean(target.shape[2], target.shape[1])
        nearest = self.nearest_frame(frame)
        return {
            "white": psnr(torch.ones_like(target), target),
            "mean_image": None if mean is None else psnr(mean, target),
            "nearest_frame": None if nearest is None else psnr(self._read(nearest), target),
        }

    def nearest_frame(self, frame: Frame) -> Frame | None:
        """Return the training frame nearest to ``frame`` by camera and pose, or None if it is a training frame."""
        if frame in self._train:
            return None
        size = (frame.camera.width, frame.camera.height)
        same_size = [other for other in self._train if (other.camera.width, other.camera.height) == size]
        if not same_size:
            return None
        camera_id = self._nearest_camera(frame, {other.camera_id for other in same_size})
        candidates = [other for other in same_size if other.camera_id == camera_id]
        distances = self._distances(frame.timestep)
        return min(candidates, key=lambda other: float(distances[other.timestep]))

    def _nearest_camera(self, frame: Frame, camera_ids: set[int]) -> int:
        if frame.camera_id in camera_ids:
            return frame.camera_id
        position = frame.camera.position
        return min(
            sorted(camera_ids), key=lambda index: float(np.linalg.norm(self._camera_positions[index] - position))
        )

    def _mean_image(self, width: int, height: int) -> Tensor | None:
        """Mean of the training images of this size, [3, H, W], or None if there is none."""
        frames = [frame for frame in self._train if (frame.camera.width, frame.camera.height) == (width, height)]
        if not frames:
            return None
        total = torch.zeros(3, height, width, dtype=torch.int64)
        for first in range(0, len(frames), _AT_ONCE):
            total += read_images(frames[first : first + _AT_ONCE]).sum(dim=0)
        return (total.double() / (255.0 * len(frames))).float()


def _read_float(frame: Frame) -> Tensor:
    return read_images([frame], threads=1)[0].float() / 255.0


def pose_distances(params: HeadParams, timestep: int) -> np.ndarray:
    """Measure the distances of one timestep's pose from those of all timesteps.

    A distance is the sum of the motions by root and neck together, by the jaw, by the translation and by expressions.

    Args:
        params: Parameters of T timesteps.
        timestep: Row of the parameters.

    Returns:
        Distances [m], shape [T].
    """
    head = Rotation.from_rotvec(params.rotation) * Rotation.from_rotvec(params.neck_pose)
    turn = (head[timestep].inv() * head).magnitude()
    jaw, moved, expr = (
        np.linalg.norm(values - values[timestep], axis=1)
        for values in (params.jaw_pose, params.translation, params.expr)
    )
    return _ARM * (turn + jaw) + moved + _EXPRESSION * expr
