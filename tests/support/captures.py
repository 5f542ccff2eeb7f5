"""A tiny capture in the layout of VHAP, for tests of whatever reads one."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from mgavatar.camera import look_at

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_capture(
    root: Path,
    *,
    n_cameras: int = 3,
    n_timesteps: int = 4,
    size: tuple[int, int] = (24, 32),
    n_shape: int = 12,
    n_expr: int = 10,
    masks: bool = True,
    seed: int = 0,
) -> Path:
    """Write a valid capture, split as VHAP does: the last camera is val, the last 30 % of the timesteps are test.

    Each image is a coloured ellipse on white, another one for every camera and timestep.

    Args:
        root: Folder to make.
        n_cameras: On an arc of 1 m around the head; with one camera val is empty.
        n_timesteps: Number of tracked frames.
        size: Width and height of the images [px].
        n_shape: Identity coefficients in the parameter files.
        n_expr: Expression coefficients in the parameter files.
        masks: Whether to write foreground masks.
        seed: Of the parameters.

    Returns:
        ``root``.
    """
    for folder in ("images", "flame_param", *(("fg_masks",) if masks else ())):
        (root / folder).mkdir(parents=True)
    rng = np.random.default_rng(seed)
    shape = rng.normal(0.0, 0.5, n_shape).astype(np.float32)
    frames = []
    for timestep in range(n_timesteps):
        params = made_up_params(rng, shape, n_expr)
        np.savez(root / f"flame_param/{timestep:05d}.npz", **params)
        frames += [_frame(root, timestep, camera, n_cameras, size, masks) for camera in range(n_cameras)]
    np.savez(root / "canonical_flame_param.npz", **{**params, "jaw_pose": np.array([[0.3, 0.0, 0.0]])})
    n_train = math.ceil(0.7 * n_timesteps)
    held_out = n_cameras - 1 if n_cameras > 1 else None
    known = [frame for frame in frames if frame["timestep_index"] < n_train]
    write_transforms(root, "train", [frame for frame in known if frame["camera_index"] != held_out])
    write_transforms(root, "val", [frame for frame in known if frame["camera_index"] == held_out])
    write_transforms(root, "test", [frame for frame in frames if frame["timestep_index"] >= n_train])
    return root


def write_transforms(root: Path, split: str, frames: list[dict]) -> None:
    """Write ``transforms_{split}.json``."""
    (root / f"transforms_{split}.json").write_text(json.dumps({"frames": frames}))


def made_up_params(rng: np.random.Generator, shape: np.ndarray, n_expr: int) -> dict[str, np.ndarray]:
    """Parameters of one timestep in VHAP's keys and shapes."""
    widths = {"expr": n_expr, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
    rows = {key: rng.normal(0.0, 0.02, (1, width)).astype(np.float32) for key, width in widths.items()}
    return {"shape": shape, **rows}


def _frame(root: Path, timestep: int, camera: int, n_cameras: int, size: tuple[int, int], masks: bool) -> dict:
    """One frame's entry; writes its image and mask."""
    width, height = size
    name = f"{timestep:05d}_{camera:02d}.png"
    y, x = np.mgrid[0:height, 0:width]
    inside = ((x - width / 2) / (0.3 * width)) ** 2 + ((y - height / 2) / (0.4 * height)) ** 2 < 1.0
    image = np.full((height, width, 3), 255, np.uint8)
    image[inside] = (180 - 10 * camera, 120 + 8 * timestep, 90)
    Image.fromarray(image).save(root / "images" / name)
    if masks:
        Image.fromarray(np.where(inside, 255, 0).astype(np.uint8)).save(root / "fg_masks" / name)
    angle = 0.0 if n_cameras == 1 else np.linspace(-0.5, 0.5, n_cameras)[camera]
    position = np.array([np.sin(angle), 0.0, np.cos(angle)])
    view = look_at(position, np.zeros(3), focal=2.0 * height, width=width, height=height)
    frame = {
        "timestep_index": timestep,
        "camera_index": camera,
        "camera_id": f"{camera:02d}",
        "cx": width / 2,
        "cy": height / 2,
        "fl_x": 2.0 * height,
        "fl_y": 2.0 * height,
        "w": width,
        "h": height,
        "camera_angle_x": 2.0 * math.atan(width / (4.0 * height)),
        "transform_matrix": (np.linalg.inv(view.viewmat) @ OPENGL).tolist(),
        "file_path": f"images/{name}",
        "flame_param_path": f"flame_param/{timestep:05d}.npz",
    }
    return {**frame, "fg_mask_path": f"fg_masks/{name}"} if masks else frame
