"""Draw a driven avatar beside its mesh, coloured by normals, as a small GIF that loops.

python tools/readme_gif.py --avatar demo_out/run --driving demo_out/driving.npz --out docs/driven.gif
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from command_line import run
from PIL import Image

from mgavatar.avatar import Avatar
from mgavatar.camera import Camera
from mgavatar.driving.cameras import cameras_of
from mgavatar.driving.motion import read_driving
from mgavatar.driving.retarget import poses_of
from mgavatar.driving.writers import kind_of, to_bytes
from mgavatar.errors import DataError
from mgavatar.files import atomic_write
from mgavatar.head.params import Pose
from mgavatar.reporting.pictures import beside, normal_picture

MARGIN = 8
"""Pixels that are kept around what is drawn."""


def readme_gif(
    *,
    avatar: Path,
    driving: Path,
    out: Path,
    camera: str = "mean",
    height: int = 320,
    step: int = 2,
    colors: int = 128,
    overwrite: bool = False,
) -> str:
    """Draw a driven avatar beside its mesh as a small GIF that loops.

    Args:
        avatar: The avatar, or the folder of its fit.
        driving: Motion, as for mgavatar render; the GIF loops without a jump if the motion does.
        out: The GIF.
        camera: Camera, as for mgavatar render.
        height: Height in pixels.
        step: Draw every step-th frame of the motion; the speed stays.
        colors: Colours of the one palette of all frames, at most 255.
        overwrite: Replace a GIF that is there already.

    Returns:
        Name, size and number of frames of the GIF.

    Raises:
        DataError: If an input cannot be read, ``out`` cannot be written, or a number is out of range.
    """
    if not (32 <= height <= 4096 and step >= 1 and 2 <= colors <= 255):
        raise DataError("--height must be 32 to 4096, --step at least 1, and --colors 2 to 255")
    if kind_of(out, overwrite=overwrite) != "gif":
        raise DataError(f"{out}: give a name that ends in .gif")
    loaded, motion = Avatar.load(avatar), read_driving(driving)
    poses = poses_of(loaded, motion, frames=slice(None, None, step))
    views = cameras_of(loaded, camera, n_frames=len(poses), size=(2 * height, height))
    pictures = cropped([picture_pair(loaded, pose, view) for pose, view in zip(poses, views, strict=True)])
    save_gif(out, pictures, seconds_per_frame=step / motion.fps, colors=colors)
    rows, columns, _ = pictures[0].shape
    return f"{out}: {columns} x {rows}, {len(pictures)} frames, {out.stat().st_size / 1e6:.2f} MB"


def picture_pair(avatar: Avatar, pose: Pose, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the avatar and its mesh as one camera sees them, each of shape [H, W, 3], uint8."""
    white = torch.ones(3)
    image = to_bytes(avatar.render(pose, view, white).image)
    return image, normal_picture(avatar.verts(pose), avatar.head.body.faces, view)


def cropped(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """Put each pair side by side, cut to the columns that any of the pictures uses."""
    used = np.any([(picture < 250).any(axis=(0, 2)) for pair in pairs for picture in pair], axis=0)
    if not used.any():
        raise DataError("the camera sees nothing of the avatar; choose another one")
    first, last = np.flatnonzero(used)[[0, -1]]
    columns = slice(max(0, first - MARGIN), last + 1 + MARGIN)
    return [beside([picture[:, columns] for picture in pair]) for pair in pairs]


def save_gif(path: Path, pictures: Sequence[np.ndarray], *, seconds_per_frame: float, colors: int) -> None:
    """Write pictures of one size as a GIF with one palette and without dithering, which would flicker.

    Pixels that do not change become transparent, so that they cost nothing. That takes one of the 256 colours.
    """
    images = [Image.fromarray(picture) for picture in pictures]
    sample = Image.fromarray(np.concatenate(pictures[:: max(1, len(pictures) // 8)]))
    palette = sample.quantize(colors, method=Image.Quantize.MEDIANCUT, kmeans=2)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    hundredths = max(2, round(100 * seconds_per_frame))  # players show shorter delays as 10 hundredths
    with atomic_write(path) as file:
        frames[0].save(
            file, format="GIF", save_all=True, append_images=frames[1:], duration=10 * hundredths, loop=0, optimize=True
        )


if __name__ == "__main__":
    run(readme_gif)
