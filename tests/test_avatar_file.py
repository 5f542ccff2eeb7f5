"""The avatar file: it comes back bit for bit, and whatever else it is handed is refused in one line."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny import tiny_personal_head, tiny_resolved

from mgavatar.appearance.model import build_appearance
from mgavatar.avatar import Avatar
from mgavatar.avatar_file import FORMAT
from mgavatar.camera import Camera, look_at
from mgavatar.capture.info import CaptureInfo
from mgavatar.capture.subject import Subject
from mgavatar.errors import DataError
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.head.params import HeadParams, Pose

Payload = dict[str, Any]


def disturb(module: torch.nn.Module) -> None:
    """Take every number off its start."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.05 * torch.randn_like(parameter)


def make_avatar(subject: Subject, *, n_gaussians: int | None) -> Avatar:
    """An avatar of which no part is at its start; without Gaussians on faces it is the geometry stage's."""
    config = tiny_resolved()
    head = tiny_personal_head(subject, config)
    vertex_gaussians = VertexGaussians(head, config)
    disturb(vertex_gaussians)
    bound = None
    if n_gaussians is not None:
        bound = build_appearance(head, config, seed=0)
        bound.resize(n_gaussians)
        bound.gaussians.face_ids = torch.arange(n_gaussians) % len(head.body.faces)
        with torch.no_grad():
            bound.gaussians.quats[:, 0] = 1.0
            bound.gaussians.log_scales -= 1.0
        disturb(bound)
        bound.rebind()
    return Avatar(vertex_gaussians, bound, CaptureInfo.of(subject), config)


@pytest.fixture(scope="module")
def avatar(subject) -> Avatar:
    """More Gaussians than faces, as after density control."""
    return make_avatar(subject, n_gaussians=400)


@pytest.fixture(scope="module")
def saved(avatar, tmp_path_factory) -> Path:
    """Its file."""
    path = tmp_path_factory.mktemp("avatar") / "avatar.pt"
    avatar.save(path)
    return path


def poses(avatar: Avatar, subject: Subject) -> list[Pose]:
    """As fitted, and as tracked in a timestep that was held out."""
    return [avatar.head.pose(0), subject.params.pose(len(subject.params) - 1, n_expr=avatar.head_model.n_expr)]


def assert_same_images(a: Avatar, b: Avatar, subject: Subject) -> None:
    """Every bit of what is drawn, from a training camera and from elsewhere."""
    cameras = [a.capture.mean_camera(), look_at([0.3, 0.4, 0.8], [0, 0, 0], focal=60.0, width=37, height=29)]
    for pose in poses(a, subject):
        for camera in cameras:
            one, other = a.render(pose, camera), b.render(pose, camera)
            assert one.alphas.max() > 0.5
            for name in ("image", "alphas", "depths"):
                assert torch.equal(getattr(one, name), getattr(other, name)), name
        assert torch.equal(a.verts(pose), b.verts(pose))


def test_a_loaded_avatar_draws_the_same_bits(avatar, saved, subject):
    """Nothing that drawing needs is missing from the file, and nothing is rounded."""
    loaded = Avatar.load(saved)
    assert loaded.n_gaussians == avatar.n_gaussians == 400
    assert loaded.config == avatar.config
    assert_same_images(avatar, loaded, subject)


def test_an_avatar_of_the_geometry_stage_alone(subject, tmp_path):
    """What an early Ctrl-C leaves: its vertex-bound Gaussians are drawn."""
    avatar = make_avatar(subject, n_gaussians=None)
    avatar.save(tmp_path / "early.pt")
    loaded = Avatar.load(tmp_path / "early.pt")
    assert loaded.appearance is None
    assert loaded.n_gaussians == loaded.head.body.n_verts
    assert_same_images(avatar, loaded, subject)


def test_a_second_save_is_the_same(saved, tmp_path):
    """Loading and saving again loses nothing."""
    Avatar.load(saved).save(tmp_path / "again.pt")
    first, second = (torch.load(path, weights_only=True) for path in (saved, tmp_path / "again.pt"))
    assert first.keys() == second.keys()
    for part in ("head", "geometry", "appearance"):
        assert first[part].keys() == second[part].keys()
        for name, value in first[part].items():
            other = second[part][name]
            assert torch.equal(value, other) if isinstance(value, torch.Tensor) else value == other, name
    assert first["config"] == second["config"]


def test_the_file_holds_tensors_and_plain_types_only(saved):
    """Torch's safe loader reads it, so opening a stranger's avatar runs nothing."""
    payload = torch.load(saved, weights_only=True)
    assert payload["format"] == FORMAT

    def check(value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                assert isinstance(key, str)
                check(inner)
        elif isinstance(value, list):
            for inner in value:
                check(inner)
        else:
            assert value is None or isinstance(value, torch.Tensor | str | int | float | bool), type(value)

    check(payload)


def test_the_file_needs_neither_the_capture_nor_the_head_model(saved, avatar, subject):
    """Cameras, parameters, head and configuration travel inside."""
    loaded = Avatar.load(saved)
    capture = loaded.capture
    assert capture.timestep_ids == subject.timestep_ids
    assert capture.train_timesteps == (0, 1, 2)
    assert set(capture.cameras) == {frame.camera_id for frame in subject.frames["train"]}
    for frame in subject.frames["train"]:
        camera = capture.cameras[frame.camera_id]
        assert np.array_equal(camera.viewmat, frame.camera.viewmat)
        assert np.array_equal(camera.K, frame.camera.K)
        assert (camera.width, camera.height) == (frame.camera.width, frame.camera.height)
    assert np.array_equal(capture.tracked.expr, subject.params.expr)
    assert np.array_equal(capture.background, subject.background)
    for name in ("v_template", "faces", "shapedirs", "posedirs", "J_regressor", "lbs_weights", "vt", "ft"):
        assert np.array_equal(getattr(loaded.head_model, name), getattr(avatar.head_model, name)), name
    assert loaded.head_model.expr_names == avatar.head_model.expr_names
    assert loaded.head_model.expr_basis == avatar.head_model.expr_basis


def test_nothing_of_a_loaded_avatar_learns(saved):
    """It is there to be drawn."""
    loaded = Avatar.load(saved)
    assert not any(p.requires_grad for p in loaded.vertex_gaussians.parameters())
    assert not any(p.requires_grad for p in loaded.appearance.parameters())


def test_saving_is_atomic(avatar, saved, tmp_path, monkeypatch):
    """If writing fails half-way, the avatar that was there is still there, and no debris is."""
    path = tmp_path / "avatar.pt"
    path.write_bytes(saved.read_bytes())

    def half(payload: object, file: Any) -> None:
        file.write(b"half an avatar")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mgavatar.avatar_file.torch.save", half)
    with pytest.raises(DataError, match=r"avatar\.pt: cannot be written"):
        avatar.save(path)
    assert path.read_bytes() == saved.read_bytes()
    assert [entry.name for entry in tmp_path.iterdir()] == ["avatar.pt"]


def test_the_mean_camera_is_the_one_in_the_middle():
    """Of the training cameras, the nearest to their mean position."""
    cameras = {i: look_at([x, 0.0, 1.0], [x, 0, 0], focal=10.0, width=8, height=8) for i, x in enumerate([-1, 0.1, 2])}
    params = HeadParams.neutral(n_frames=1, n_expr=3)
    assert CaptureInfo(params, (0,), (0,), cameras, np.ones(3)).mean_camera() is cameras[1]


def assert_refused(path: Path) -> str:
    """One line that begins with the file."""
    with pytest.raises(DataError) as error:
        Avatar.load(path)
    message = str(error.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


def test_a_missing_file_is_refused(tmp_path):
    """And a folder that is not that of a fit."""
    assert "no such file" in assert_refused(tmp_path / "absent.pt")
    assert "avatar.pt: no such file" in assert_refused(tmp_path)


class Evil:
    """Unpickling it would leave a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("kind", ["empty", "text", "truncated", "cut short", "tensor", "other dict", "pickle", "zip"])
def test_what_is_not_an_avatar_is_refused(kind, saved, tmp_path):
    """Whatever file it is, the message says so and what to give instead."""
    path = tmp_path / "x.pt"
    whole = saved.read_bytes()
    if kind == "tensor":
        torch.save(torch.zeros(3), path)
    elif kind == "other dict":
        torch.save({"state_dict": {"a": torch.zeros(1)}}, path)
    elif kind == "zip":
        np.savez(path.with_suffix(".npz"), a=np.zeros(2))
        path = path.with_suffix(".npz")
    else:
        contents = {
            "empty": b"",
            "text": b"this is no avatar\n",
            "truncated": whole[: len(whole) // 2],
            "cut short": whole[:-1000],
            "pickle": pickle.dumps({"format": FORMAT}),
        }
        path.write_bytes(contents[kind])
    assert_refused(path)


def test_a_file_with_code_in_it_is_not_run(tmp_path):
    """A pickle that would execute something is refused before it does."""
    path, trace = tmp_path / "evil.pt", tmp_path / "trace"
    torch.save({"format": FORMAT, "x": Evil(trace)}, path)
    assert_refused(path)
    assert not trace.exists()


def change(*keys: str, to: Any) -> Callable[[Payload], None]:
    """A change of one entry; ``to`` is a value, or a function of the old one."""

    def apply(payload: Payload) -> None:
        for key in keys[:-1]:
            payload = payload[key]
        old = payload[keys[-1]]
        payload[keys[-1]] = to(old) if callable(to) else to

    return apply


def drop(*keys: str) -> Callable[[Payload], None]:
    """Remove one entry."""

    def apply(payload: Payload) -> None:
        for key in keys[:-1]:
            payload = payload[key]
        del payload[keys[-1]]

    return apply


def first_is(value: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """The same tensor with another first number."""

    def apply(tensor: torch.Tensor) -> torch.Tensor:
        tensor = tensor.clone()
        tensor.view(-1)[0] = value
        return tensor

    return apply


NAN, INF = float("nan"), float("inf")
DAMAGE: dict[str, Callable[[Payload], None]] = {
    "another format": change("format", to="mgavatar/99"),
    "no config": drop("config"),
    "unknown key in the config": change("config", to=lambda c: {**c, "wings": 2}),
    "config of another size": change("config", "geometry", "hidden", to=17),
    "impossible config": change("config", "geometry", "triplane_resolution", to=10**6),
    "config that is a list": change("config", to=[1, 2]),
    "no head": drop("head"),
    "no faces": drop("head", "f"),
    "faces out of range": change("head", "f", to=first_is(10**6)),
    "negative faces": change("head", "f", to=first_is(-1)),
    "NaN in the template": change("head", "v_template", to=first_is(NAN)),
    "template of another size": change("head", "v_template", to=lambda t: t[:-1]),
    "texture faces out of range": change("head", "ft", to=first_is(10**6)),
    "joints in a circle": change("head", "kintree_table", to=lambda t: t.roll(1, 1)),
    "no capture": drop("capture"),
    "no cameras": drop("capture", "viewmats"),
    "NaN in a camera": change("capture", "viewmats", to=first_is(NAN)),
    "infinite focal length": change("capture", "Ks", to=first_is(INF)),
    "fewer cameras than names": change("capture", "viewmats", to=lambda t: t[:-1]),
    "cameras of another shape": change("capture", "Ks", to=lambda t: t[:, :2, :2]),
    "images without pixels": change("capture", "sizes", to=lambda s: [[0, 40] for _ in s]),
    "no expression": change("capture", "tracked", "expr", to=None),
    "NaN in the expression": change("capture", "tracked", "expr", to=first_is(NAN)),
    "fewer timesteps": change("capture", "tracked", "expr", to=lambda t: t[:-1]),
    "timesteps that are not there": change("capture", "train_timesteps", to=[0, 99]),
    "background of two colours": change("capture", "background", to=[1.0, 0.0]),
    "no geometry": drop("geometry"),
    "no identity": drop("geometry", "head.betas"),
    "NaN in the identity": change("geometry", "head.betas", to=first_is(NAN)),
    "planes of another shape": change("geometry", "head.refine.planes", to=lambda t: t[:2]),
    "doubles": change("geometry", "log_scales", to=lambda t: t.double()),
    "a word for a tensor": change("geometry", "colors", to="red"),
    "no gaussians": drop("appearance", "gaussians.local_means"),
    "no face ids": drop("appearance", "gaussians.face_ids"),
    "face ids out of range": change("appearance", "gaussians.face_ids", to=first_is(10**6)),
    "negative face ids": change("appearance", "gaussians.face_ids", to=first_is(-1)),
    "fewer face ids": change("appearance", "gaussians.face_ids", to=lambda t: t[:-1]),
    "face ids that are no integers": change("appearance", "gaussians.face_ids", to=lambda t: t.float()),
    "fewer means": change("appearance", "gaussians.local_means", to=lambda t: t[:-1]),
    "infinite opacity": change("appearance", "gaussians.opacity_logits", to=first_is(INF)),
    "NaN in the texture coordinates": change("appearance", "gaussians.uvs", to=first_is(NAN)),
    "NaN in the hash table": change("appearance", "color_net.grid.table", to=first_is(NAN)),
    "hash table of another size": change("appearance", "color_net.grid.table", to=lambda t: t[:-64]),
    "no OffsetNet": drop("appearance", "offset_net.last.weight"),
    "another number of Gaussians": change("n_gaussians", to=lambda n: n + 1),
    "a number of Gaussians that is a word": change("n_gaussians", to="many"),
    "an appearance that is a list": change("appearance", to=[1, 2, 3]),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_avatar_is_refused(damage, saved, tmp_path):
    """Missing, misshapen, not finite or out of range: one line, before any kernel sees it."""
    payload = torch.load(saved, weights_only=True)
    DAMAGE[damage](payload)
    path = tmp_path / "damaged.pt"
    torch.save(payload, path)
    assert_refused(path)


def test_a_newer_format_is_named(saved, tmp_path):
    """The user learns that another version is needed, not that the file is broken."""
    payload = torch.load(saved, weights_only=True)
    payload["format"] = "mgavatar/99"
    torch.save(payload, tmp_path / "new.pt")
    message = assert_refused(tmp_path / "new.pt")
    assert "mgavatar/99" in message
    assert FORMAT in message


def test_what_only_the_optimizer_needs_may_be_absent(saved, subject, avatar):
    """Moments are left out of the file, and it is no larger for them."""
    names = torch.load(saved, weights_only=True)["appearance"]
    assert not any(name.endswith(("exp_avg", "exp_avg_sq")) for name in names)
    assert any("exp_avg" in name for name in avatar.appearance.state_dict())


def test_the_camera_of_the_capture_is_a_camera(saved):
    """Types come back, not only numbers."""
    capture = Avatar.load(saved).capture
    assert all(isinstance(camera, Camera) for camera in capture.cameras.values())
    assert all(isinstance(index, int) for index in capture.cameras)
