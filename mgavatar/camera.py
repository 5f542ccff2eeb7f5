"""Cameras and the conventions of the whole program.

* World and head: metres, x to the subject's left, y up, z forward (the face looks to +z).
* Camera: OpenCV axes, x right, y down, z forward; ``viewmat`` maps world to camera.
* Pixels: the centre of pixel (column i, row j) is at (i + 0.5, j + 0.5).
* Quaternions: w, x, y, z. Rotation vectors: axis times angle [rad].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    Attributes:
        viewmat: World to camera, OpenCV axes, shape [4, 4], float64.
        K: Intrinsics [px], shape [3, 3], float64.
        width: Image width [px].
        height: Image height [px].
    """

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int

    @property
    def position(self) -> np.ndarray:
        """Return the camera centre in world space [m], shape [3]."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def scaled(self, width: int, height: int) -> Camera:
        """Return the same view at another image size [px]."""
        factor = np.array([[width / self.width], [height / self.height], [1.0]])
        return Camera(self.viewmat, self.K * factor, width, height)


def look_at(
    position: np.ndarray,
    target: np.ndarray,
    *,
    focal: float,
    width: int,
    height: int,
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Camera:
    """Return a camera that sees a point in its image centre.

    Args:
        position: Camera centre in world space [m], shape [3].
        target: Point in the image centre [m], shape [3].
        focal: Focal length [px].
        width: Image width [px].
        height: Image height [px].
        up: Direction that points upwards in the image, not parallel to the line of sight.
    """
    forward = np.asarray(target, np.float64) - np.asarray(position, np.float64)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, np.float64))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ np.asarray(position, np.float64)
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat, K, width, height)
