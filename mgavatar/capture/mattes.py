"""Mattes in the alpha channels of a capture's images."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mgavatar.camera import Camera
from mgavatar.capture.pixels import has_alpha, read_matte


def images_with_mattes(images: Iterable[tuple[Path, Camera]]) -> frozenset[Path]:
    """Return the images whose alpha channel has a matte.

    Some programs write an opaque alpha channel into every image: the first one that has the channel tells.

    Args:
        images: Images without a mask of their own, and their cameras.

    Raises:
        DataError: If an image is missing or damaged.
    """
    candidates = {path: camera for path, camera in images if has_alpha(path)}
    if not candidates:
        return frozenset()
    path, camera = next(iter(candidates.items()))
    matte = read_matte(path, (camera.width, camera.height), alpha_only=True)
    return frozenset(candidates) if matte.min() < 255 else frozenset()
