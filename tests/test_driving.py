"""Driving sequences: tolerant of what is missing, strict about what is wrong, careful with expressions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from captures import write_capture

from mgavatar.driving.motion import Driving
from mgavatar.driving.read import read_driving
from mgavatar.driving.retarget import driving_expression
from mgavatar.errors import DataError

RNG = np.random.default_rng(3)
NAMES = tuple("abcde")


def save(path: Path, **arrays: object) -> Path:
    np.savez(path, **arrays)
    return path


def refusal(action: Callable[[], object], *parts: str) -> None:
    """``action`` raises a ``DataError`` of one line that has all the parts."""
    with pytest.raises(DataError) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message, message


def driving(expr: np.ndarray, *, basis: str | None = None, names: tuple[str, ...] = ()) -> Driving:
    poses = {key: np.zeros((len(expr), 3), np.float32) for key in ("rotation", "neck_pose", "jaw_pose", "translation")}
    eyes = np.zeros((len(expr), 6), np.float32)
    return Driving(
        expr=expr.astype(np.float32),
        **poses,
        eyes_pose=eyes,
        fps=25.0,
        expr_basis=basis,
        expr_names=names,
        path=Path("seq.npz"),
    )


def expression(
    motion: Driving, *, n_expr: int = 5, basis: str = "unknown", names: tuple[str, ...] = (), mode: str = "auto"
) -> tuple[np.ndarray, str | None]:
    return driving_expression(motion, n_expr=n_expr, expr_basis=basis, expr_names=names, mode=mode)


def test_missing_keys_are_zero_and_float64_is_taken(tmp_path):
    jaw = RNG.normal(size=(7, 3))
    motion = read_driving(save(tmp_path / "seq.npz", jaw_pose=jaw, fps=30.0))
    assert len(motion) == 7
    assert motion.expr.shape == (7, 0)
    assert motion.eyes_pose.shape == (7, 6)
    assert not motion.neck_pose.any()
    assert motion.jaw_pose.dtype == np.float32
    np.testing.assert_array_equal(motion.jaw_pose, jaw.astype(np.float32))
    assert motion.fps == 30.0
    assert motion.notes == ()


def test_one_row_holds_for_all_frames(tmp_path):
    expr = RNG.normal(size=(6, 20)).astype(np.float32)
    motion = read_driving(
        save(tmp_path / "seq.npz", expr=expr, neck_pose=[[0.1, 0.2, 0.3]], translation=[0.0, 1.0, 0.0])
    )
    np.testing.assert_allclose(motion.neck_pose, np.tile([0.1, 0.2, 0.3], (6, 1)), rtol=1e-6)
    np.testing.assert_array_equal(motion.translation[:, 1], 1.0)
    assert motion.fps == 25.0


@pytest.mark.parametrize("shape", [(4, 3), (4, 1, 3), (1, 4, 3)])
def test_single_axes_are_dropped(tmp_path, shape):
    rotation = RNG.normal(size=(4, 3))
    motion = read_driving(save(tmp_path / "seq.npz", rotation=rotation.reshape(shape)))
    np.testing.assert_allclose(motion.rotation, rotation, rtol=1e-6)


def test_unknown_keys_are_noted_and_identity_is_not(tmp_path):
    path = save(tmp_path / "seq.npz", expr=np.ones((2, 4)), shape=np.ones(300), lights=np.ones(9), zoom=1.0)
    assert read_driving(path).notes == (f"{path}: not used: lights, zoom",)


def test_names_and_basis(tmp_path):
    motion = read_driving(
        save(tmp_path / "a.npz", expr=np.ones((2, 5)), expr_basis="flame2023", expr_names=list("abcde"))
    )
    assert (motion.expr_basis, motion.expr_names) == ("flame2023", NAMES)
    assert read_driving(save(tmp_path / "b.npz", expr=np.ones((2, 5)), expr_basis="unknown")).expr_basis is None


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"expr": np.ones((5, 4)), "jaw_pose": np.ones((3, 3))}, "jaw_pose has 3 frames but expr has 5"),
        ({"expr": np.full((5, 4), np.nan)}, "expr holds 20 values that are NaN"),
        ({"rotation": np.full((5, 3), 1e300)}, "rotation holds 15 values that are NaN or infinite"),
        ({"rotation": np.ones((5, 3, 3))}, "rotation has shape (5, 3, 3), (T, 3) is needed: rotation vectors"),
        ({"eyes_pose": np.ones((5, 3))}, "eyes_pose has shape (5, 3), (T, 6)"),
        ({"expr": np.ones((0, 4))}, "expr has shape (0, 4)"),
        ({"expr": np.array(["a"])}, "numbers are needed"),
        ({"expr": np.array([None])}, "not plain numbers"),
        ({"lights": np.ones(3)}, "no motion in this file"),
        ({"expr": np.ones((5, 4)), "fps": 0.0}, "fps must be one positive number"),
        ({"expr": np.ones((5, 4)), "fps": np.ones(2)}, "fps must be one positive number"),
        ({"expr": np.ones((5, 4)), "expr_names": np.array(["a"])}, "expr_names has shape (1,), but expr has 4 columns"),
        ({"expr": np.ones((5, 4)), "expr_basis": 3}, "expr_basis must be one word"),
    ],
)
def test_refusals(tmp_path, arrays, words):
    path = save(tmp_path / "seq.npz", **arrays)
    refusal(lambda: read_driving(path), f"{path}: ", words)


def test_wrong_paths(tmp_path):
    refusal(lambda: read_driving(tmp_path / "nothing.npz"), "nothing.npz: no such file")
    refusal(lambda: read_driving(tmp_path / "nothing"), "nothing: no such file")
    refusal(lambda: read_driving(tmp_path), f"{tmp_path}: no motion in this folder, which has no files")
    (tmp_path / "seq.npz").write_bytes(b"PK\x03\x04 not really")
    refusal(lambda: read_driving(tmp_path / "seq.npz"), "seq.npz: not a readable .npz file")


def test_folder_of_frames(tmp_path):
    """A capture's own motion, from its folder or from flame_param; frames in numerical order."""
    root = write_capture(tmp_path / "subject", n_timesteps=3)
    (root / "flame_param/00002.npz").rename(root / "flame_param/100000.npz")
    motion = read_driving(root)
    assert motion.expr.shape == (3, 10)
    with np.load(root / "flame_param/100000.npz") as last:
        np.testing.assert_array_equal(motion.neck_pose[2], last["neck_pose"][0])
    np.testing.assert_array_equal(read_driving(root / "flame_param").expr, motion.expr)


def test_folders_that_do_not_fit_together(tmp_path):
    save(tmp_path / "0.npz", expr=np.ones((1, 4)))
    save(tmp_path / "1.npz", expr=np.ones((1, 5)))
    refusal(lambda: read_driving(tmp_path), "1.npz: expr has 5 coefficients", "0.npz has 4")
    save(tmp_path / "1.npz", expr=np.ones((2, 4)))
    refusal(lambda: read_driving(tmp_path), "1.npz: has 2 frames")
    save(tmp_path / "1.npz", expr=np.ones((1, 4)), expr_basis="flame2020")
    refusal(lambda: read_driving(tmp_path), "1.npz: expr_basis or expr_names differ", "0.npz")


def test_use_cuts_and_pads():
    expr = RNG.normal(size=(3, 8))
    cut, note = expression(driving(expr), mode="use")
    np.testing.assert_array_equal(cut, expr[:, :5].astype(np.float32))
    assert note.startswith("seq.npz: expression columns 5 to 7 are ignored, because the head has 5; they reach ")
    expr[:, 5:] = 0.0
    assert expression(driving(expr), mode="use")[1] is None
    padded, note = expression(driving(expr), n_expr=10, mode="use")
    assert note is None
    np.testing.assert_array_equal(padded[:, 5:], 0.0)
    assert padded.dtype == np.float32


def test_ignore_and_nothing_to_use():
    for mode, expr in (("ignore", np.ones((3, 8))), ("auto", np.zeros((3, 8))), ("use", np.zeros((3, 0)))):
        result, note = expression(driving(expr), mode=mode)
        np.testing.assert_array_equal(result, np.zeros((3, 5)))
        assert note is None


def test_auto_matches_by_name():
    expr = np.arange(1.0, 7.0).reshape(2, 3)
    result, note = expression(driving(expr, basis="other", names=("c", "a", "x")), names=NAMES, basis="procedural")
    np.testing.assert_array_equal(result, [[2, 0, 1, 0, 0], [5, 0, 4, 0, 0]])
    assert note == "seq.npz: 1 of 3 expressions are not the head's: x"
    assert expression(driving(expr, names=("c", "a", "b")), names=NAMES)[1] is None


def test_auto_with_a_basis_in_the_file():
    motion = driving(np.ones((2, 5)), basis="flame2023")
    assert expression(motion, basis="flame2023")[0].all()
    result, note = expression(motion, basis="flame2020")
    assert not result.any()
    assert note == (
        "seq.npz: its expression is ignored, because its basis is flame2023 and the head's is flame2020; "
        "--expression use takes it as it is"
    )


def test_auto_without_a_basis_in_the_file():
    """FLAME heads take it; others only if the file visibly ends where the head ends."""
    filled = driving(np.ones((2, 8)))
    assert expression(filled, basis="flame2020")[0].all()
    result, note = expression(filled, basis="unknown")
    assert not result.any()
    assert "--expression use" in note
    made_for_head = np.ones((2, 8))
    made_for_head[:, 5:] = 0.0
    assert expression(driving(made_for_head), basis="unknown")[0].all()
    assert not expression(driving(made_for_head), basis="procedural")[0].any()
    assert not expression(driving(np.ones((2, 4))), basis="unknown")[0].any()


def test_real_sequences(real_data):
    """ARKit curves were made for the sample head; FLAME sequences were not."""
    arkit = read_driving(real_data / "driving/arkit_ict.npz")
    assert (len(arkit), arkit.fps) == (973, 30.0)
    result, note = expression(arkit, n_expr=57)
    assert note is None
    np.testing.assert_array_equal(result, arkit.expr[:, :57])
    for name, n_frames in (("seq_a", 515), ("seq_b", 402), ("seq_c", 518)):
        motion = read_driving(real_data / f"driving/{name}.npz")
        assert len(motion) == n_frames
        result, note = expression(motion, n_expr=57)
        assert not result.any()
        assert f"{name}.npz: its expression is ignored" in note
        result, note = expression(motion, n_expr=100, basis="flame2023")
        assert note is None
        np.testing.assert_array_equal(result, motion.expr)
