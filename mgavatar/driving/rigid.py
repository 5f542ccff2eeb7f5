"""Rotations and places of a head as trackers store them, in the form that drives an avatar."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.errors import DataError

Array = np.ndarray

OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])
"""Signs that exchange camera axes of OpenGL (y up, z backwards) and of OpenCV (y down, z forward), both ways."""


def rotation_vectors(matrices: Array, *, where: str) -> Array:
    """Return the rotation vectors of rotation matrices [rad], shape [T, 3, 3] to [T, 3].

    Matrices that are nearly rotations are made ones.

    Args:
        matrices: Shape [T, 3, 3].
        where: Begins the message: the file and the key.

    Raises:
        DataError: If one of them is far from a rotation.
    """
    products = np.einsum("tij,tkj->tik", matrices, matrices)
    bad = (np.abs(products - np.eye(3)).max(axis=(1, 2)) > 0.05) | (np.linalg.det(matrices) < 0.0)
    if bad.any():
        raise DataError(f"{where} is no rotation in frame {int(np.argmax(bad))}")
    return Rotation.from_matrix(matrices).as_rotvec()


def of_two_rows(six: Array, *, where: str) -> Array:
    """Return the rotation vectors of rotations that are stored as the first two *rows* of their matrices.

    Args:
        six: The rows one after the other, not necessarily orthonormal, shape [T, 6].
        where: Begins the message: the file and the key.

    Returns:
        Rotation vectors [rad], shape [T, 3].

    Raises:
        DataError: If the rows of a frame are parallel or zero.
    """
    first, second = six[:, :3].astype(np.float64), six[:, 3:].astype(np.float64)
    sizes = np.linalg.norm(first, axis=1, keepdims=True)
    x = first / np.maximum(sizes, 1e-12)
    across = second - (x * second).sum(axis=1, keepdims=True) * x
    lengths = np.linalg.norm(across, axis=1, keepdims=True)
    bad = ((sizes < 1e-6) | (lengths < 1e-6))[:, 0]
    if bad.any():
        raise DataError(f"{where} has rows that are parallel or zero in frame {int(np.argmax(bad))}")
    y = across / lengths
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=1)).as_rotvec()


def seen_by_camera(turns: Array, places: Array) -> tuple[Array, Array]:
    """Return a moving head before a still camera for a still head before a moving camera.

    Args:
        turns: Rotations of the head's axes to the camera's, in OpenCV's camera axes, shape [T, 3, 3].
        places: The same for the head's origin [m], shape [T, 3].

    Returns:
        Rotation matrices [T, 3, 3] and translations [T, 3] of the head about its origin. The world's axes are those of
        the camera in OpenGL's convention: a head that looks into the camera does not turn.
    """
    return OPENGL_TO_OPENCV[:, None] * turns, OPENGL_TO_OPENCV * places
