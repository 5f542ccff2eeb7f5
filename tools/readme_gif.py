"""Draw a driven avatar beside its mesh, coloured by normals, as a small GIF that loops.

    python tools/readme_gif.py --avatar demo_out/run --driving demo_out/driving.npz --out docs/driven.gif

The README's was made with ``--camera train:11``, the camera of the demo's capture that is at the height of the eyes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from command_line import run
from PIL import Image
from scipy.spatial import KDTree

from mgavatar.avatar import Avatar
from mgavatar.camera import Camera
from mgavatar.driving.cameras import cameras_of
from mgavatar.driving.read import read_driving
from mgavatar.driving.retarget import poses_of
from mgavatar.driving.writers import kind_of, to_bytes
from mgavatar.errors import DataError
from mgavatar.files import atomic_write
from mgavatar.head.params import Pose
from mgavatar.reporting.pictures import beside, normal_picture

Pair = tuple[np.ndarray, np.ndarray]
"""The avatar and its mesh, each of shape [H, W, 3], uint8."""

WHITE = 255
"""The background, which must not blend with other light colours."""

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
    colors: int = 254,
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
        colors: Colours of the one palette of all frames, at most 254; one more is transparent, where nothing changes.
        overwrite: Replace a GIF that is there already.

    Returns:
        Name, size and number of frames of the GIF.

    Raises:
        DataError: If an input cannot be read, ``out`` cannot be written, or a number is out of range.
    """
    if not (32 <= height <= 4096 and step >= 1 and 4 <= colors <= 254):
        raise DataError("--height must be 32 to 4096, --step at least 1, and --colors 4 to 254")
    if kind_of(out, overwrite=overwrite) != "gif":
        raise DataError(f"{out}: give a name that ends in .gif")
    loaded, motion = Avatar.load(avatar), read_driving(driving)
    poses = poses_of(loaded, motion, frames=slice(None, None, step))
    views = cameras_of(loaded, camera, n_frames=len(poses), size=(2 * height, height))
    pairs = cropped([picture_pair(loaded, pose, view) for pose, view in zip(poses, views, strict=True)])
    save_gif(out, pairs, seconds_per_frame=step / motion.fps, colors=colors)
    with Image.open(out) as gif:
        width = gif.width
    return f"{out}: {width} x {height}, {len(pairs)} frames, {out.stat().st_size / 1e6:.2f} MB"


def picture_pair(avatar: Avatar, pose: Pose, view: Camera) -> Pair:
    """Return the avatar and its mesh as one camera sees them, each of shape [H, W, 3], uint8."""
    image = to_bytes(avatar.render(pose, view, torch.ones(3)).image)
    return image, normal_picture(avatar.verts(pose), avatar.head.body.faces, view)


def cropped(pairs: Sequence[Pair]) -> list[Pair]:
    """Cut all pictures to the columns that any of them uses, with a margin.

    Raises:
        DataError: If all pictures are empty.
    """
    used = np.any([(picture < WHITE).any(axis=(0, 2)) for pair in pairs for picture in pair], axis=0)
    if not used.any():
        raise DataError("the camera sees nothing of the avatar; choose another one")
    first, last = np.flatnonzero(used)[[0, -1]]
    columns = slice(max(0, first - MARGIN), last + 1 + MARGIN)
    return [(image[:, columns], mesh[:, columns]) for image, mesh in pairs]


def save_gif(path: Path, pairs: Sequence[Pair], *, seconds_per_frame: float, colors: int) -> None:
    """Write pairs of pictures side by side as a GIF with one palette and without dithering, which would flicker.

    Raises:
        DataError: If the file cannot be written.
    """
    panels = [panel_palette(panel, (colors - 1) // 2) for panel in zip(*pairs, strict=True)]
    palette = np.concatenate([np.full((1, 3), WHITE, np.uint8), *panels])
    nearest = KDTree(palette)
    frames = []
    for pair in pairs:
        picture = beside(pair)
        frame = Image.fromarray(nearest.query(picture)[1].astype(np.uint8), mode="P")
        frame.putpalette(palette.tobytes())
        frames.append(frame)
    hundredths = max(2, round(100 * seconds_per_frame))  # players show shorter delays as 10 hundredths
    with atomic_write(path) as file:
        frames[0].save(
            file, format="GIF", save_all=True, append_images=frames[1:], duration=10 * hundredths, loop=0, optimize=True
        )


def panel_palette(pictures: Sequence[np.ndarray], colors: int) -> np.ndarray:
    """Choose colours for all pictures of one panel, white aside, shape [at most ``colors``, 3], uint8.

    Each panel has its share of the palette, because the hues of the normals would leave few colours to the skin.
    """
    pixels = np.concatenate([picture.reshape(-1, 3) for picture in pictures[:: max(1, len(pictures) // 8)]])
    sample = Image.fromarray(pixels[(pixels < WHITE).any(axis=1)][None])
    chosen = sample.quantize(colors, method=Image.Quantize.MEDIANCUT, kmeans=2).getpalette() or []
    return np.array(chosen[: 3 * colors], np.uint8).reshape(-1, 3)


if __name__ == "__main__":
    run(readme_gif)
