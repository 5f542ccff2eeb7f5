"""Driving, cameras and the files that frames go into."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny_avatar import COLOR, avatar_on, tiny_avatar

from mgavatar.avatar import Avatar
from mgavatar.camera import look_at
from mgavatar.capture.read import read_capture
from mgavatar.driving.cameras import cameras_of
from mgavatar.driving.motion import Driving
from mgavatar.driving.read import read_driving
from mgavatar.driving.render import render
from mgavatar.driving.retarget import driving_notes, head_points, poses_of
from mgavatar.driving.writers import EMPTY_DEPTH, to_bytes, write_exr
from mgavatar.errors import DataError
from mgavatar.head.load import read_head_model
from mgavatar.kernels.rasterize import Rendering

N = 5


def test_backgrounds_of_a_rendering(avatar: Avatar, driving: Driving, tmp_path: Path) -> None:
    """Another colour where nothing is; with alpha, the picture over any colour is the one drawn over it."""
    one = slice(0, 1)
    for name, background in (("own", None), ("green", "0,255,0"), ("alpha", "transparent")):
        render(avatar, driving, out=tmp_path / name, frames=one, background=background)
    own, green, alpha = (np.asarray(Image.open(tmp_path / n / "00000.png")) for n in ("own", "green", "alpha"))
    assert own[0, 0].tolist() == [255, 255, 255]
    assert green[0, 0].tolist() == [0, 255, 0]
    assert alpha.shape[2] == 4
    assert alpha[0, 0].tolist() == [0, 0, 0, 0]
    coverage = alpha[:, :, 3:] / 255.0
    assert coverage.max() > 0.9
    over_green = alpha[:, :, :3] * coverage + (1.0 - coverage) * np.array([0.0, 255.0, 0.0])
    assert np.abs(over_green - green).max() < 2.0


@pytest.mark.parametrize(
    ("name", "format", "background", "words"),
    [
        ("a.gif", "auto", "transparent", "cannot be transparent; give --out a folder"),
        ("frames", "exr", "white", "EXR has alpha and no background"),
        ("frames", "png", "purple", "--background purple: must be white, black or R,G,B"),
    ],
)
def test_backgrounds_that_are_refused(
    name: str, format: str, background: str, words: str, avatar: Avatar, driving: Driving, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=words):
        render(avatar, driving, out=tmp_path / name, format=format, background=background)  # type: ignore[arg-type]
    assert not (tmp_path / name).exists()


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Avatar:
    return tiny_avatar(tmp_path_factory.mktemp("render"))[0]


@pytest.fixture
def driving(tmp_path: Path) -> Driving:
    """A sequence that turns, moves and smiles, recorded somewhere else."""
    rng = np.random.default_rng(3)
    path = tmp_path / "motion.npz"
    widths = {"expr": 3, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
    rows = {key: rng.normal(0.0, 0.1, (N, width)).astype(np.float32) for key, width in widths.items()}
    rows["translation"] = 0.1 * rows["translation"] + np.array([3.0, -2.0, 1.0], np.float32)
    np.savez(path, **rows, fps=12.5, expr_basis="another")
    return read_driving(path)


def _composed(rotation: np.ndarray, neck: np.ndarray) -> np.ndarray:
    return (Rotation.from_rotvec(rotation) * Rotation.from_rotvec(neck)).as_matrix()


def _stack(poses: list, name: str) -> np.ndarray:
    return np.stack([getattr(pose, name).numpy() for pose in poses])


def test_full_head_motion_is_as_driven_around_the_avatars_own_place(avatar: Avatar, driving: Driving) -> None:
    """Rotations stay, and the head is on average where it was in training."""
    poses = poses_of(avatar, driving)
    assert np.allclose(_stack(poses, "rotation"), driving.rotation)
    assert np.allclose(_stack(poses, "jaw_pose"), driving.jaw_pose)
    moved = _stack(poses, "translation") - driving.translation
    assert np.allclose(moved, moved[0], atol=1e-6)
    driven = head_points(avatar, driving.rotation, driving.neck_pose, _stack(poses, "translation"))
    mean = avatar.mean_pose()
    own = head_points(avatar, *(value.numpy()[None] for value in (mean.rotation, mean.neck_pose, mean.translation)))
    assert np.allclose(driven.mean(axis=0), own[0], atol=1e-6)


def test_neck_motion_keeps_the_shoulders_and_the_gaze(avatar: Avatar, driving: Driving) -> None:
    """The root stays at its training mean, and root and neck together turn as they do in the sequence."""
    poses, mean = poses_of(avatar, driving, head_motion="neck"), avatar.mean_pose()
    assert np.allclose(_stack(poses, "rotation"), mean.rotation.numpy())
    assert np.allclose(_stack(poses, "translation"), mean.translation.numpy())
    turned = _composed(_stack(poses, "rotation"), _stack(poses, "neck_pose"))
    assert np.allclose(turned, _composed(driving.rotation, driving.neck_pose), atol=1e-5)


def test_no_head_motion_leaves_the_face_alone_to_move(avatar: Avatar, driving: Driving) -> None:
    poses, mean = poses_of(avatar, driving, head_motion="none"), avatar.mean_pose()
    assert np.allclose(_stack(poses, "rotation"), mean.rotation.numpy())
    assert np.allclose(_stack(poses, "neck_pose"), mean.neck_pose.numpy())
    assert np.allclose(_stack(poses, "jaw_pose"), driving.jaw_pose)


def test_a_part_of_a_sequence_is_placed_like_the_whole(avatar: Avatar, driving: Driving) -> None:
    part, whole = poses_of(avatar, driving, frames=slice(2, 4)), poses_of(avatar, driving)
    assert len(part) == 2
    assert torch.equal(part[0].translation, whole[2].translation)


def test_mean_pose_averages_the_training_timesteps_only(avatar: Avatar) -> None:
    rows = list(avatar.capture.train_timesteps)
    assert len(rows) < len(avatar.capture.timestep_ids)
    assert torch.allclose(avatar.mean_pose().translation, avatar.head.poses["translation"][rows].mean(0))


def test_an_expression_of_another_basis_is_ignored_and_said(avatar: Avatar, driving: Driving) -> None:
    assert not any(bool(pose.expr.any()) for pose in poses_of(avatar, driving))
    (note,) = driving_notes(avatar, driving)
    assert "ignored" in note
    assert "another" in note
    used = poses_of(avatar, driving, expression="use")
    assert np.allclose(_stack(used, "expr"), driving.expr)
    assert driving_notes(avatar, driving, expression="use") == []


def test_named_cameras(avatar: Avatar) -> None:
    assert cameras_of(avatar, "mean", n_frames=3) == [avatar.capture.mean_camera()] * 3
    assert cameras_of(avatar, "train:1", n_frames=1) == [avatar.capture.cameras[1]]


def test_orbit_swings_the_mean_camera_both_ways_at_its_distance(avatar: Avatar) -> None:
    cameras = cameras_of(avatar, "orbit", n_frames=4)
    mean = avatar.capture.mean_camera()
    assert np.allclose(cameras[0].viewmat, mean.viewmat)
    assert np.allclose(cameras[2].viewmat, mean.viewmat)
    for index in (1, 3):
        turn = cameras[index].viewmat[:3, :3] @ mean.viewmat[:3, :3].T
        assert np.degrees(Rotation.from_matrix(turn).magnitude()) == pytest.approx(40.0, abs=1e-3)
    center = avatar.verts(avatar.mean_pose()).mean(0).numpy()
    distances = [np.linalg.norm(camera.position - center) for camera in cameras]
    assert np.allclose(distances, distances[0], atol=1e-6)
    assert cameras[1].position[0] > mean.position[0] > cameras[3].position[0]


def test_camera_files_have_the_keys_of_a_transforms_frame(avatar: Avatar, tmp_path: Path) -> None:
    view = look_at(np.array([0.3, 0.1, 0.9]), np.zeros(3), focal=70.0, width=40, height=30)
    to_world = np.linalg.inv(view.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
    frame = {"transform_matrix": to_world.tolist(), "fl_x": 70.0, "w": 40, "h": 30}
    path = tmp_path / "view.json"
    path.write_text(json.dumps(frame))
    (camera,) = cameras_of(avatar, str(path), n_frames=1)
    assert np.allclose(camera.viewmat, view.viewmat)
    assert np.allclose(camera.K, view.K)
    path.write_text(json.dumps({"frames": [frame, {**frame, "fl_x": 90.0}]}))
    assert [view.K[0, 0] for view in cameras_of(avatar, str(path), n_frames=2)] == [70.0, 90.0]
    with pytest.raises(DataError, match="2 cameras for 5 frames"):
        cameras_of(avatar, str(path), n_frames=5)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ("side", "no camera 'side'; there are mean, orbit, train:0"),
        ("train:99", "no camera 'train:99'; there are mean, orbit, train:0"),
        ("train:x", "no camera 'train:x'"),
        ("gone.json", "gone.json: no such file"),
    ],
)
def test_unknown_cameras_are_refused_with_a_list(avatar: Avatar, camera: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        cameras_of(avatar, camera, n_frames=1)


@pytest.mark.parametrize("content", ["[1]", '{"frames": 3}', '{"w": 4, "h": 4, "fl_x": 3}'])
def test_files_without_a_camera_are_refused(avatar: Avatar, tmp_path: Path, content: str) -> None:
    path = tmp_path / "view.json"
    path.write_text(content)
    with pytest.raises(DataError, match=r"view\.json: "):
        cameras_of(avatar, str(path), n_frames=1)


def test_another_size_keeps_proportions_and_the_centre(avatar: Avatar) -> None:
    (view,), own = cameras_of(avatar, "mean", n_frames=1, size=(100, 64)), avatar.capture.mean_camera()
    assert (view.width, view.height) == (100, 64)
    assert view.K[0, 0] == view.K[1, 1] == pytest.approx(own.K[1, 1] * 64 / own.height)
    assert (view.K[0, 2], view.K[1, 2]) == pytest.approx((50.0, 32.0))
    with pytest.raises(DataError, match="--size 0x5"):
        cameras_of(avatar, "mean", n_frames=1, size=(0, 5))


def test_eight_bits_are_rounded_and_clamped() -> None:
    values = torch.tensor([-1.0, 0.0, 100.4 / 255, 100.6 / 255, 0.999, 7.0])
    assert to_bytes(values.expand(3, 1, 6))[0, :, 0].tolist() == [0, 0, 100, 101, 255, 255]


def test_png_folder(avatar: Avatar, driving: Driving, tmp_path: Path) -> None:
    """Files are numbered from 0 and hold what the avatar draws."""
    done = []
    out = tmp_path / "frames"
    out.mkdir()  # an empty folder is as good as none
    notes = render(avatar, driving, out=out, progress=lambda *at: done.append(at))
    assert sorted(file.name for file in out.iterdir()) == [f"{index:05d}.png" for index in range(N)]
    assert done == [(index + 1, N) for index in range(N)]
    assert len(notes) == 1
    pose, camera = poses_of(avatar, driving)[3], avatar.capture.mean_camera()
    with Image.open(out / "00003.png") as image:
        assert np.array_equal(np.asarray(image), to_bytes(avatar.render(pose, camera).image))


def test_mp4_round_trip(avatar: Avatar, driving: Driving, tmp_path: Path) -> None:
    """Number, rate and colours of the frames survive, odd sizes are padded, and BT.709 is declared."""
    out = tmp_path / "clip.mp4"
    render(avatar, driving, out=out, size=(73, 65), head_motion="none")
    with av.open(str(out)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.colorspace, context.color_primaries, context.color_trc, context.color_range) == (1, 1, 1, 1)
        assert stream.average_rate == Fraction(25, 2)
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert [frame.shape for frame in frames] == [(66, 74, 3)] * N
    for frame in frames:
        assert np.abs(frame[33, 37] / 255.0 - COLOR).max() < 0.02
        assert frame[2, 2].min() > 250


def test_gif_round_trip(avatar: Avatar, driving: Driving, tmp_path: Path) -> None:
    out = tmp_path / "clip.gif"
    render(avatar, driving, out=out, frames=slice(0, 3))
    with Image.open(out) as image:
        assert (image.n_frames, image.size, image.info["duration"]) == (3, (24, 32), 80)
        center = np.asarray(image.convert("RGB"))[16, 12]
    assert np.abs(center / 255.0 - COLOR).max() < 0.05


def test_exr_values_are_linear_premultiplied_with_depth(tmp_path: Path) -> None:
    alpha = torch.tensor([[1.0, 0.5, 0.0]])
    rendering = Rendering(0.5 * alpha.expand(3, 1, 3), alpha, 2.0 * alpha, torch.ones(1, dtype=torch.bool))
    camera = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3), focal=5.0, width=3, height=1)
    write_exr(tmp_path / "x.exr", rendering, camera, frame=7)
    with OpenEXR.File(str(tmp_path / "x.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
        header = dict(file.header())
    linear = ((0.5 + 0.055) / 1.055) ** 2.4
    assert channels["R"].dtype == np.float16
    assert np.allclose(channels["R"][0], [linear, 0.5 * linear, 0.0], atol=2e-4)
    assert np.allclose(channels["A"][0], [1.0, 0.5, 0.0])
    assert channels["Z"].dtype == np.float32
    assert np.allclose(channels["Z"][0], [2.0, 2.0, EMPTY_DEPTH])
    assert header["mgavatar/frame"] == 7
    assert np.allclose(header["worldToCamera"], camera.viewmat.T)
    assert np.allclose(json.loads(header["mgavatar/json"])["viewmat"], camera.viewmat)


def test_exr_folder_has_no_background(avatar: Avatar, driving: Driving, tmp_path: Path) -> None:
    out = tmp_path / "frames"
    render(avatar, driving, out=out, format="exr", frames=slice(0, 1))
    with OpenEXR.File(str(out / "00000.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    assert channels["A"][0, 0] == channels["R"][0, 0] == 0
    red = ((COLOR[0] + 0.055) / 1.055) ** 2.4
    assert channels["R"][16, 12] == pytest.approx(red * float(channels["A"][16, 12]), abs=2e-3)
    assert 0.8 < channels["Z"][16, 12] < 1.0


def test_only_files_of_the_same_kind_are_replaced(avatar: Avatar, driving: Driving, tmp_path: Path) -> None:
    clip, foreign, folder = tmp_path / "clip.mp4", tmp_path / "notes.gif", tmp_path / "folder"
    render(avatar, driving, out=clip, frames=slice(0, 1))
    first = clip.read_bytes()
    with pytest.raises(DataError, match="--overwrite"):
        render(avatar, driving, out=clip, frames=slice(0, 2))
    assert clip.read_bytes() == first
    render(avatar, driving, out=clip, frames=slice(0, 2), overwrite=True)
    assert clip.read_bytes() != first
    foreign.write_text("my notes")
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    for out, message in ((foreign, "not a .gif file"), (folder, "not an empty folder")):
        with pytest.raises(DataError, match=message):
            render(avatar, driving, out=out)
    assert foreign.read_text() == "my notes"
    assert (folder / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "format", "message"),
    [
        ("clip.mov", "auto", "ending in .mp4 or .gif"),
        ("clip.mp4", "png", "its name says mp4, but the format is png"),
        ("clip", "mp4", "must end in .mp4"),
        ("gone/clip.mp4", "auto", "does not exist"),
    ],
)
def test_impossible_outputs_are_refused(
    avatar: Avatar, driving: Driving, tmp_path: Path, name: str, format: str, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        render(avatar, driving, out=tmp_path / name, format=format)  # type: ignore[arg-type]


def test_without_pyav_nothing_is_begun(
    avatar: Avatar, driving: Driving, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(avatar, "render", lambda *_: pytest.fail("work was begun"))
    with pytest.raises(DataError, match=r"pip install mgavatar\[video\]"):
        render(avatar, driving, out=tmp_path / "clip.mp4")


@pytest.mark.parametrize("name", ["clip.mp4", "clip.gif", "frames"])
def test_an_interrupted_rendering_leaves_nothing(avatar: Avatar, driving: Driving, tmp_path: Path, name: str) -> None:
    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    folder = tmp_path / "out"
    folder.mkdir()
    with pytest.raises(KeyboardInterrupt):
        render(avatar, driving, out=folder / name, progress=stop)
    assert list(folder.iterdir()) == []


def test_no_frames_and_frames_out_of_the_picture_are_said(avatar: Avatar, driving: Driving, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no frames are left of its 5"):
        render(avatar, driving, out=tmp_path / "none", frames=slice(9, None))
    away = driving.translation.copy()
    away[0] += 50.0
    notes = render(avatar, replace(driving, translation=away), out=tmp_path / "far")
    assert "outside the picture in 5 of 5 frames" in notes[-1]


@pytest.fixture(scope="module")
def real_avatar(real_data: Path) -> Avatar:
    subject = read_capture(real_data / "subjects/lps_multiview")
    return avatar_on(subject, read_head_model(real_data / "head_models/ict_head.npz"))


@pytest.mark.parametrize("name", ["seq_a", "seq_b", "seq_c"])
def test_real_motion_keeps_the_head_in_the_picture(real_data: Path, real_avatar: Avatar, name: str) -> None:
    """Sequences that were tracked elsewhere, on a real capture's camera."""
    avatar = real_avatar
    driving = read_driving(real_data / f"driving/{name}.npz")
    camera = avatar.capture.mean_camera()
    poses = poses_of(avatar, driving)
    points = head_points(avatar, driving.rotation, driving.neck_pose, _stack(poses, "translation"))
    projected = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
    places = projected[:, :2] / projected[:, 2:]
    assert (projected[:, 2] > 0).all()
    assert ((places > 0) & (places < [camera.width, camera.height])).all()
