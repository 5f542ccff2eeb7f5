"""ARKit's blendshapes onto heads by the names of their directions, and maps in files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import motion_files as write
import numpy as np
import pytest
from ball_head import ball_head
from motion_files import Face, face

from mgavatar.driving.arkit import ARKIT_NAMES
from mgavatar.driving.expression_map import (
    JAW_OPEN,
    built_in_directions,
    map_by_names,
    read_expression_map,
    write_expression_map,
)
from mgavatar.driving.motion import Driving
from mgavatar.driving.read import read_driving
from mgavatar.driving.retarget import expression_on
from mgavatar.errors import DataError
from mgavatar.head.load import read_head_model
from mgavatar.head.model import HeadModel
from mgavatar.head.procedural.build import build_head

LEFT, RIGHT = slice(0, 3), slice(3, 6)


def only(name: str, *, n_frames: int = 2) -> Face:
    """A face with a single blendshape, fully on in its last frame."""
    zero = np.zeros((n_frames, 3))
    made = Face({other: np.zeros(n_frames) for other in ARKIT_NAMES}, zero, zero, zero)
    made.weights[name][-1] = 1.0
    return made


def driven(tmp_path: Path, name: str) -> Driving:
    return read_driving(write.write_lam(tmp_path / "a.json", only(name)))


def ict_like() -> HeadModel:
    """A ball whose directions have the names of ICT-FaceKit: ``_L`` and ``_R``, and symmetric ones in two halves."""
    sided = [name.replace("Left", "_L").replace("Right", "_R") for name in ARKIT_NAMES if name != "tongueOut"]
    sided = [
        {"jaw_L": "jawLeft", "jaw_R": "jawRight", "mouth_L": "mouthLeft", "mouth_R": "mouthRight"}.get(n, n)
        for n in sided
    ]
    names = [n for n in sided if n not in ("browInnerUp", "cheekPuff")]
    names += ["browInnerUp_L", "browInnerUp_R", "cheekPuff_L", "cheekPuff_R", "cheekRaiser_L"]
    head = ball_head(n_expr=len(names))
    return replace(head, expr_names=tuple(names), expr_basis="unknown")


def test_left_is_l_on_heads_with_arkits_names(tmp_path):
    """eyeBlinkLeft is eyeBlink_L, and nothing else moves."""
    head = ict_like()
    moved = expression_on(driven(tmp_path, "eyeBlinkLeft"), head)
    assert [head.expr_names[i] for i in np.flatnonzero(moved.expr[-1])] == ["eyeBlink_L"]
    assert moved.expr[-1].max() == 1.0
    assert moved.notes == ()


@pytest.mark.parametrize("name", ["browInnerUp", "cheekPuff"])
def test_symmetric_blendshapes_drive_both_sides(tmp_path, name):
    head = ict_like()
    moved = expression_on(driven(tmp_path, name), head)
    assert {head.expr_names[i] for i in np.flatnonzero(moved.expr[-1])} == {f"{name}_L", f"{name}_R"}
    own = build_head()
    moved = expression_on(driven(tmp_path, name), own)
    sides = {own.expr_names[i][-2:] for i in np.flatnonzero(moved.expr[-1])}
    assert sides == {"_L", "_R"}


def test_the_mouth_opens_once(tmp_path):
    """jawOpen goes into the head's direction, or else into the jaw joint, and never into both."""
    head = ict_like()
    moved = expression_on(driven(tmp_path, "jawOpen"), head)
    assert moved.expr[-1].sum() == 1.0
    assert not moved.jaw_pose.any()
    without = replace(head, expr_names=tuple("chew" if name == "jawOpen" else name for name in head.expr_names))
    for model in (without, build_head()):
        moved = expression_on(driven(tmp_path, "jawOpen"), model)
        assert not moved.expr.any()
        np.testing.assert_allclose(moved.jaw_pose[-1], [JAW_OPEN, 0.0, 0.0])


def test_a_closed_mouth_on_an_open_jaw(tmp_path):
    """mouthClose undoes jawOpen on the built-in head, and does not press a shut jaw into the skull."""
    made = only("jawOpen")
    made.weights["mouthClose"][:] = (1.0, 0.5)
    jaw = expression_on(read_driving(write.write_lam(tmp_path / "a.json", made)), build_head()).jaw_pose[:, 0]
    assert jaw[0] == 0.0
    assert 0.3 * JAW_OPEN < jaw[1] < 0.7 * JAW_OPEN


@pytest.mark.parametrize(
    ("name", "eye", "axis", "sign"),
    [
        ("eyeLookUpLeft", LEFT, 0, -1),
        ("eyeLookDownRight", RIGHT, 0, 1),
        ("eyeLookOutLeft", LEFT, 1, 1),  # to the subject's left, which is +x
        ("eyeLookInLeft", LEFT, 1, -1),
        ("eyeLookOutRight", RIGHT, 1, -1),
        ("eyeLookInRight", RIGHT, 1, 1),
    ],
)
def test_looks_turn_the_eyes(tmp_path, name, eye, axis, sign):
    """A positive turn about x looks down, one about y to the subject's left."""
    eyes = expression_on(driven(tmp_path, name), build_head()).eyes_pose[-1]
    assert np.sign(eyes[eye][axis]) == sign
    assert 0.3 < np.linalg.norm(eyes) < 0.7
    assert np.count_nonzero(eyes) == 1


def test_angles_of_the_eyes_take_the_place_of_looks(tmp_path):
    """Live Link Face has both; together they would turn the eyes twice."""
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", face(70)))
    np.testing.assert_array_equal(expression_on(motion, build_head()).eyes_pose, motion.eyes_pose)
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", face(70), angles=False))
    assert expression_on(motion, build_head()).eyes_pose.any()


def test_every_blendshape_but_the_tongue_moves_the_built_in_head():
    mapped = map_by_names(build_head())
    assert mapped.unmapped == ("tongueOut",)
    assert {name for table in built_in_directions().values() for name in table} <= set(build_head().expr_names)


def test_the_built_in_heads_left_and_right_mirror_each_other():
    head = build_head()
    mapped = map_by_names(head)
    directions = head.shapedirs[:, :, head.n_shape :]
    left = directions[:, :, :] @ mapped.expr[ARKIT_NAMES.index("mouthSmileLeft")]
    right = directions[:, :, :] @ mapped.expr[ARKIT_NAMES.index("mouthSmileRight")]
    moving = np.linalg.norm(left, axis=1) > 1e-3
    assert head.v_template[moving, 0].mean() > 0.01
    assert head.v_template[np.linalg.norm(right, axis=1) > 1e-3, 0].mean() < -0.01
    np.testing.assert_allclose(np.linalg.norm(left, axis=1).max(), np.linalg.norm(right, axis=1).max(), rtol=1e-3)
    for name, sign in (("mouthLeft", 1), ("mouthRight", -1), ("jawLeft", 1), ("jawRight", -1)):
        moved = directions @ mapped.expr[ARKIT_NAMES.index(name)]
        assert sign * moved[:, 0].sum() > 0.1, name


def test_what_a_head_lacks_is_said_if_the_motion_moves_it(tmp_path):
    made = only("tongueOut")
    motion = read_driving(write.write_lam(tmp_path / "a.json", made))
    (note,) = expression_on(motion, build_head()).notes
    assert note == f"{motion.path}: 1 of 52 expressions are not the head's: tongueOut"


def test_a_neutral_face_still_moves_jaw_and_eyes(tmp_path):
    motion = read_driving(write.write_live_link(tmp_path / "take.csv", face(70), angles=False))
    moved = expression_on(motion, build_head(), mode="ignore")
    assert not moved.expr.any()
    assert moved.jaw_pose.any()
    assert moved.eyes_pose.any()


def test_a_head_without_names_and_without_a_face_needs_a_map(tmp_path):
    with pytest.raises(DataError, match="give --expression-map FILE"):
        expression_on(driven(tmp_path, "jawOpen"), ball_head())


def test_motion_with_arkits_names_in_an_npz(tmp_path):
    """A file in VHAP's keys whose columns have these names is ARKit's, whatever their spelling."""
    names = [name[0].upper() + name[1:] for name in ARKIT_NAMES]
    np.savez(tmp_path / "a.npz", expr=np.eye(52), expr_names=names)
    moved = expression_on(read_driving(tmp_path / "a.npz"), build_head())
    np.testing.assert_allclose(moved.expr, map_by_names(build_head()).expr, atol=1e-6)


def test_maps_in_files(tmp_path):
    head = ict_like()
    mapped = map_by_names(head)
    write_expression_map(tmp_path / "map.npz", mapped)
    again = read_expression_map(tmp_path / "map.npz", n_expr=head.n_expr)
    assert again.names == mapped.names
    for key in ("expr", "jaw", "eyes", "residual_mm"):
        np.testing.assert_array_equal(getattr(again, key), getattr(mapped, key))


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
@pytest.mark.parametrize("rows", [51, 52])
def test_bare_maps_to_flame(tmp_path, suffix, rows):
    """51 or 52 rows by 103 columns: 100 expressions and the jaw, blendshapes in alphabetical order."""
    matrix = np.random.default_rng(0).normal(size=(rows, 103))
    save = np.save if suffix == ".npy" else np.savez
    save(tmp_path / f"map{suffix}", matrix)
    mapped = read_expression_map(tmp_path / f"map{suffix}", n_expr=100)
    assert mapped.names == ARKIT_NAMES[:rows]
    np.testing.assert_allclose(mapped.expr, matrix[:, :100], rtol=1e-6)
    np.testing.assert_allclose(mapped.jaw, matrix[:, 100:], rtol=1e-6)


def test_bare_maps_in_mediapipes_order(tmp_path):
    """``_neutral`` comes first and does nothing; there is no ``tongueOut``."""
    matrix = np.random.default_rng(0).normal(size=(52, 103))
    matrix[0] = 0.0
    np.save(tmp_path / "map.npy", matrix)
    mapped = read_expression_map(tmp_path / "map.npy", n_expr=100)
    assert mapped.names == ARKIT_NAMES[:51]
    np.testing.assert_allclose(mapped.expr, matrix[1:, :100], rtol=1e-6)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"names": ["jawOpen"], "expr": np.ones((1, 4))}, "expr has shape (1, 4), (1, 100) is needed"),
        ({"names": ["chew"], "expr": np.ones((1, 100))}, "chew is none of ARKit's blendshapes"),
        ({"names": ["jawOpen", "JawOpen"], "expr": np.ones((2, 100))}, "there twice"),
        ({"names": ["jawOpen"], "expr": np.full((1, 100), np.inf)}, "expr holds 100 values that are NaN"),
        ({"names": np.ones(3), "expr": np.ones((3, 100))}, "names must be a list of text"),
        ({"a": np.ones((50, 103))}, "has shape (50, 103); a map without names has 51 or 52 rows"),
        ({"a": np.ones((52, 103)), "b": np.ones(3)}, "no expression map"),
    ],
)
def test_maps_that_are_wrong(tmp_path, arrays, words):
    np.savez(tmp_path / "map.npz", **arrays)
    with pytest.raises(DataError) as caught:
        read_expression_map(tmp_path / "map.npz", n_expr=100)
    assert str(caught.value).startswith(str(tmp_path / "map.npz"))
    assert words in str(caught.value)


def test_arrays_that_are_no_arrays(tmp_path):
    (tmp_path / "map.npy").write_bytes(b"\x93NUMPY\x01\x00garbage")
    with pytest.raises(DataError, match=r"not a readable \.npy file"):
        read_expression_map(tmp_path / "map.npy", n_expr=100)
    data = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 103), }"
    (tmp_path / "map.npy").write_bytes(data.ljust(128) + b"\n")
    with pytest.raises(DataError, match="its header says otherwise"):
        read_expression_map(tmp_path / "map.npy", n_expr=100)


def test_the_same_clip_in_three_formats_drives_the_sample_head_alike(tmp_path, real_data):
    """Real curves, mapped by name onto the sample head, come back from the phone's, LAM's and MediaPipe's files."""
    head = read_head_model(real_data / "head_models/ict_head.npz")
    with np.load(real_data / "driving/arkit_ict.npz") as clip:
        expr = clip["expr"][100:220, : head.n_expr]
    mapped = map_by_names(head)
    column = {name: int(np.argmax(row)) for name, row in zip(mapped.names, mapped.expr, strict=True) if row.any()}
    zero = np.zeros((len(expr), 3))
    weights = {name: expr[:, column[name]] if name in column else np.zeros(len(expr)) for name in ARKIT_NAMES}
    made = Face(weights, zero, zero, zero)
    for path in (
        write.write_live_link(tmp_path / "a.csv", made, rate=30, angles=False),
        write.write_lam(tmp_path / "a.json", made),
        write.write_mediapipe(tmp_path / "b.json", made, matrices=False),
    ):
        moved = expression_on(read_driving(path), head)
        np.testing.assert_allclose(moved.expr, expr, atol=1e-6, err_msg=path.name)
        assert not moved.jaw_pose.any()
