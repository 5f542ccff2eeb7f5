"""The head model of a capture: where it is looked for, in which order, and what is said if it is not there."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ball_head import ball_head
from captures import write_capture
from flame_pickles import dump, flame_content

from mgavatar.errors import DataError
from mgavatar.head.find import find_head_model, resolve_head_model
from mgavatar.head.load import save_head_model
from mgavatar.head.model import HeadModel
from mgavatar.head.procedural.build import build_head

BALL = ball_head()
FLAME = ball_head(n_shape=300, n_expr=100)


@pytest.fixture(autouse=True)
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MGAVATAR_HEAD_MODEL", raising=False)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "capture", n_cameras=2, n_timesteps=2, size=(8, 8))


def name_head(capture: Path, name: object) -> None:
    """Write the key ``head_model`` into the capture's transforms."""
    path = capture / "transforms_train.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "head_model": name}))


def saved(path: Path, head: HeadModel = BALL) -> Path:
    path.parent.mkdir(exist_ok=True, parents=True)
    save_head_model(path, head)
    return path


def flame_pickle(path: Path) -> Path:
    path.write_bytes(dump(flame_content(FLAME)))
    np.savez(path.with_name("flame_uv.npz"), vt=FLAME.vt, ft=FLAME.ft)
    return path


def refusal(capture: Path, text: str | None = None) -> str:
    """Return the one line that says why there is no head model."""
    with pytest.raises(DataError) as caught:
        resolve_head_model(text, capture)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_transforms_name_the_built_in_head(capture):
    name_head(capture, "builtin")
    saved(capture / "head_model.npz")  # the key comes first
    assert find_head_model(capture) is build_head()


def test_the_transforms_name_a_file_of_the_capture(capture):
    name_head(capture, "models/ball.npz")
    saved(capture / "models/ball.npz")
    saved(capture / "head_model.npz", build_head())
    assert find_head_model(capture).name == "ball.npz"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gone.npz", "gone.npz does not exist"),
        ("../outside.npz", "../outside.npz leads out of"),
        ("link.npz", "link.npz leads out of"),
        ("/outside.npz", "/outside.npz is absolute"),
        (["head_model.npz"], "is not a path"),
        ("", "is not a path"),
        ("images", "images is not a file"),
        ("canonical_flame_param.npz", "not a head model"),
    ],
)
def test_the_transforms_name_a_file_that_is_no_head_of_the_capture(capture, name, words):
    outside = saved(capture.parent / "outside.npz")
    (capture / "link.npz").symlink_to(outside)
    saved(capture / "head_model.npz")  # not taken instead of the one that is named
    name_head(capture, name)
    message = refusal(capture)
    assert words in message
    assert str(capture) in message


def test_the_file_beside_the_transforms(capture, monkeypatch):
    saved(capture / "head_model.npz")
    monkeypatch.setenv("MGAVATAR_HEAD_MODEL", "builtin")  # comes after the capture's own
    assert find_head_model(capture).name == "head_model.npz"


@pytest.mark.parametrize("name", ["generic_model.pkl", "flame2023.pkl", "flame2023_no_jaw.pkl", "FLAME_NEUTRAL.pkl"])
def test_flame_beside_the_transforms(capture, name):
    """Masks and landmarks, which come with FLAME, are not taken for it."""
    flame_pickle(capture / name)
    (capture / "FLAME_masks.pkl").write_bytes(dump({"face": np.arange(3)}))
    (capture / "flame_static_embedding.pkl").write_bytes(dump({"lmk_face_idx": np.arange(3)}))
    (capture / "notes.pkl").write_bytes(dump({}))
    assert (find_head_model(capture).name, find_head_model(capture).n_expr) == (name, 100)


def test_two_heads_beside_the_transforms(capture):
    flame_pickle(capture / "flame2023.pkl")
    saved(capture / "head_model.npz")
    message = refusal(capture)
    assert message.startswith(f"{capture}: flame2023.pkl and head_model.npz are head models; give --head-model")
    assert resolve_head_model(str(capture / "flame2023.pkl"), capture).name == "flame2023.pkl"


def test_the_environment(capture, monkeypatch):
    monkeypatch.setenv("MGAVATAR_HEAD_MODEL", "builtin")
    assert find_head_model(capture) is build_head()
    monkeypatch.setenv("MGAVATAR_HEAD_MODEL", str(saved(capture.parent / "mine.npz")))
    assert find_head_model(capture).name == "mine.npz"
    for variable in ("HOME", "USERPROFILE"):  # of Windows
        monkeypatch.setenv(variable, str(capture.parent))
    monkeypatch.setenv("MGAVATAR_HEAD_MODEL", "~/mine.npz")
    assert find_head_model(capture).name == "mine.npz"
    monkeypatch.setenv("MGAVATAR_HEAD_MODEL", str(capture / "gone.npz"))
    assert refusal(capture) == f"MGAVATAR_HEAD_MODEL: {capture / 'gone.npz'}: no such file"


@pytest.mark.parametrize("environment", [None, ""])
def test_nothing_names_a_head(capture, monkeypatch, environment):
    """The built-in head is not taken for a capture that does not name it."""
    if environment is not None:
        monkeypatch.setenv("MGAVATAR_HEAD_MODEL", environment)
    assert refusal(capture) == (
        f"{capture}: does not name its head model; give --head-model FILE (the FLAME .pkl or head .npz that it was "
        "tracked with), set MGAVATAR_HEAD_MODEL, or --head-model builtin for the built-in head"
    )


def test_transforms_that_hold_something_else(capture):
    (capture / "transforms_train.json").write_text("[1, 2]")
    assert "does not name its head model" in refusal(capture)
    (capture / "transforms_train.json").write_text("{")
    assert "transforms_train.json: not valid JSON" in refusal(capture)


def test_the_flag_comes_first(capture, monkeypatch):
    monkeypatch.setenv("MGAVATAR_HEAD_MODEL", str(capture / "gone.npz"))
    mine = saved(capture.parent / "mine.npz")
    assert resolve_head_model("builtin", capture) is build_head()
    assert resolve_head_model(str(mine), capture).name == "mine.npz"
    assert refusal(capture, str(capture / "gone.npz")) == f"{capture / 'gone.npz'}: no such file"


def test_another_head_than_the_capture_names(capture, caplog):
    """One line says so; the same head from elsewhere is welcome, and so is one in place of a damaged file."""
    name_head(capture, "head_model.npz")
    saved(capture / "head_model.npz")
    with caplog.at_level(logging.WARNING, "mgavatar"):
        resolve_head_model(str(saved(capture.parent / "copy.npz")), capture)
        assert not caplog.messages
        moved = saved(capture.parent / "moved.npz", replace(BALL, v_template=BALL.v_template * np.float32(1.1)))
        resolve_head_model(str(moved), capture)
        (warning,) = caplog.messages
        assert warning == f"{capture}: was tracked with head_model.npz; its parameters may pose moved.npz wrongly"
        (capture / "head_model.npz").write_bytes(b"damaged")
        resolve_head_model("builtin", capture)
        assert len(caplog.messages) == 1
