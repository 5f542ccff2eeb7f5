"""Motion in the formats of other trackers: every one gives the same performance."""

from __future__ import annotations

import json
import os
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import motion_files as write
import numpy as np
import pytest
import torch
from motion_files import Performance, performance
from scipy.spatial.transform import Rotation
from tiny_avatar import tiny_avatar

from mgavatar.driving.motion import Driving
from mgavatar.driving.read import read_driving
from mgavatar.driving.retarget import poses_of
from mgavatar.driving.smooth import smoothed
from mgavatar.errors import DataError


def refusal(path: Path) -> str:
    """The one line with which a path is refused; it names the path."""
    with pytest.raises(DataError) as caught:
        read_driving(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


def assert_same(motion: Driving, made: Performance, *parts: str, n_expr: int | None = None) -> None:
    """The named parameters are the performance's, and the other ones are zero."""
    truth = {
        "expr": made.expr[:, :n_expr],
        "rotation": made.root,
        "neck_pose": made.neck,
        "jaw_pose": made.jaw,
        "eyes_pose": made.eyes,
        "translation": made.place,
    }
    for key, value in truth.items():
        found = getattr(motion, key)
        if key in parts:
            np.testing.assert_allclose(found, value, atol=1e-6, err_msg=key)
        else:
            assert not found.any(), key


CODES: list[tuple[Callable[[Path, Performance], Path], str]] = [
    (write.write_emoca, "expcode as expr, posecode as rotation, posecode as jaw_pose"),
    (write.write_smirk, "expression_params as expr, jaw_params as jaw_pose, pose_params as rotation"),
    (write.write_diffposetalk, "exp as expr, pose as rotation, pose as jaw_pose"),
]


@pytest.mark.parametrize(("writer", "words"), CODES)
def test_codes_of_single_image_trackers_are_flames(tmp_path, writer, words):
    """Keys that mean FLAME's parameters are taken as such, and the user is told which."""
    made = performance()
    motion = read_driving(writer(tmp_path / "codes.npz", made))
    assert_same(motion, made, "expr", "rotation", "jaw_pose", n_expr=50)
    assert words in motion.notes[0]
    assert (motion.fps, motion.pivot) == (25.0, "root")


def test_what_foreign_files_have_beside_the_motion_is_said(tmp_path):
    made = performance()
    assert read_driving(write.write_emoca(tmp_path / "a.npz", made)).notes[1].endswith("not used: detailcode")
    assert read_driving(write.write_smirk(tmp_path / "b.npz", made)).notes[1].endswith("not used: eyelid_params")


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"exp": np.ones((5, 50)), "pose": np.ones((5, 4))}, "pose has 4 numbers per frame; 3 (root), 6 (root, jaw)"),
        ({"exp": np.ones((5, 50)), "expcode": np.ones((5, 50))}, "exp and expcode are both FLAME's expr"),
        ({"exp": np.ones((5, 50)), "jaw": np.ones((5, 6))}, "jaw has 6 numbers per frame, 3 are needed"),
        ({"expcode": np.ones((5, 50)), "posecode": np.ones((9, 6))}, "expcode has 5 frames but posecode has 9"),
        ({"expcode": np.full((5, 50), np.nan)}, "expcode holds 250 values that are NaN"),
        ({"landmarks": np.ones((5, 68, 2)), "lights": np.ones(9)}, "holds landmarks, lights; understood are"),
    ],
)
def test_foreign_files_that_do_not_fit(tmp_path, arrays, words):
    np.savez(tmp_path / "codes.npz", **arrays)
    assert words in refusal(tmp_path / "codes.npz")


def test_one_rotation_of_the_eyes_holds_for_both(tmp_path):
    np.savez(tmp_path / "codes.npz", exp=np.ones((3, 50)), eye_pose=np.full((3, 3), 0.1))
    assert np.allclose(read_driving(tmp_path / "codes.npz").eyes_pose, 0.1)


def test_a_length_that_differs_by_one_frame_is_mended(tmp_path):
    """Many tracker scripts write one pose more than expressions."""
    np.savez(tmp_path / "seq.npz", expr=np.ones((5, 4)), jaw_pose=np.arange(18.0).reshape(6, 3))
    motion = read_driving(tmp_path / "seq.npz")
    assert len(motion) == 5
    np.testing.assert_array_equal(motion.jaw_pose, np.arange(15.0).reshape(5, 3))
    assert motion.notes == (f"{tmp_path / 'seq.npz'}: the last of 6 frames is left out, which only jaw_pose has",)


def test_a_folder_of_foreign_frames(tmp_path):
    """One file per frame, numbered without padding."""
    for frame in range(11):
        np.savez(tmp_path / f"{frame}.npz", exp=np.full((1, 50), frame), pose=np.zeros((1, 6)))
    np.testing.assert_array_equal(read_driving(tmp_path).expr[:, 0], np.arange(11))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x89PNG\r\n\x1a\n", "is a PNG image, not motion"),
        (b"# notes\nfirst take", "is text that begins with '# notes', not motion"),
        (b"", "is empty"),
        (b"\x00\x01\x02", "not a file of motion"),
        (b"PK\x03\x04 not really", "not a readable .npz file"),
    ],
)
def test_what_a_file_that_is_no_motion_looks_like_is_said(tmp_path, content, words):
    """The suffix does not decide: contents are looked at."""
    for name in ("motion.npz", "motion.csv", "motion"):
        (tmp_path / name).write_bytes(content)
        assert words in refusal(tmp_path / name)


def test_npz_without_its_suffix(tmp_path):
    np.savez(tmp_path / "seq.npz", jaw_pose=np.ones((4, 3)))
    assert len(read_driving((tmp_path / "seq.npz").rename(tmp_path / "seq"))) == 4


def union(root: Path, *, with_motion: bool = True) -> Path:
    """A UNION folder beside its two sequences, which VHAP combines by names of files only."""
    frames = []
    for i, name in enumerate(("EMO-1", "EMO-2")):
        (root / name / "flame_param").mkdir(parents=True)
        for t in range(2):
            path = f"{name}/flame_param/{t:05d}.npz"
            np.savez(root / path, expr=[[10.0 * i + t]])
            frame = {"timestep_index": 2 * i + t, "flame_param_path": f"../{path}"}
            frames += [{**frame, "camera_index": camera} for camera in (0, 1)]
    (root / "UNION").mkdir()
    np.savez(root / "UNION" / "canonical_flame_param.npz", expr=np.zeros((1, 1)), jaw_pose=[[0.3, 0.0, 0.0]])
    for split, chosen in (("train", frames[4:]), ("val", []), ("test", frames[:4])):
        entries = chosen if with_motion else [{"timestep_index": 0}]
        (root / "UNION" / f"transforms_{split}.json").write_text(json.dumps({"frames": entries}))
    return root / "UNION"


def test_a_union_drives_with_the_motion_of_its_sequences(tmp_path):
    """★ Its folder has the canonical parameters alone: a neutral head with an open mouth, which is no motion."""
    motion = read_driving(union(tmp_path))
    np.testing.assert_array_equal(motion.expr[:, 0], [0.0, 1.0, 10.0, 11.0])
    assert not motion.jaw_pose.any()


def test_a_union_whose_sequences_are_not_named(tmp_path):
    assert "give the flame_param folder of one sequence" in refusal(union(tmp_path, with_motion=False))


# ---- trackers that pose FLAME first and then move it as a whole ----


def assert_moved(motion: Driving, made: Performance, *parts: str, n_expr: int | None = None) -> None:
    """The head turns about the origin by the performance's root and has its place."""
    assert motion.pivot == "origin"
    assert_same(motion, made, "expr", "rotation", "translation", *parts, n_expr=n_expr)


def test_cap4d_turns_about_the_origin_before_its_camera(tmp_path):
    """★ A rotation about the origin, after FLAME; one rotation for both eyes; the last expression is its own blink."""
    made = performance()
    made.right_eye[:] = made.left_eye
    made.expr[:, 64] = 0.0
    motion = read_driving(write.write_cap4d(tmp_path / "fit.npz", made))
    assert_moved(motion, made, "eyes_pose", n_expr=65)
    assert (motion.fps, motion.expr_basis) == (30.0, "flame2023_no_jaw")
    assert "expression 64, up to 0.8, CAP4D's own blink" in motion.notes[0]
    assert "neck_rot" in motion.notes[1]


def test_cap4d_without_cameras(tmp_path):
    made = performance()
    made.right_eye[:] = made.left_eye
    made.expr[:, 64] = 0.0
    assert_moved(
        read_driving(write.write_cap4d(tmp_path / "fit.npz", made, camera=False)), made, "eyes_pose", n_expr=65
    )


def test_nersembles_rotation_holds_euler_angles(tmp_path):
    """★ ``rotation`` is no rotation vector: ``rotation_matrices`` is read; the scale is that of the whole head."""
    made = performance()
    motion = read_driving(write.write_nersemble(tmp_path / "tracking.npz", made))
    assert_moved(motion, made, "neck_pose", "jaw_pose", "eyes_pose")


def test_metrical_tracker_moves_its_camera(tmp_path):
    """★ Six numbers are two rows; the eyes keep their order; the camera's motion becomes the head's."""
    made = performance()
    motion = read_driving(write.write_metrical(tmp_path / "subject", made))
    assert_moved(motion, made, "jaw_pose", "eyes_pose")
    assert motion.notes == (f"{tmp_path / 'subject'}: not used: eyelids, up to 0.3, for which FLAME has no parameter",)
    assert len(read_driving(tmp_path / "subject/checkpoint")) == len(made.expr)
    assert len(read_driving(tmp_path / "subject/checkpoint/00003.frame")) == 1


def test_pixel3dmm_poses_flame_first(tmp_path):
    """★ Joints, then R and t about the origin, then the still camera ``R_base_0``."""
    made = performance()
    assert_moved(
        read_driving(write.write_pixel3dmm(tmp_path / "frames", made)), made, "neck_pose", "jaw_pose", "eyes_pose"
    )


def test_flame_head_trackers_camera_is_three_euler_angles(tmp_path):
    """★ Camera to world in OpenGL's axes, R = Rz(c2) Ry(c0) Rx(c1); files are not padded."""
    made = performance(12)
    motion = read_driving(write.write_flame_head_tracker(tmp_path / "frames", made))
    assert_moved(motion, made, "jaw_pose", "eyes_pose")
    assert motion.notes == ()


@pytest.mark.parametrize("writer", [write.write_flame_head_tracker, write.write_metrical])
def test_frames_without_a_face_are_filled(tmp_path, writer):
    """★ They are missing from the folder; the others keep their time."""
    made = performance(8)
    motion = read_driving(writer(tmp_path / "frames", made, without=(3, 4)))
    assert len(motion) == 8
    np.testing.assert_allclose(motion.expr[5], made.expr[5], atol=1e-6)
    np.testing.assert_allclose(motion.expr[3], (2 * made.expr[2] + made.expr[5]) / 3, atol=1e-6)
    assert "2 frames are missing" in motion.notes[-1]


def test_artalk_is_a_bare_tensor(tmp_path):
    """★ 100 expressions, the root, the jaw; 25 frames per second."""
    made = performance()
    motion = read_driving(write.write_artalk(tmp_path / "a_motions.pt", made))
    assert_same(motion, made, "expr", "rotation", "jaw_pose")
    assert (motion.fps, motion.notes) == (25.0, ())


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (torch.zeros(5, 100), "its tensor has shape (5, 100), (T, 106) is needed"),
        (torch.full((5, 106), torch.nan), "its tensor holds 530 values that are NaN"),
        ({"exp": torch.zeros(5, 100)}, "holds a dictionary of exp; ARTalk's motion is one tensor (T, 106)"),
        ([torch.zeros(5, 106)], "holds a list"),
        (torch.zeros(5, 106).to_sparse(), "its tensor is not one of plain numbers"),
        (torch.empty(5, 106, device="meta"), "its tensor is not one of plain numbers"),
        (torch.zeros(5, 106, dtype=torch.complex64), "its tensor is not one of plain numbers"),
        (torch.zeros(1, 1).expand(2_000_000, 106), "too large to be motion"),
    ],
)
def test_tensors_that_are_no_motion(tmp_path, value, words):
    """★ Tensors that are sparse, without data or quantised are refused before they are used."""
    torch.save(value, tmp_path / "a.pt")
    assert words in refusal(tmp_path / "a.pt")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_quantised_and_nested_tensors_are_no_motion(tmp_path):
    """torch itself refuses some of them; what it loads is refused here."""
    for value in (
        torch.quantize_per_tensor(torch.zeros(5, 106), 0.1, 0, torch.quint8),
        torch.nested.nested_tensor([torch.zeros(5, 106), torch.zeros(3, 106)]),
    ):
        torch.save(value, tmp_path / "a.pt")
        assert "tensor" in refusal(tmp_path / "a.pt")


def test_files_of_torch_that_are_hostile(tmp_path):
    """★ No code is run: not in a tensor's file, and not in a ``.frame``, whose arrays are built from checked bytes."""

    class Bomb:
        def __reduce__(self) -> tuple:
            return (os.system, ("touch broken",))

    torch.save(Bomb(), tmp_path / "a.pt")
    assert "not a readable file of tensors" in refusal(tmp_path / "a.pt")
    folder = write.write_metrical(tmp_path / "subject", performance(1))
    torch.save({"flame": {"exp": Bomb()}}, folder / "checkpoint/00000.frame")
    assert "it asks for posix.system" in _message(folder)
    forged = np.zeros((1, 100))
    data = pickle.dumps({"flame": {"exp": forged}}, protocol=2).replace(b"X\x02\x00\x00\x00f8", b"X\x02\x00\x00\x00O8")
    with zipfile.ZipFile(folder / "checkpoint/00000.frame", "w") as archive:
        archive.writestr("archive/data.pkl", data)
    assert "arrays of type O8 are refused" in _message(folder)
    torch.save(torch.zeros(3, 106), folder / "checkpoint/00000.frame")
    assert "only numpy's arrays are read" in _message(folder)


def _message(path: Path) -> str:
    with pytest.raises(DataError) as caught:
        read_driving(path)
    return str(caught.value)


def test_archives_that_inflate_are_refused(tmp_path):
    torch.save(torch.zeros(5, 106), tmp_path / "a.pt")
    with (
        zipfile.ZipFile(tmp_path / "a.pt") as old,
        zipfile.ZipFile(tmp_path / "b.pt", "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    assert "is compressed" in refusal(tmp_path / "b.pt")


@pytest.mark.parametrize(
    ("writer", "change", "words"),
    [
        (write.write_cap4d, {"rot": np.ones((9, 3))}, "expr has 7 frames but rot has 9"),
        (write.write_cap4d, {"extr": np.ones((1, 4, 4))}, "extr is no rotation"),
        (write.write_cap4d, {"extr": np.ones((4, 4))}, "extr has shape (4, 4), (C, 4, 4) is needed"),
        (
            write.write_nersemble,
            {"rotation_matrices": np.ones((7, 3, 3))},
            "rotation_matrices is no rotation in frame 0",
        ),
        (write.write_nersemble, {"rotation_matrices": np.ones((7, 3))}, "(T, 3, 3) is needed"),
        (write.write_nersemble, {"scale": np.zeros((1, 1))}, "scale must be one positive number"),
    ],
)
def test_trackers_files_that_do_not_fit(tmp_path, writer, change, words):
    path = writer(tmp_path / "a.npz", performance())
    with np.load(path) as file:
        np.savez(path, **{**file, **change})
    assert words in refusal(path)


def test_a_head_that_turns_about_the_origin_turns_so_on_the_avatar(tmp_path):
    """t' = t + R J - J, with the avatar's own root joint: its vertices are R v + t, up to the shift of the sequence."""
    avatar, _ = tiny_avatar(tmp_path)
    made = performance(5, n_expr=3)
    motion = read_driving(write.write_nersemble(tmp_path / "a.npz", made, scale=1.0))
    still = replace(motion, expr=0.0 * motion.expr, neck_pose=0.0 * motion.neck_pose, jaw_pose=0.0 * motion.jaw_pose)
    still = replace(still, eyes_pose=0.0 * motion.eyes_pose)
    poses = poses_of(avatar, still)
    rest = avatar.verts(replace(poses[0], rotation=torch.zeros(3), translation=torch.zeros(3))).numpy()
    expected = np.stack([rest @ write.matrix_of(r).T + t for r, t in zip(made.root, made.place, strict=True)])
    found = np.stack([avatar.verts(pose).numpy() for pose in poses])
    shift = (found - expected).mean(axis=(0, 1))
    np.testing.assert_allclose(found - shift, expected, atol=1e-4)


# ---- smoothing ----


def test_smoothing_removes_jitter_and_keeps_motion(tmp_path):
    """Zero phase: a clean motion comes back from one with jitter, without delay; what was removed is said."""
    rng = np.random.default_rng(0)
    time = np.arange(120)[:, None] / 30.0
    clean = {
        "neck_pose": 0.3 * np.sin(2.0 * time + [0.0, 1.0, 2.0]),
        "expr": np.sin(3.0 * time + np.arange(4)),
        "translation": 0.02 * np.cos(2.5 * time + [0.0, 1.0, 2.0]),
    }
    noise = {"neck_pose": 0.01, "expr": 0.05, "translation": 0.002}
    np.savez(tmp_path / "a.npz", **{k: v + rng.normal(0.0, noise[k], v.shape) for k, v in clean.items()}, fps=30.0)
    motion, line = smoothed(read_driving(tmp_path / "a.npz"))
    for key, value in clean.items():
        left = np.sqrt(np.mean((getattr(motion, key) - value) ** 2))
        assert left < 0.75 * noise[key], key
    assert "degrees" in line
    assert "mm" in line
    assert not motion.jaw_pose.any()


def test_smoothing_across_a_half_turn(tmp_path):
    """★ A rotation vector of 181 degrees is written as one of -179: the sphere has no such jump."""
    angles = np.radians(np.linspace(170.0, 190.0, 40))
    vectors = np.zeros((40, 3))
    vectors[:, 1] = np.where(angles > np.pi, angles - 2.0 * np.pi, angles)
    np.savez(tmp_path / "a.npz", rotation=vectors)
    motion, _ = smoothed(read_driving(tmp_path / "a.npz"))
    turned = Rotation.from_rotvec(motion.rotation).inv() * Rotation.from_rotvec(vectors)
    assert np.degrees(turned.magnitude()).max() < 0.01


def test_smoothing_keeps_a_blink(tmp_path):
    """A blink of a sixth of a second keeps most of its depth."""
    time = np.arange(90) / 30.0
    blink = np.exp(-(((time - 1.5) / 0.08) ** 2))
    np.savez(tmp_path / "a.npz", expr=blink[:, None], fps=30.0)
    assert smoothed(read_driving(tmp_path / "a.npz"))[0].expr.max() > 0.8


def test_short_sequences_are_not_smoothed(tmp_path):
    np.savez(tmp_path / "a.npz", jaw_pose=np.ones((4, 3)))
    motion, line = smoothed(read_driving(tmp_path / "a.npz"))
    np.testing.assert_array_equal(motion.jaw_pose, 1.0)
    assert "too few to smooth" in line
