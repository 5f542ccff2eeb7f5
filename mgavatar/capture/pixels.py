"""Image files as upright 8-bit pixels, whatever kind of file a tracker or a matting tool writes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import kornia_rs.io
import numpy as np
from PIL import Image, ImageOps

from mgavatar.errors import DataError
from mgavatar.files import existing_file, foreign_content, one_line

T = TypeVar("T")

_ORIENTATION = 0x0112
"""EXIF's tag for the way in which a camera was held."""

_QUARTER_TURNS = range(5, 9)
"""Orientations that exchange width and height."""


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image as it is shown, from its header.

    Raises:
        DataError: If the file is missing or no image.
    """
    return _opened(path, _upright_size)


def has_alpha(path: Path) -> bool:
    """Return True if an image has an alpha channel or a transparent colour, by its header.

    Raises:
        DataError: If the file is missing or no image.
    """
    return _opened(path, lambda image: image.has_transparency_data)


def read_pixels(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Decode an image.

    Args:
        path: The file.
        size: Width and height that the image's camera has [px].

    Returns:
        Pixels, shape [H, W, C], uint8; C is 1 (grey), 3, or 4 with alpha.

    Raises:
        DataError: If the file is missing or damaged, or has another size.
    """
    values = _decoded(path, size)
    if values.dtype == np.uint16:
        return ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)
    return values if values.dtype == np.uint8 else _as_bytes(values)


def read_matte(path: Path, size: tuple[int, int], *, alpha_only: bool = False) -> np.ndarray:
    """Decode a foreground mask.

    The matte is the alpha channel if that is not opaque, else the brightest channel. Masks of two values, such as 0
    and 1, are scaled to 0 and 255.

    Args:
        path: The file.
        size: Width and height that the image's camera has [px].
        alpha_only: The file is a picture: without transparent pixels, all of it is subject.

    Returns:
        Foreground alpha, 255 = subject, shape [H, W], uint8.

    Raises:
        DataError: If the file is missing or damaged, or has another size.
    """
    values = _decoded(path, size)
    if values.shape[2] == 4:
        alpha = values[..., 3]
        full = np.iinfo(values.dtype).max
        values = alpha[..., None] if alpha.min() < full or alpha_only else values[..., :3]
    elif alpha_only:
        return np.full(values.shape[:2], 255, np.uint8)
    matte = values.max(axis=2)
    if matte.dtype == np.uint8 and matte.max() == 255:
        return matte
    is_binary = not ((matte != 0) & (matte != matte.max())).any()
    return np.where(matte > 0, 255, 0).astype(np.uint8) if is_binary else _as_bytes(matte)


def _as_bytes(values: np.ndarray) -> np.ndarray:
    """Scale values to 0..255 by the range that they are in: 0 to 1, those of 8 bits in any type, or of 16 bits."""
    peak = values.max()
    full = next((full for full in (1.0, 255.0) if peak <= full), 65535.0)
    return np.rint(values.astype(np.float32).clip(0.0, full) * (255.0 / full)).astype(np.uint8)


def _opened(path: Path, read: Callable[[Image.Image], T]) -> T:
    """Open an image, of which ``read`` may want no more than the header."""
    existing_file(path)
    try:
        with Image.open(path) as image:
            return read(image)
    except DataError:
        raise
    except Exception as error:  # Pillow and kornia_rs raise bare exceptions of many kinds
        reason = foreign_content(path) or one_line(error) or type(error).__name__
        raise DataError(f"{path}: not a readable image ({reason})") from error


def _orientation(image: Image.Image) -> int:
    if image.format == "PNG" and "exif" not in image.info:
        return 1  # Pillow would decode the whole image to look for the tag behind it
    return int(image.getexif().get(_ORIENTATION, 1))


def _upright_size(image: Image.Image) -> tuple[int, int]:
    width, height = image.size
    return (height, width) if _orientation(image) in _QUARTER_TURNS else (width, height)


def _decoded(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Pixels of a file, shape [H, W, C], in the type that it has, if it is as large as ``size``."""

    def decode(image: Image.Image) -> np.ndarray:
        upright = _upright_size(image)
        if size not in (upright, image.size):
            raise DataError(
                f"{path} is {upright[0]}x{upright[1]} but the capture's transforms file says {size[0]}x{size[1]}; "
                "scale the images and w, h, fl_x, fl_y, cx, cy alike"
            )
        # A tracker that took no notice of the tag calibrated the image as it is stored: its size says so.
        return _values(path, image, turn=size == upright and _orientation(image) != 1)

    return _opened(path, decode)


def _values(path: Path, image: Image.Image, *, turn: bool) -> np.ndarray:
    """Decode with the fastest decoder that gets this kind of file right.

    kornia_rs is three times as fast as Pillow for PNG, but returns the indices of palette images and takes no notice
    of truncated JPEG files and of orientations.
    """
    if image.format == "PNG" and image.mode in ("RGB", "RGBA", "L") and not turn:
        values = kornia_rs.io.read_image(str(path))
    else:
        upright = ImageOps.exif_transpose(image) if turn else image
        plain = upright.mode in ("RGB", "RGBA", "L", "I", "F") or upright.mode.startswith("I;16")
        if not plain:
            upright = upright.convert(
                "RGBA" if upright.has_transparency_data else "L" if upright.mode == "1" else "RGB"
            )
        values = np.nan_to_num(np.asarray(upright))
    return values.reshape(*values.shape[:2], -1)
