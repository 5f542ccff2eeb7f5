"""ARKit's blendshapes from phones, sound and browsers: names, times, and the turns of head and eyes."""

from __future__ import annotations

import json
from pathlib import Path

import motion_files as write
import numpy as np
import pytest
from motion_files import ARKIT_ORDER, Face, camel, face, turn_matrix
from scipy.spatial.transform import Rotation

from mgavatar.driving.arkit import ARKIT_NAMES, arkit_name
from mgavatar.driving.motion import Driving
from mgavatar.driving.read import read_driving
from mgavatar.errors import DataError


def refusal(path: Path) -> str:
    with pytest.raises(DataError) as caught:
        read_driving(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


def assert_weights(motion: Driving, made: Face, *, without: tuple[str, ...] = (), atol: float = 1e-6) -> None:
    """The columns are the face's, under ARKit's own names."""
    assert motion.expr_basis == "arkit"
    assert motion.expr_names == tuple(name for name in ARKIT_NAMES if name not in without)
    assert len(motion) == len(made)
    for name, column in zip(motion.expr_names, motion.expr.T, strict=True):
        np.testing.assert_allclose(column, made.weights[name], atol=atol, err_msg=name)


def assert_turned(vectors: np.ndarray, degrees: np.ndarray) -> None:
    expected = np.stack([turn_matrix(row) for row in degrees])
    np.testing.assert_allclose(Rotation.from_rotvec(vectors).as_matrix(), expected, atol=1e-6)


def notes(motion: Driving) -> str:
    return "\n".join(motion.notes)


def test_the_52_names():
    assert len(set(ARKIT_NAMES)) == 52
    assert list(ARKIT_NAMES) == sorted(camel(name) for name in ARKIT_ORDER)


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        ("EyeBlinkLeft", "eyeBlinkLeft"),
        ("eyeBlink_L", "eyeBlinkLeft"),
        ("blendShapes.EyeBlinkRight", "eyeBlinkRight"),
        ("eye_blink_right", "eyeBlinkRight"),
        ("JAWOPEN", "jawOpen"),
        ("MouthLeft", "mouthLeft"),
        ("mouth_L", None),
        ("_neutral", None),
        ("cheekRaiser_L", None),
        ("", None),
    ],
)
def test_spellings(spelling, name):
    assert arkit_name(spelling) == name


@pytest.mark.parametrize("count", ["BlendShapeCount", "BlendshapeCount"])
def test_live_link_csv(tmp_path, count):
    """★ Names are PascalCase, and the count column is spelled in two ways."""
    made = face()
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", made, count=count))
    assert_weights(motion, made)
    assert motion.fps == 60.0


def test_live_link_columns_in_another_order(tmp_path):
    """★ JawLeft and JawRight are exchanged between versions: columns go by their names."""
    made = face()
    order = [name.upper() for name in reversed(ARKIT_ORDER)]
    columns = {name.upper(): name for name in ARKIT_ORDER}
    path = write.write_live_link(tmp_path / "take.csv", made, order=[columns[name] for name in order])
    assert_weights(read_driving(path), made)
    text = path.read_text()
    for name in ARKIT_ORDER:
        text = text.replace(f",{name},", f", {name.upper()} ,", 1)
    path.write_text(text)
    assert_weights(read_driving(path), made)


@pytest.mark.parametrize("degrees", [False, True])
def test_live_link_head_and_eyes_turn_the_right_way(tmp_path, degrees):
    """★ Yaw to the subject's left, pitch downwards, roll with the left ear up; radians or degrees, which is said."""
    made = face()
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", made, degrees=degrees))
    assert_turned(motion.neck_pose, made.head)
    assert_turned(motion.eyes_pose[:, :3], made.left_eye)
    assert_turned(motion.eyes_pose[:, 3:], made.right_eye)
    assert not motion.rotation.any()
    assert f"taken as {'degrees' if degrees else 'radians'}" in notes(motion)


def test_live_link_without_angles(tmp_path):
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", face(), angles=False))
    assert not motion.neck_pose.any()
    assert not motion.eyes_pose.any()
    assert "taken as" not in notes(motion)


@pytest.mark.parametrize(("rate", "expected"), [(60, 60.0), (30, 30.0), (24, 24.0), (25, 25.0)])
def test_time_codes_count_at_the_rate_that_they_show(tmp_path, rate, expected):
    """★ FF counts frames at 60 or at 30, and the file does not say which."""
    made = face(2 * rate + 1)
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", made, rate=rate))
    assert motion.fps == expected
    assert_weights(motion, made)


def test_time_codes_of_every_second_frame(tmp_path):
    """At 60 in a second with even frames only, there are 30 frames per second."""
    made = face(70)
    frames = [2.0 * t for t in range(70)]
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", made, frames=frames))
    assert motion.fps == 30.0
    assert_weights(motion, made)


def test_time_codes_across_midnight(tmp_path):
    """★ 23:59:59 is followed by 00:00:00."""
    made = face(150)
    path = write.write_live_link(tmp_path / "take.csv", made, start="23:59:58")
    assert ",61," in path.read_text().splitlines()[-1]
    assert path.read_text().splitlines()[-1].startswith("00:00:00")
    motion = read_driving(path)
    assert_weights(motion, made)
    assert motion.fps == 60.0


def test_a_short_recording_does_not_show_its_rate(tmp_path):
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", face(20)))
    assert motion.fps == 60.0
    assert "60 is assumed" in notes(motion)


def test_irregular_time_stamps_are_resampled(tmp_path):
    """Frames that the phone dropped come back between their neighbours; rotations stay rotations."""
    made = face(121)
    kept = [t for t in range(121) if t % 7 not in (3, 4)]
    part = Face(
        {name: values[kept] for name, values in made.weights.items()},
        made.head[kept],
        made.left_eye[kept],
        made.right_eye[kept],
    )
    path = write.write_live_link(tmp_path / "take.csv", part, frames=[float(t) for t in kept])
    motion = read_driving(path)
    assert_weights(motion, made, atol=2e-3)
    assert np.abs(motion.neck_pose - Rotation.from_matrix([turn_matrix(r) for r in made.head]).as_rotvec()).max() < 1e-3
    assert f"{len(kept)} frames at irregular times, up to 0.05 s apart, are resampled to 121" in notes(motion)


def test_frames_without_a_face_are_filled(tmp_path):
    """★ Where the app loses the face, it writes a count of 0 and no values."""
    made = face(90)
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", made, lost=(0, 40, 41)))
    assert len(motion) == 90
    np.testing.assert_array_equal(motion.expr[0], motion.expr[1])
    assert np.abs(motion.expr[40] - [made.weights[name][40] for name in motion.expr_names]).max() < 1e-2
    assert "3 of 90 frames have no face" in notes(motion)


def test_lam_json(tmp_path):
    """★ Names, metadata.fps, and frames of weights."""
    made = face()
    for times in (True, False):
        motion = read_driving(write.write_lam(tmp_path / "a.json", made, times=times))
        assert_weights(motion, made)
        assert motion.fps == 30.0
        assert motion.notes == ()


def test_audio2face_csv(tmp_path):
    """★ A nameless column, timeCode in seconds, blendShapes.<Name>; also timecode and plain names."""
    made = face(40)
    motion = read_driving(write.write_audio2face_csv(tmp_path / "animation_frames.csv", made))
    assert_weights(motion, made, without=("tongueOut",))
    assert (motion.fps, motion.notes) == (30.0, ())
    motion = read_driving(write.write_audio2face_output(tmp_path / "output_blendshape.csv", made))
    assert_weights(motion, made)
    assert (motion.fps, motion.notes) == (60.0, ())


def test_audio2face_json(tmp_path):
    """★ exportFps, facsNames, weightMat."""
    made = face()
    motion = read_driving(write.write_audio2face_json(tmp_path / "a.json", made, fps=24.0))
    assert_weights(motion, made)
    assert motion.fps == 24.0


@pytest.mark.parametrize("style", ["categories", "python", "javascript", "lines"])
def test_mediapipe_dumps(tmp_path, style):
    """★ ``_neutral`` comes first and is none, ``tongueOut`` is not there; the matrix turns the head."""
    made = face(40)
    motion = read_driving(write.write_mediapipe(tmp_path / "face.json", made, style=style))
    assert_weights(motion, made, without=("tongueOut",))
    assert motion.fps == 30.0
    if style == "categories":
        assert not motion.neck_pose.any()
        assert "30 per second are assumed" in notes(motion)
    else:
        assert_turned(motion.neck_pose, made.head)


def test_mediapipe_without_matrices_and_with_lost_faces(tmp_path):
    made = face(40)
    motion = read_driving(write.write_mediapipe(tmp_path / "face.json", made, matrices=False, lost=(7, 8)))
    assert len(motion) == 40
    assert not motion.neck_pose.any()
    assert "2 of 40 frames have no face" in notes(motion)
    motion = read_driving(write.write_mediapipe(tmp_path / "face.json", made, lost=(7,)))
    np.testing.assert_allclose(motion.neck_pose[7], (motion.neck_pose[6] + motion.neck_pose[8]) / 2, atol=1e-3)


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6])
def test_bare_time_stamps_of_any_unit(tmp_path, unit):
    frames = [
        {"timestamp": unit * t / 25.0, "blendshapes": {name: 0.1 * t for name in ARKIT_NAMES[:20]}} for t in range(6)
    ]
    (tmp_path / "a.json").write_text(json.dumps({"frames": frames}))
    motion = read_driving(tmp_path / "a.json")
    assert motion.fps == 25.0
    np.testing.assert_allclose(motion.expr[:, 0], 0.1 * np.arange(6), atol=1e-6)


def test_semicolons_and_decimal_commas(tmp_path):
    """Spreadsheets of many countries save tables so."""
    made = face()
    path = write.write_audio2face_csv(tmp_path / "a.csv", made)
    path.write_text("\ufeff" + path.read_text().replace(",", ";").replace("0.", "0,").replace("1.", "1,"))
    assert_weights(read_driving(path), made, without=("tongueOut",))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("0.5", "=1+1", "row 2, EyeBlinkLeft: '=1+1' is not a number"),
        ("0.5", "1_0", "'1_0' is not a number"),
        ("0.5", "", "'' is not a number"),
        ("0.5", "nan", "NaN, infinity or empty cells"),
        ("0.5", "1e999", "NaN, infinity or empty cells"),
        ("10:21:33:00.000", "10.5", "row 2, Timecode: '10.5' is not a time code"),
        ("10:21:33:00.000", "10:21:33:150.000", "count 150 frames in a second"),
        ("EyeWideLeft", "EyeBlinkLeft", "EyeBlinkLeft is there twice"),
    ],
)
def test_tables_that_are_wrong(tmp_path, old, new, words):
    made = face(3)
    made.weights["eyeBlinkLeft"][:] = 0.5
    path = write.write_live_link(tmp_path / "take.csv", made)
    path.write_text(path.read_text().replace("0.50000000", "0.5").replace(old, new, 1))
    assert words in refusal(path)


def test_a_pause_of_hours_is_not_filled(tmp_path):
    path = write.write_live_link(tmp_path / "take.csv", face(4), frames=[0.0, 1.0, 2.0, 60.0 * 7200.0])
    assert "cut the recording where it pauses" in refusal(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"names": list(ARKIT_NAMES), "frames": [{"weights": [0.0] * 51}]}, "frame 0: weights must be a list of 52"),
        ({"names": list(ARKIT_NAMES), "frames": [{"weights": [True] * 52}]}, "True is not a number"),
        ({"names": list(ARKIT_NAMES), "frames": []}, "no frames"),
        ({"names": list(ARKIT_NAMES), "frames": [{"weights": [0] * 52}], "metadata": {"fps": 0}}, "fps must be"),
        ({"facsNames": list(ARKIT_NAMES), "weightMat": [[0.0] * 3]}, "weightMat must be a list of rows of 52 numbers"),
        ({"facsNames": list(ARKIT_NAMES), "weightMat": [["0"] * 52]}, "weightMat, row 0: '0' is not a number"),
        ([{"blendshapes": {name: "a" for name in ARKIT_NAMES}}], "frame 0: scores: 'a' is not a number"),
        ([{"blendshapes": {name: 1e400 for name in ARKIT_NAMES}}], "NaN, infinity"),
        ([{"blendshapes": dict.fromkeys(ARKIT_NAMES, 1), "matrix": [0] * 16}], "is no rotation and translation"),
        ([{"blendshapes": dict.fromkeys(ARKIT_NAMES, 1), "matrix": [[1, 0]]}], "4x4 numbers are needed"),
        ({"people": [1, 2]}, "understood are"),
    ],
)
def test_json_that_is_wrong(tmp_path, content, words):
    (tmp_path / "a.json").write_text(json.dumps(content))
    assert words in refusal(tmp_path / "a.json")


def test_columns_that_are_none_of_arkits_are_said(tmp_path):
    names = [*ARKIT_NAMES[:20], "smirk"]
    (tmp_path / "a.json").write_text(json.dumps({"names": names, "frames": [{"weights": [50.0] * 21}] * 3}))
    said = notes(read_driving(tmp_path / "a.json"))
    assert "none of ARKit's blendshapes: smirk" in said
    assert "weights reach 50, and 1 is fully on" in said
