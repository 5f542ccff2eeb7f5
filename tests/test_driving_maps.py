"""Maps from ARKit's blendshapes to heads whose directions have no names."""

from __future__ import annotations

from dataclasses import replace

import motion_files as write
import numpy as np
import pytest
from ball_head import ball_head
from motion_files import face
from tiny_avatar import tiny_avatar

from mgavatar import cli
from mgavatar.driving import map_expressions as computing
from mgavatar.driving.arkit import ARKIT_NAMES
from mgavatar.driving.expression_map import JAW_OPEN, ExpressionMap, map_by_names, read_expression_map
from mgavatar.driving.face_transfer import jaw_motion, register_face
from mgavatar.driving.map_expressions import kept_map, map_expressions, named_motion
from mgavatar.errors import DataError
from mgavatar.head.load import read_head_model, save_head_model
from mgavatar.head.model import HeadModel
from mgavatar.head.procedural.build import build_head


def directions(model: HeadModel) -> np.ndarray:
    return model.shapedirs[:, :, model.n_shape :].astype(np.float64)


def made(model: HeadModel, mapped: ExpressionMap, name: str) -> np.ndarray:
    """The motion of a head's vertices at one blendshape, fully on [m]."""
    row = mapped.names.index(name)
    return directions(model) @ mapped.expr[row] + jaw_motion(model, mapped.jaw[row])


def error(motion: np.ndarray, truth: np.ndarray) -> float:
    """The mean distance over the vertices that move, over their mean motion."""
    size = np.linalg.norm(truth, axis=1)
    moving = size > max(0.1 * size.max(), 2e-4)
    return float(np.linalg.norm(motion - truth, axis=1)[moving].mean() / size[moving].mean())


def stranger(*, seed: int = 1) -> HeadModel:
    """The built-in head as a statistical model: another person, whose directions are nameless mixtures."""
    head = build_head()
    rng = np.random.default_rng(seed)
    shape = head.shapedirs[:, :, : head.n_shape]
    mixture = np.linalg.qr(rng.normal(size=(head.n_expr, head.n_expr)))[0]
    return replace(
        head,
        v_template=(head.v_template + shape @ (0.5 * rng.normal(size=head.n_shape))).astype(np.float32),
        shapedirs=np.concatenate([shape, directions(head) @ mixture], axis=2).astype(np.float32),
        expr_names=(),
        expr_basis="unknown",
        name="stranger",
    )


@pytest.fixture(scope="module")
def mapped() -> tuple[HeadModel, ExpressionMap]:
    model = stranger()
    return model, map_expressions(model)


def test_the_map_has_all_blendshapes(mapped):
    model, found = mapped
    assert found.names == ARKIT_NAMES
    assert found.expr.shape == (52, model.n_expr)
    assert found.unmapped == ("tongueOut",)
    assert np.abs(found.expr).max() < 10.0


def test_mixtures_of_directions_make_the_same_faces(mapped):
    """The head's own vertices move as the built-in head's do, though it is another person."""
    model, found = mapped
    truth = named_motion(build_head())
    wanted = [name for name in truth if name not in ("jawOpen", "mouthClose")]
    largest = sorted(wanted, key=lambda name: -np.linalg.norm(truth[name], axis=1).max())[:30]
    errors = {name: error(made(model, found, name), truth[name]) for name in largest}
    assert np.mean(list(errors.values())) < 0.2, errors


def test_the_jaw_opens_in_its_joint_and_eyes_look_in_theirs(mapped):
    _, found = mapped
    row = ARKIT_NAMES.index("jawOpen")
    np.testing.assert_allclose(found.jaw[row], [JAW_OPEN, 0.0, 0.0])
    assert not found.expr[row].any()
    looks = [name for name, eyes in zip(found.names, found.eyes, strict=True) if eyes.any()]
    assert looks == [name for name in ARKIT_NAMES if name.startswith("eyeLook")]


def test_residuals_are_the_distance_from_the_carried_motion(mapped):
    """They are near zero where the directions can make the motion, and absent where nothing was measured."""
    _, found = mapped
    known = np.isfinite(found.residual_mm)
    assert {name for name, k in zip(found.names, known, strict=True) if not k} == {
        *(f"eyeLook{way}{side}" for way in ("In", "Out") for side in ("Left", "Right")),
        "tongueOut",
    }
    assert np.median(found.residual_mm[known]) < 0.5


def test_a_head_without_a_jaw(mapped):
    """Its jaw is in its expressions: jawOpen opens the mouth there."""
    model, _ = mapped
    weights = model.lbs_weights.copy()
    weights[:, 1] += weights[:, 2]
    weights[:, 2] = 0.0
    still = replace(model, lbs_weights=weights)
    found = map_expressions(still)
    assert not found.jaw.any()
    opened = made(still, found, "jawOpen")
    assert error(opened, named_motion(build_head())["jawOpen"]) < 0.3


def test_a_rig_keeps_its_own_directions():
    """A nameless copy of the built-in head is a rig: each blendshape finds the direction that was made for it."""
    head = build_head()
    found = map_expressions(replace(head, expr_names=(), expr_basis="unknown"))
    by_name = map_by_names(head)
    same = []
    for name, row, own in zip(ARKIT_NAMES, found.expr, by_name.expr, strict=True):
        single = np.flatnonzero(own)
        if len(single) == 1:
            same.append(np.array_equal(np.flatnonzero(row), single) and row[single[0]] == 1.0)
            assert row[single[0]] > 0.5, name
    assert np.mean(same) > 0.9


def test_the_sample_head_with_its_names_hidden(real_data):
    """Its names are the truth: at most 20 % of the motion on average, for each of the 30 largest blendshapes."""
    head = read_head_model(real_data / "head_models/ict_head.npz")
    found = map_expressions(replace(head, expr_names=()))
    truth = map_by_names(head)
    motion = {name: directions(head) @ truth.expr[row] for row, name in enumerate(ARKIT_NAMES)}
    largest = sorted(motion, key=lambda name: -np.linalg.norm(motion[name], axis=1).max())[:30]
    errors = {name: error(made(head, found, name), motion[name]) for name in largest}
    assert max(errors.values()) < 0.2, errors
    assert np.mean(list(errors.values())) < 0.05


def test_the_warp_carries_meeting_lids_to_meeting_lids():
    """Closed lids of the built-in head are closed on a head whose eyes are opened wider."""
    head = build_head()
    wide = head.v_template + 1.5 * sum(
        head.shapedirs[:, :, head.n_shape + head.expr_names.index(f"wide_{side}")] for side in "LR"
    )
    other = replace(head, v_template=wide.astype(np.float32), expr_names=())
    transfer = register_face(head, other)
    blink = transfer.carry(named_motion(head)["eyeBlinkLeft"])
    places = transfer.sample(wide.astype(np.float64))
    upper = np.argmin(blink[:, 1])
    assert blink[upper, 1] < named_motion(head)["eyeBlinkLeft"][:, 1].min() - 0.0005
    assert abs(places[upper, 0] - 0.031) < 0.01


@pytest.mark.parametrize("model", [ball_head(), replace(build_head(), v_template=build_head().v_template * [-1, 1, 1])])
def test_what_has_no_face_is_refused(model):
    with pytest.raises(DataError) as caught:
        map_expressions(model)
    assert "does not look like a head with a neutral face" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_map_is_kept_and_used_again(mapped, tmp_path, monkeypatch):
    """It is computed once; a file of another head or a damaged one is replaced; a place that refuses it is no error."""
    model, found = mapped
    calls = []

    def compute(head: HeadModel) -> ExpressionMap:
        calls.append(head)
        return found

    monkeypatch.setattr(computing, "computed_map", compute)
    path = tmp_path / "avatar.expression_map.npz"
    again, note = kept_map(model, path)
    assert again is found
    assert str(path) in note
    again, note = kept_map(model, path)
    assert note is None
    np.testing.assert_array_equal(again.expr, found.expr)
    assert len(calls) == 1
    kept_map(stranger(seed=2), path)
    assert len(calls) == 2
    path.write_bytes(b"PK damaged")
    kept_map(model, path)
    assert len(calls) == 3
    _, note = kept_map(model, tmp_path / "nowhere" / "map.npz")
    assert "computed, but not kept" in note


def test_a_phones_recording_drives_a_head_without_names(mapped, tmp_path, monkeypatch, capsys):
    """The commands: a map in a file, a map kept beside the avatar, and a map that does not fit."""
    model, found = mapped
    monkeypatch.setattr(computing, "map_expressions", lambda head, progress=None: found)
    save_head_model(tmp_path / "head.npz", model)
    cli.map_expressions(head_model=str(tmp_path / "head.npz"), out=tmp_path / "map.npz")
    assert "mouthSmileLeft" in capsys.readouterr().out
    assert read_expression_map(tmp_path / "map.npz", n_expr=model.n_expr).unmapped == ("tongueOut",)
    avatar, _ = tiny_avatar(tmp_path, model=model)
    avatar.save(tmp_path / "out.pt")
    take = write.write_live_link(tmp_path / "take.csv", face(3))
    cli.render(avatar=tmp_path / "out.pt", driving=take, out=tmp_path / "a", device="cpu")
    assert "computed and kept in" in capsys.readouterr().err
    assert (tmp_path / "out.expression_map.npz").exists()
    cli.render(avatar=tmp_path / "out.pt", driving=take, out=tmp_path / "b", expression_map=tmp_path / "map.npz")
    first, second = ([path.read_bytes() for path in sorted((tmp_path / name).glob("*.png"))] for name in "ab")
    assert first == second
    assert len(first) == 3
    np.save(tmp_path / "bad.npy", np.ones((4, 4)))
    with pytest.raises(DataError, match=r"bad\.npy: has shape \(4, 4\)"):
        cli.render(avatar=tmp_path / "out.pt", driving=take, out=tmp_path / "c", expression_map=tmp_path / "bad.npy")
    with pytest.raises(DataError, match=r"must end in \.npz"):
        cli.map_expressions(head_model="builtin", out=tmp_path / "map.txt")
