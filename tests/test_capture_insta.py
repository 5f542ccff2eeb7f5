"""Captures of INSTA and metrical-tracker, written by the formats' own conventions."""

from __future__ import annotations

import io
import json
import logging
import os
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny import tiny_head

from mgavatar.camera import look_at
from mgavatar.capture.images import check_images, read_masks
from mgavatar.capture.placement import check_placement
from mgavatar.capture.read import read_capture
from mgavatar.capture.readers import insta
from mgavatar.errors import DataError

N_FRAMES = 6
JAW = Rotation.from_rotvec([0.2, 0.03, -0.01])
LEFT_EYE, RIGHT_EYE = Rotation.from_rotvec([0.1, -0.2, 0.0]), Rotation.from_rotvec([-0.1, 0.3, 0.05])


def two_rows(rotation: Rotation) -> np.ndarray:
    """Return the first two rows of the matrix, as PyTorch3D writes a rotation."""
    return rotation.as_matrix()[:2].reshape(1, 6).astype(np.float32)


def camera_of(index: int) -> Any:
    return look_at(np.array([0.05 * index, 0.0, 1.0]), np.zeros(3), focal=120.0, width=48, height=40)


def frame_content(index: int) -> dict[str, Any]:
    camera = camera_of(index)
    rng = np.random.default_rng(index)
    return {
        "flame": {
            "exp": rng.normal(0.0, 0.3, (1, 100)).astype(np.float32),
            "shape": np.linspace(-1.0, 1.0, 300, dtype=np.float32)[None],
            "tex": np.zeros((1, 140), np.float32),
            "sh": np.zeros((1, 9, 3), np.float32),
            "eyes": np.concatenate([two_rows(LEFT_EYE), two_rows(RIGHT_EYE)], axis=1),
            "jaw": two_rows(JAW),
            "eyelids": np.full((1, 2), 0.4, np.float32),
        },
        "camera": {"fl": np.ones((1, 1), np.float32)},
        "opencv": {
            "R": camera.viewmat[None, :3, :3].astype(np.float32),
            "t": camera.viewmat[None, :3, 3].astype(np.float32),
            "K": camera.K[None].astype(np.float32),
        },
        "img_size": np.array([40, 48]),
        "frame_id": f"{index:05d}",
        "global_step": 300,
    }


def write_tracker(root: Path, *, transforms: bool) -> Path:
    """Write a tracker's folder; with INSTA's transforms, whose val is the end of its test."""
    for name in ("checkpoint", "images", "flame/exp"):
        (root / name).mkdir(parents=True)
    frames = []
    for index in range(N_FRAMES):
        torch.save(frame_content(index), root / f"checkpoint/{index:05d}.frame")
        np.savetxt(root / f"flame/exp/{index:05d}.txt", np.zeros(100), fmt="%.8f")
        y, x = np.mgrid[0:40, 0:48]
        alpha = np.where((x - 24) ** 2 + (y - 20) ** 2 < 12**2, 255, 0).astype(np.uint8)
        Image.fromarray(np.dstack([np.full((40, 48, 3), 90, np.uint8), alpha])).save(root / f"images/{index:05d}.png")
        pose = np.linalg.inv(camera_of(index).viewmat)  # OpenCV's axes, unlike NeRF
        frames.append({
            "transform_matrix": pose.tolist(), "file_path": f"images/{index:05d}.png",
            "exp_path": f"flame/exp/{index:05d}.txt", "mesh_path": f"meshes/{index:05d}.obj",
        })  # fmt: skip
    if transforms:
        for split, chosen in (("train", frames[:4]), ("test", frames[4:]), ("val", frames[5:])):
            (root / f"transforms_{split}.json").write_text(json.dumps({"frames": chosen, "w": 48.0, "h": 40.0}))
    return root


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_tracker(tmp_path / "insta", transforms=True)


def refusal(root: Path, **options: bool) -> str:
    with pytest.raises(DataError) as caught:
        read_capture(root, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_conventions_of_the_tracker(root, caplog):
    """6D rotations are rows, eyes keep their order, and cameras are OpenCV's without any flip."""
    caplog.set_level(logging.INFO, logger="mgavatar")
    subject = read_capture(root)
    assert [len(subject.frames[split]) for split in ("train", "val", "test")] == [4, 1, 2]
    params = subject.params
    assert params.expr.shape == (N_FRAMES, 100)
    np.testing.assert_allclose(params.jaw_pose, np.tile(JAW.as_rotvec(), (N_FRAMES, 1)), atol=1e-6)
    eyes = np.concatenate([LEFT_EYE.as_rotvec(), RIGHT_EYE.as_rotvec()])
    np.testing.assert_allclose(params.eyes_pose[3], eyes, atol=1e-6)
    assert not params.rotation.any()
    assert not params.neck_pose.any()
    np.testing.assert_allclose(params.shape, np.linspace(-1.0, 1.0, 300), atol=1e-6)
    for index, frame in enumerate(subject.frames["train"]):
        np.testing.assert_allclose(frame.camera.viewmat, camera_of(index).viewmat, atol=1e-6)
        np.testing.assert_allclose(frame.camera.K, camera_of(index).K)
        assert (frame.camera.width, frame.camera.height) == (48, 40)
    assert "INSTA or metrical-tracker: 6 tracked frames" in caplog.text
    assert "eyelids, up to 0.4, are not used" in caplog.text


def test_images_and_mattes(root):
    subject = read_capture(root)
    check_images(subject)
    masks = read_masks(subject.frames["train"])
    assert masks[0, 20, 24] == 255
    assert masks[0, 0, 0] == 0
    check_placement(subject, tiny_head())


def test_a_tracker_without_transforms(tmp_path, caplog):
    """The last 30 % of a short video are held out, which is said."""
    caplog.set_level(logging.INFO, logger="mgavatar")
    subject = read_capture(write_tracker(tmp_path / "tracker", transforms=False))
    assert [len(subject.frames[split]) for split in ("train", "val", "test")] == [5, 0, 1]
    assert "the last 1 of 6 frames are test" in caplog.text


def test_insta_without_its_tracker(root):
    shutil.rmtree(root / "checkpoint")
    assert "an INSTA capture without checkpoint/*.frame" in refusal(root)


def test_a_frame_that_failed(root):
    (root / "checkpoint/00002.frame").write_bytes(b"PK\x03\x04")
    message = refusal(root)
    assert "00002.frame: not a readable file of torch.save" in message
    assert "--skip-bad" in message
    assert read_capture(root, skip_bad=True).timestep_ids == (0, 1, 3, 4, 5)


@pytest.mark.parametrize("change", [
    {"opencv": None}, {"flame": {}}, {"img_size": np.array([0, 48])}, {"img_size": np.array([40])},
], ids=["no opencv", "no flame", "no size", "one size"])  # fmt: skip
def test_frames_that_lack_something(root, change):
    torch.save({**frame_content(1), **change}, root / "checkpoint/00001.frame")
    assert "00001.frame: " in refusal(root)


@pytest.mark.parametrize(("group", "key", "value"), [
    ("flame", "jaw", np.zeros((1, 6), np.float32)),
    ("flame", "jaw", np.zeros((1, 3), np.float32)),
    ("flame", "exp", np.full((1, 100), np.nan, np.float32)),
    ("flame", "shape", np.array([["a"]])),
    ("opencv", "R", np.zeros((1, 3, 3), np.float32)),
    ("opencv", "K", np.zeros((1, 3, 3), np.float32)),
])  # fmt: skip
def test_frames_with_nonsense(root, group, key, value):
    content = frame_content(1)
    content[group][key] = value
    torch.save(content, root / "checkpoint/00001.frame")
    assert "00001.frame: " in refusal(root)


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("evil",)


def test_no_code_of_a_frame_is_run(root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({**frame_content(1), "camera": Evil()}, root / "checkpoint/00001.frame")
    assert "only numpy's arrays are read" in refusal(root)
    assert not (tmp_path / "evil").exists()


def test_damaged_bytes_are_one_line(root):
    """A thousand mutations of one good frame: a clean load, or one line with the file."""
    path = root / "checkpoint/00001.frame"
    with zipfile.ZipFile(path) as archive:
        pickled = archive.read(next(name for name in archive.namelist() if name.endswith("data.pkl")))
    rng = np.random.default_rng(0)
    for trial in range(1000):
        data = bytearray(pickled)
        for place in rng.integers(0, len(data), rng.integers(1, 6)):
            data[place] = rng.integers(0, 256)
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            archive.writestr("archive/data.pkl", bytes(data[: len(data) // 2] if trial % 50 == 0 else data))
        path.write_bytes(stream.getvalue())
        try:
            insta._read_frame(path)
        except DataError as error:
            message = str(error)
        else:
            message = "00001.frame"
        assert "\n" not in message
        assert "00001.frame" in message
