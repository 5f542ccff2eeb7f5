"""Synthetic captures: ray-traced images of a person whom the head model cannot express, with exact ground truth.

They replace licensed data in trials, tests and the demo. The images come from a ray tracer and the poses from a
separate skinning in float64: no part of the method that is fitted to a capture takes part in making it.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mgavatar.camera import Camera
from mgavatar.capture.subject import SPLITS, Split
from mgavatar.errors import DataError
from mgavatar.files import check_writable, require_new_folder, writing
from mgavatar.head.find import BUILTIN, HEAD_MODEL_FILE, HEAD_MODEL_KEY
from mgavatar.head.load import save_head_model
from mgavatar.head.model import HeadModel
from mgavatar.head.params import MOTION_KEYS, HeadParams, pad_or_truncate
from mgavatar.head.procedural.build import build_head
from mgavatar.synthetic.motion import perform, tracked
from mgavatar.synthetic.person import Person, make_person
from mgavatar.synthetic.studio import Studio, front_camera, frontal_arc, held_out_camera, make_look, side_cameras

_TURN = math.radians(20)
"""Largest turn of the head to either side [rad]."""
_N_SHAPE, _N_EXPR = 300, 100
"""Widths of VHAP's ``shape`` and ``expr``; ``expr`` is wider for a head model with more expression directions."""
_SIDE_TIMESTEPS = 6
"""Largest number of training timesteps that the side cameras of a monocular capture see."""


def make_synthetic_capture(
    out: Path,
    *,
    cameras: int = 16,
    timesteps: int = 12,
    size: tuple[int, int] = (256, 256),
    seed: int = 0,
    monocular: bool = False,
    head: HeadModel | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Ray-trace a capture of a synthetic person in the layout of VHAP and GaussianAvatars.

    The person has a random identity, hair, clothed shoulders far wider than the bust, and muscles that move. The
    tracked parameters have none of them: ``shape`` is zero, and the motion has the errors of a tracker.

    Training uses the first 70 % of the timesteps, ``val`` is one camera near the front at those timesteps, and ``test``
    all cameras at the others. ``ground_truth/truth.npz`` holds the exact geometry and motion. The transforms files name
    the head model, and ``head_model.npz`` holds it unless it is the built-in one: do not pass on such a capture if the
    licence of its head model forbids it. The same arguments write the same bytes.

    A monocular capture has one camera, number 0, for training and ``test``; it sees the head turn 20 degrees to either
    side. Its ``val`` shows what that camera does not see, from cameras 1 and 2 at 60 degrees to either side, at six of
    the training timesteps.

    Args:
        out: Folder to make; it must be new or empty.
        cameras: Number of cameras, in two rows on a frontal arc; unused for a monocular capture.
        timesteps: Number of frames per camera.
        size: Image width and height [px].
        seed: Seed of the person and of the motion.
        monocular: Make a monocular capture.
        head: Head model of the identity and the motion; None is the built-in head.
        progress: Called after each image with the number of images made and their total.

    Returns:
        ``out``.

    Raises:
        DataError: If ``out`` is not empty or cannot be made, or a number is too small.
    """
    out = Path(out)
    _check(out, 1 if monocular else cameras, timesteps, size, monocular=monocular)
    head = build_head() if head is None else head
    rng = np.random.default_rng(seed)
    person = make_person(head, rng)
    studio = Studio(person, make_look(person, rng))
    motion = perform(head, timesteps, rng, turn=_TURN)
    views = [front_camera(size), *side_cameras(size)] if monocular else frontal_arc(cameras, size)
    partial = out.with_name(f".{out.name}.partial-{os.getpid()}")
    members = _monocular_splits(len(views), timesteps) if monocular else _splits(len(views), timesteps)
    try:
        with writing(out):
            partial.mkdir(parents=True)
            truth = _shoot_all(partial, studio, motion, views, members, progress)
            _write_params(partial, head, tracked(motion, rng))
            _write_transforms(partial, views, members, head_model=_write_head_model(partial, head))
            _write_truth(partial, person, motion, seed, *truth)
            if out.exists():
                out.rmdir()
            partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return out


def _check(out: Path, cameras: int, timesteps: int, size: tuple[int, int], *, monocular: bool) -> None:
    require_new_folder(out)
    if cameras < 2 and not monocular:
        raise DataError(
            f"{out}: {cameras} cameras leave none to hold out; ask for 2 or more, or for a monocular capture"
        )
    if timesteps < 2:
        raise DataError(f"{out}: {timesteps} timesteps cannot be split into training and test; ask for 2 or more")
    if min(size) < 8:
        raise DataError(f"{out}: images of {size[0]} x {size[1]} pixels show nothing; ask for 8 x 8 or more")
    check_writable(out, kind="folder")


Members = dict[Split, set[tuple[int, int]]]
"""Timestep and camera of the images of each split."""


def _splits(n_cameras: int, timesteps: int) -> Members:
    """Hold out one camera for ``val`` and the last timesteps for ``test``."""
    n_train = _n_train(timesteps)
    every = {(t, c) for t in range(timesteps) for c in range(n_cameras)}
    test = {(t, c) for t, c in every if t >= n_train}
    val = {(t, c) for t, c in every - test if c == held_out_camera(n_cameras)}
    return {"train": every - test - val, "val": val, "test": test}


def _monocular_splits(n_cameras: int, timesteps: int) -> Members:
    """Use camera 0 for training and ``test``, the others for ``val``."""
    n_train = _n_train(timesteps)
    chosen = np.linspace(0, n_train - 1, min(_SIDE_TIMESTEPS, n_train)).round().astype(int).tolist()
    return {
        "train": {(t, 0) for t in range(n_train)},
        "val": {(t, c) for t in chosen for c in range(1, n_cameras)},
        "test": {(t, 0) for t in range(n_train, timesteps)},
    }


def _n_train(timesteps: int) -> int:
    return min(math.ceil(0.7 * timesteps), timesteps - 1)


def _shoot_all(
    root: Path,
    studio: Studio,
    motion: HeadParams,
    views: list[Camera],
    members: Members,
    progress: Callable[[int, int], None] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Write all images and masks.

    Returns:
        Vertices in world space [m], shape [T, V, 3], and the number of training images that see each, shape [V].
    """
    (root / "images").mkdir()
    (root / "fg_masks").mkdir()
    vertices, seen = [], np.zeros(len(studio.verts), np.int16)
    every, done = set().union(*members.values()), 0
    saved: list[Future[None]] = []
    with ThreadPoolExecutor(1) as writer:  # compresses an image while the next one is traced
        for t in range(len(motion)):
            studio.stage(motion, t)
            vertices.append(studio.verts.astype(np.float32))
            for c in sorted(c for at, c in every if at == t):
                image, mask = studio.shoot(views[c])
                saved.append(writer.submit(_save, image, root / "images" / _name(t, c)))
                saved.append(writer.submit(_save, mask, root / "fg_masks" / _name(t, c)))
                if (t, c) in members["train"]:
                    seen += studio.seen(views[c])
                done += 1
                if progress is not None:
                    progress(done, len(every))
    for written in saved:
        written.result()  # raises what went wrong
    return np.stack(vertices), seen


def _name(t: int, c: int) -> str:
    return f"{t:05d}_{c:02d}.png"


def _save(pixels: np.ndarray, path: Path) -> None:
    Image.fromarray(pixels).save(path, compress_level=1)


def _write_params(root: Path, head: HeadModel, motion: HeadParams) -> None:
    (root / "flame_param").mkdir()
    n_expr = max(head.n_expr, _N_EXPR)
    for t in range(len(motion)):
        _save_arrays(root / "flame_param" / f"{t:05d}.npz", **_vhap(motion, t, n_expr))
    neutral = _vhap(HeadParams.neutral(n_frames=1, n_expr=head.n_expr), 0, n_expr)
    opened = {**neutral, "jaw_pose": np.array([[0.3, 0.0, 0.0]])}  # float64, as VHAP writes it
    _save_arrays(root / "canonical_flame_param.npz", **opened)


def _vhap(motion: HeadParams, frame: int, n_expr: int) -> dict[str, np.ndarray]:
    rows = {name: getattr(motion, name)[frame : frame + 1].astype(np.float32) for name in MOTION_KEYS}
    return {"shape": np.zeros(_N_SHAPE, np.float32), **rows, "expr": pad_or_truncate(rows["expr"], n_expr)}


def _write_head_model(root: Path, head: HeadModel) -> str:
    """Save the head model unless it is the built-in one; return its name for the transforms files."""
    if head is build_head():  # built once and shared
        return BUILTIN
    save_head_model(root / HEAD_MODEL_FILE, head)
    return HEAD_MODEL_FILE


def _write_transforms(root: Path, views: list[Camera], members: Members, *, head_model: str) -> None:
    every = sorted(set().union(*members.values()))
    for name, chosen in (("", every), *((f"_{split}", sorted(members[split])) for split in SPLITS)):
        frames = [_frame(t, c, views[c]) for t, c in chosen]
        lens = _lens(views[-1])
        meta = {
            "frames": frames,
            **lens,
            "timestep_indices": sorted({t for t, _ in chosen}),
            "camera_indices": sorted({c for _, c in chosen}),
            HEAD_MODEL_KEY: head_model,
        }
        (root / f"transforms{name}.json").write_text(json.dumps(meta, indent=1), "utf-8")


def _frame(t: int, c: int, camera: Camera) -> dict[str, Any]:
    to_world = np.linalg.inv(camera.viewmat)
    to_world[:3, 1:3] *= -1.0  # OpenGL axes
    return {
        "timestep_index": t,
        "timestep_index_original": t,
        "timestep_id": f"{t:05d}",
        "camera_index": c,
        "camera_id": f"{c:02d}",
        **_lens(camera),
        "transform_matrix": to_world.tolist(),
        "file_path": f"images/{_name(t, c)}",
        "fg_mask_path": f"fg_masks/{_name(t, c)}",
        "flame_param_path": f"flame_param/{t:05d}.npz",
    }


def _lens(camera: Camera) -> dict[str, Any]:
    fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
    return {
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
        "fl_x": fx,
        "fl_y": fy,
        "h": camera.height,
        "w": camera.width,
        "camera_angle_x": 2 * math.atan(camera.width / (2 * fx)),
        "camera_angle_y": 2 * math.atan(camera.height / (2 * fy)),
    }


def _write_truth(
    root: Path, person: Person, motion: HeadParams, seed: int, vertices: np.ndarray, seen: np.ndarray
) -> None:
    (root / "ground_truth").mkdir()
    true_motion = {f"true_{name}": getattr(motion, name).astype(np.float32) for name in MOTION_KEYS}
    _save_arrays(
        root / "ground_truth" / "truth.npz",
        vertices=vertices,
        faces=person.faces,
        seen=seen,
        **{f"mask_{name}": mask for name, mask in person.masks.items()},
        true_shape=person.betas.astype(np.float32),
        **true_motion,
        expr_basis=np.array(person.head.expr_basis),
        head_model=np.array(person.head.name),
        seed=np.array(seed),
    )


def _save_arrays(path: Path, **arrays: Any) -> None:
    np.savez_compressed(path, **arrays)
