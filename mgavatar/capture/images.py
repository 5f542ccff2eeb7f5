"""Images and masks of a capture, decoded and checked."""

from __future__ import annotations

import functools
import logging
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import kornia_rs.io
import numpy as np
import scipy.sparse
import torch
from PIL import Image
from torch import Tensor

from mgavatar.capture.subject import BACKGROUNDS, SPLITS, Frame, Subject
from mgavatar.config import Background
from mgavatar.errors import DataError
from mgavatar.files import existing_file, one_line

log = logging.getLogger("mgavatar")


def read_images(frames: Sequence[Frame], *, size: tuple[int, int] | None = None, threads: int = 2) -> Tensor:
    """Decode the images of frames.

    Args:
        frames: The frames, in the order of the result.
        size: Width and height to resample to, by the exact mean over the area of each new pixel; the files' own if
            None, which must then agree.
        threads: Number of images that are decoded at a time.

    Returns:
        Images, shape [N, 3, H, W], uint8, on the CPU.

    Raises:
        DataError: If a file is missing, damaged, transparent or not as large as its camera says, or if the sizes
            differ and no ``size`` is given.
    """
    width, height = _common_size(frames, size)
    images = torch.empty((len(frames), 3, height, width), dtype=torch.uint8)

    def load(index: int) -> None:
        pixels = _resampled(_read_image(frames[index]), width, height)
        images[index] = torch.from_numpy(pixels).permute(2, 0, 1)

    _for_all(load, len(frames), threads)
    return images


def read_masks(frames: Sequence[Frame], *, size: tuple[int, int] | None = None, threads: int = 2) -> Tensor:
    """Decode the foreground masks of frames; as ``read_images``.

    Returns:
        Foreground alpha, 255 = subject, shape [N, H, W], uint8, on the CPU.

    Raises:
        DataError: As ``read_images``, and if a frame has no mask.
    """
    width, height = _common_size(frames, size)
    masks = torch.empty((len(frames), height, width), dtype=torch.uint8)

    def load(index: int) -> None:
        masks[index] = torch.from_numpy(_resampled(_read_mask(frames[index]), width, height)[..., 0])

    _for_all(load, len(frames), threads)
    return masks


def check_images(subject: Subject, *, threads: int = 2) -> None:
    """Decode every image and mask of every split once, so that a bad file is found before any work is done.

    The background is looked up where a mask is empty, or in the upper corners of an image without a mask. Logs a
    warning if that of some images is not the stated one.

    Raises:
        DataError: For the first bad file, in the order of the splits and frames, and if all images are on another
            background than ``subject`` states.
    """
    frames = [frame for split in SPLITS for frame in subject.frames[split]]
    found: list[np.ndarray | None] = [None] * len(frames)

    def check(index: int) -> None:
        found[index] = _background(frames[index])

    _for_all(check, len(frames), threads)
    _check_backgrounds(subject, frames, found)


def _background(frame: Frame) -> np.ndarray | None:
    """Return the colour behind the subject, RGB in 0..1, shape [3], or None where the subject covers everything."""
    pixels = _read_image(frame)
    if frame.mask_path is not None:
        behind = pixels[_read_mask(frame)[..., 0] == 0]
    else:
        corner = max(1, pixels.shape[1] // 16)
        behind = np.concatenate([pixels[:corner, :corner], pixels[:corner, -corner:]]).reshape(-1, 3)
    return np.median(behind, axis=0) / 255.0 if len(behind) else None


def _check_backgrounds(subject: Subject, frames: Sequence[Frame], found: Sequence[np.ndarray | None]) -> None:
    """Refuse a capture that is on another background than stated; warn if only some of its images are.

    Images without masks may show a room: of them only those on another known background count.
    """
    seen = [(frame, color) for frame, color in zip(frames, found, strict=True) if color is not None]
    off = [(frame, _name_of(color)) for frame, color in seen if not _is_close(color, subject.background)]
    off = [(frame, name) for frame, name in off if frame.mask_path is not None or name is not None]
    if not off:
        return
    name, count = Counter(name for _, name in off).most_common(1)[0]
    stated = ", ".join(f"{value:g}" for value in subject.background)
    if name is not None and count == len(seen):
        raise DataError(
            f"{subject.root}: the images are on {name}, not on the stated background (RGB {stated}), for example "
            f"{off[0][0].image_path}; give --background {name}"
        )
    log.warning(
        "%s: %d of %d images are not on the stated background (RGB %s), for example %s; composite them on it with "
        "their masks%s",
        subject.root,
        len(off),
        len(frames),
        stated,
        off[0][0].image_path,
        "" if name is None else f", or give --background {name} if that is the background of the others",
    )


def _name_of(color: np.ndarray) -> Background | None:
    """Return the name of a known background, or None for any other colour."""
    return next((name for name, known in BACKGROUNDS.items() if _is_close(color, np.array(known))), None)


def _is_close(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a - b).max() <= 0.1)


def _for_all(work: Callable[[int], None], count: int, threads: int) -> None:
    """Run ``work`` for every index; the error of the lowest index is raised, and nothing new is begun after it."""
    with ThreadPoolExecutor(max(1, threads)) as pool:
        futures = [pool.submit(work, index) for index in range(count)]
        try:
            for future in futures:
                future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _common_size(frames: Sequence[Frame], size: tuple[int, int] | None) -> tuple[int, int]:
    if size is not None:
        return size
    if not frames:
        return 0, 0
    width, height = frames[0].camera.width, frames[0].camera.height
    for frame in frames:
        if (frame.camera.width, frame.camera.height) != (width, height):
            raise DataError(
                f"{frames[0].image_path} is {width}x{height}, but {frame.image_path} is "
                f"{frame.camera.width}x{frame.camera.height}; give one image size to resample them to"
            )
    return width, height


def _read_image(frame: Frame) -> np.ndarray:
    """Pixels of a frame's image, shape [H, W, 3], uint8."""
    pixels = _decode(frame.image_path, frame)
    channels = pixels.shape[2]
    if channels == 4:
        if pixels[..., 3].min() < 255:
            raise DataError(f"{frame.image_path}: has transparent pixels; composite it on the capture's background")
        pixels = pixels[..., :3]
    return np.broadcast_to(pixels, (*pixels.shape[:2], 3)) if channels == 1 else pixels


def _read_mask(frame: Frame) -> np.ndarray:
    """Decode a frame's foreground alpha, shape [H, W, 1], uint8."""
    if frame.mask_path is None:
        raise DataError(f"{frame.image_path}: this frame has no foreground mask (fg_mask_path)")
    return _decode(frame.mask_path, frame)[..., :1]


def _decode(path: Path, frame: Frame) -> np.ndarray:
    """Pixels of a file, shape [H, W, channels], uint8, if it is as large as the frame's camera says."""
    camera = frame.camera
    existing_file(path)
    try:
        with Image.open(path) as header:  # reads no pixels yet
            fits = header.size == (camera.width, camera.height)
            pixels = _pixels(path, header) if fits else np.empty((header.height, 0, 0))
            found = header.size
    except Exception as error:  # Pillow and kornia_rs raise bare exceptions of many kinds
        raise DataError(f"{path}: not a readable image ({one_line(error) or type(error).__name__})") from error
    if not fits:
        raise DataError(
            f"{path} is {found[0]}x{found[1]} but the capture's transforms file says {camera.width}x{camera.height}; "
            "scale the images and w, h, fl_x, fl_y, cx, cy alike"
        )
    return pixels


def _pixels(path: Path, image: Image.Image) -> np.ndarray:
    """Decode with the fastest decoder that gets this kind of file right.

    kornia_rs is three times as fast as Pillow for PNG, but returns the indices of palette images and takes no notice
    of truncated JPEG files.
    """
    if image.format == "PNG" and image.mode in ("RGB", "RGBA", "L"):
        pixels = kornia_rs.io.read_image(str(path))
    else:
        if image.mode not in ("RGB", "RGBA", "L") and not image.mode.startswith("I;16"):
            image = image.convert("RGBA" if image.has_transparency_data else "L" if image.mode == "1" else "RGB")
        pixels = np.asarray(image)
    if pixels.dtype.itemsize == 2:
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    return pixels.reshape(*pixels.shape[:2], -1)


def _resampled(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Exact area means: pixels that a new pixel covers in part count in part, at any ratio of sizes."""
    old_height, old_width, channels = pixels.shape
    if (old_width, old_height) == (width, height):
        return np.require(pixels, requirements=["C", "W"])  # torch wants to be able to write
    rows = _area_weights(old_height, height) @ pixels.reshape(old_height, -1).astype(np.float32)
    columns = rows.reshape(height, old_width, channels).transpose(1, 0, 2).reshape(old_width, -1)
    small = (_area_weights(old_width, width) @ columns).reshape(width, height, channels).transpose(1, 0, 2)
    return np.ascontiguousarray(np.rint(small).clip(0.0, 255.0).astype(np.uint8))


@functools.lru_cache(maxsize=16)
def _area_weights(n_old: int, n_new: int) -> scipy.sparse.csr_array:
    """Share of each old pixel in each new one along an axis, [n_new, n_old]; rows sum to 1."""
    edges = np.arange(n_new + 1) * (n_old / n_new)
    old = np.arange(n_old)
    overlap = np.minimum(edges[1:, None], old + 1) - np.maximum(edges[:-1, None], old)
    return scipy.sparse.csr_array((overlap.clip(0.0) * (n_new / n_old)).astype(np.float32))
