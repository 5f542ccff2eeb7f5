"""Images and masks of a capture, decoded and checked."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from mgavatar.capture.pixels import read_matte, read_pixels
from mgavatar.capture.subject import SPLITS, Frame, Subject
from mgavatar.config import BACKGROUNDS
from mgavatar.errors import DataError

_CLOSE = 0.1
"""Difference in a channel up to which two colours count as one background."""

_MOST = 0.8
"""Share of the pixels behind a subject that are on one background: masks may be a little too tight."""

_SAMPLE = 16_384
"""Number of pixels of an image that its background is looked up in."""

log = logging.getLogger("mgavatar")


def read_images(frames: Sequence[Frame], *, size: tuple[int, int] | None = None, threads: int = 2) -> Tensor:
    """Decode the images of frames, and put them on the background of their frames.

    Images with a matte in their alpha channel are composited, and so are images that show something else behind their
    mask.

    Args:
        frames: The frames, in the order of the result.
        size: Width and height to resample to, by the exact mean over the area of each new pixel; the files' own if
            None, which must then agree.
        threads: Number of images that are decoded at a time.

    Returns:
        Images, shape [N, 3, H, W], uint8, on the CPU.

    Raises:
        DataError: If a file is missing, damaged or not as large as its camera says, or if the sizes
            differ and no ``size`` is given.
    """
    width, height = _common_size(frames, size)
    images = torch.empty((len(frames), 3, height, width), dtype=torch.uint8)

    def load(index: int) -> None:
        pixels = _resampled(_Picture.read(frames[index]).pixels, width, height)
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
        masks[index] = torch.from_numpy(_resampled(_read_mask(frames[index])[..., None], width, height)[..., 0])

    _for_all(load, len(frames), threads)
    return masks


def check_images(subject: Subject, *, threads: int = 2) -> None:
    """Decode every image and mask of every split once, so that a bad file is found before any work is done.

    The background is looked up where a mask is empty, or in the upper corners of an image without a mask. Logs what is
    composited, which images have no mask, and which of these are not on the stated background.

    Raises:
        DataError: For the first bad file, in the order of the splits and frames, and if all images are on another
            background with a name than ``subject`` states.
    """
    frames = [frame for split in SPLITS for frame in subject.frames[split]]
    found: list[_Behind | None] = [None] * len(frames)

    def check(index: int) -> None:
        found[index] = _Picture.read(frames[index]).behind

    _for_all(check, len(frames), threads)
    _check_backgrounds(subject, [(frame, look) for frame, look in zip(frames, found, strict=True) if look is not None])
    _warn_of_missing_masks(subject)


def without_bad_images(subject: Subject, *, threads: int = 2) -> Subject:
    """Return a capture without the frames whose image or mask cannot be decoded; logs their names.

    Raises:
        DataError: If no training image is left.
    """
    frames = [frame for split in SPLITS for frame in subject.frames[split]]
    errors: list[DataError | None] = [None] * len(frames)

    def check(index: int) -> None:
        try:
            _Picture.read(frames[index])
        except DataError as error:
            errors[index] = error

    _for_all(check, len(frames), threads)
    bad = {frame: error for frame, error in zip(frames, errors, strict=True) if error is not None}
    if not bad:
        return subject
    first = next(iter(bad.values()))
    kept = {split: tuple(frame for frame in subject.frames[split] if frame not in bad) for split in SPLITS}
    if not kept["train"]:
        raise DataError(f"{first}; and no training image is better")
    log.warning("%s: %d images are left out, the first because of %s", subject.root, len(bad), first)
    return replace(subject, frames=kept)


@dataclass(frozen=True)
class _Behind:
    """Colours behind the subject in an image as it was stored.

    Attributes:
        color: The median, RGB in 0..1.
        is_plain: Nearly all pixels have this colour.
        is_off: Many pixels have another colour than the stated background.
        is_composited: The image's mask or alpha channel has put it on the stated background.
    """

    color: np.ndarray
    is_plain: bool
    is_off: bool
    is_composited: bool

    @property
    def name(self) -> str | None:
        """Return the name of a known background, or None for any other colour."""
        known = (name for name, value in BACKGROUNDS.items() if _is_close(self.color, np.array(value)))
        return next(known, None) if self.is_plain else None

    @property
    def flag(self) -> str:
        """Return the value of ``--background`` for this colour."""
        return self.name or ",".join(str(value) for value in np.rint(255.0 * self.color).astype(int))


@dataclass(frozen=True)
class _Picture:
    """An image on the stated background, shape [H, W, 3], uint8, and what was behind the subject before, if known."""

    pixels: np.ndarray
    behind: _Behind | None

    @staticmethod
    def read(frame: Frame) -> _Picture:
        """Decode an image, and composite it if its alpha channel or its mask says that this is needed."""
        size = (frame.camera.width, frame.camera.height)
        pixels = read_pixels(frame.image_path, size)
        if pixels.shape[2] == 4:
            alpha, pixels = pixels[..., 3], pixels[..., :3]
            if alpha.min() < 255:
                return _Picture(_blended(pixels, alpha, frame.background), None)
        elif pixels.shape[2] == 1:
            pixels = np.broadcast_to(pixels, (*pixels.shape[:2], 3))
        if frame.mask_path is None:
            corner = max(1, pixels.shape[1] // 16)
            corners = np.concatenate([pixels[:corner, :corner], pixels[:corner, -corner:]]).reshape(-1, 3)
            return _Picture(pixels, _behind(corners, frame.background, masked=False))
        matte = _read_mask(frame)
        look = _behind(_outside(pixels, matte), frame.background, masked=True)
        if look is None or not look.is_composited:
            return _Picture(pixels, look)
        if look.is_plain:
            return _Picture(_moved(pixels, matte, look.color, frame.background), look)
        return _Picture(_blended(pixels, matte, frame.background), look)


def _outside(pixels: np.ndarray, matte: np.ndarray) -> np.ndarray:
    """Return a sample of the pixels where the matte is empty, shape [N, 3]."""
    step = max(1, math.isqrt(matte.size // _SAMPLE))
    return pixels[::step, ::step][matte[::step, ::step] == 0]


def _behind(colors: np.ndarray, background: tuple[float, float, float], *, masked: bool) -> _Behind | None:
    """Judge a sample of colours behind the subject, shape [N, 3], uint8; None if there are none."""
    if not len(colors):
        return None
    median = np.median(colors, axis=0)
    stated = 255.0 * np.array(background)
    plain = float(_close_share(colors, median)) > _MOST
    off = float(_close_share(colors, stated)) < _MOST
    return _Behind(median / 255.0, plain, off, masked and off)


def _close_share(colors: np.ndarray, color: np.ndarray) -> float:
    return float((np.abs(colors - color).max(axis=1) <= 255.0 * _CLOSE).mean())


def _blended(pixels: np.ndarray, matte: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """Composite straight colours on a background."""
    alpha = matte[..., None].astype(np.float32) / 255.0
    return np.rint(alpha * pixels + (1.0 - alpha) * (255.0 * np.array(background, np.float32))).astype(np.uint8)


def _moved(
    pixels: np.ndarray, matte: np.ndarray, old: np.ndarray, background: tuple[float, float, float]
) -> np.ndarray:
    """Exchange a plain background: its share of a pixel on the outline, which is known, is exchanged with it."""
    clear = 1.0 - matte[..., None].astype(np.float32) / 255.0
    change = 255.0 * (np.array(background, np.float32) - old.astype(np.float32))
    return np.rint(pixels + clear * change).clip(0.0, 255.0).astype(np.uint8)


def _check_backgrounds(subject: Subject, seen: Sequence[tuple[Frame, _Behind]]) -> None:
    """Refuse a capture that is on another background with a name; say what is composited, and what should be.

    Images without masks may show a room: of them only plain backgrounds count.
    """
    off = [(frame, look) for frame, look in seen if look.is_off and (look.is_composited or look.is_plain)]
    if not off:
        return
    frame, look = off[0]
    same = len(off) == len(seen) and all(other.is_plain and _is_close(other.color, look.color) for _, other in off)
    stated = _shown(subject.background)
    if same and look.name is not None:
        raise DataError(
            f"{subject.root}: the images are on {look.name}, not on the stated background (RGB {stated}), for example "
            f"{frame.image_path}; give --background {look.name}"
        )
    keep = f"; --background {look.flag} would keep theirs" if same else ""
    if composited := [(frame, look) for frame, look in off if look.is_composited]:
        frame, look = composited[0]
        log.warning(
            "%s: %d of %d images show something else than the stated background behind the subject, for example %s "
            "(RGB %s); they are composited on it (RGB %s) with their masks%s",
            subject.root,
            len(composited),
            len(seen),
            frame.image_path,
            _shown(look.color),
            stated,
            keep,
        )
    if plain := [(frame, look) for frame, look in off if not look.is_composited]:
        frame, look = plain[0]
        flag = "" if look.name is None and not same else f", or give --background {look.flag}"
        log.warning(
            "%s: %d of %d images are not on the stated background (RGB %s), for example %s (RGB %s), and have no masks "
            "to composite them with; give them masks%s%s",
            subject.root,
            len(plain),
            len(seen),
            stated,
            frame.image_path,
            _shown(look.color),
            flag,
            "" if same or not flag else " if that is the background of the others",
        )


def _warn_of_missing_masks(subject: Subject) -> None:
    """Log the training images that lack a mask where others have one."""
    frames = subject.frames["train"]
    missing = [frame for frame in frames if frame.mask_path is None]
    if 0 < len(missing) < len(frames):
        log.warning(
            "%s: %d of %d training images have no mask, for example %s; the masks of the others are used, and these "
            "keep their background",
            subject.root,
            len(missing),
            len(frames),
            missing[0].image_path,
        )


def _shown(color: np.ndarray) -> str:
    return ", ".join(f"{value:.3g}" for value in color)


def _is_close(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a - b).max() <= _CLOSE)


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


def _read_mask(frame: Frame) -> np.ndarray:
    """Decode a frame's foreground alpha, shape [H, W], uint8."""
    if frame.mask_path is None:
        raise DataError(f"{frame.image_path}: this frame has no foreground mask (fg_mask_path)")
    size = (frame.camera.width, frame.camera.height)
    return read_matte(frame.mask_path, size, alpha_only=frame.mask_path == frame.image_path)


def _resampled(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resample to exact area means: old pixels that a new one covers in part count in part, at any ratio of sizes."""
    old_height, old_width, channels = pixels.shape
    if (old_width, old_height) == (width, height):
        return np.require(pixels, requirements=["C", "W"])  # torch wants to be able to write
    # A sparse matrix multiplies from the left, along the first axis: rows first, then the same for columns, which a
    # transpose puts in their place.
    rows = _area_weights(old_height, height) @ pixels.reshape(old_height, -1).astype(np.float32)
    columns = rows.reshape(height, old_width, channels).transpose(1, 0, 2).reshape(old_width, -1)
    small = (_area_weights(old_width, width) @ columns).reshape(width, height, channels).transpose(1, 0, 2)
    return np.ascontiguousarray(np.rint(small).clip(0.0, 255.0).astype(np.uint8))


@functools.lru_cache(maxsize=16)
def _area_weights(n_old: int, n_new: int) -> scipy.sparse.csr_array:
    """Return the share of each old pixel in each new one along an axis, shape [n_new, n_old]; rows sum to 1."""
    # New pixel i covers edges[i] to edges[i + 1] in old pixels, and shares with old pixel j what lies in j to j + 1.
    edges = np.arange(n_new + 1) * (n_old / n_new)
    old = np.arange(n_old)
    overlap = np.minimum(edges[1:, None], old + 1) - np.maximum(edges[:-1, None], old)
    return scipy.sparse.csr_array((overlap.clip(0.0) * (n_new / n_old)).astype(np.float32))
