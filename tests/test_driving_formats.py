"""Motion in the formats of other trackers: every one gives the same performance."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import motion_files as write
import numpy as np
import pytest
from motion_files import Performance, performance

from mgavatar.driving.motion import Driving
from mgavatar.driving.read import read_driving
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
