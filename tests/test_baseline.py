"""The field's recipe and the ablations: spherical harmonics, tuning of the tracked parameters, parts switched off."""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from tiny import run, tiny_config, tiny_head, tiny_personal_head, tiny_resolved

from mgavatar.appearance.model import build_appearance
from mgavatar.appearance.spherical_harmonics import sh_basis, sh_colors
from mgavatar.appearance.stage import AppearanceStage
from mgavatar.avatar import Avatar
from mgavatar.capture.info import CaptureInfo
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, HeadTuningConfig, OffsetNetConfig, ShConfig
from mgavatar.errors import DataError
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.stage import GeometryStage
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.head.body import Body
from mgavatar.presets import preset as read_preset
from mgavatar.presets import preset_table

BASELINE = {
    "colors": "sh",
    "sh": ShConfig(lr=2e-2),
    "offset_net": OffsetNetConfig(enabled=False),
    "head_tuning": HeadTuningConfig(enabled=True, lr_translation=1e-3),
}


def make_stage(subject: Subject, config: FitConfig) -> AppearanceStage:
    """An appearance stage on the mesh as tracked."""
    head = tiny_personal_head(subject, config)
    return AppearanceStage(build_appearance(head, config, seed=0), config, seed=0)


def fibonacci(n: int) -> torch.Tensor:
    """Directions that cover the sphere evenly, shape [n, 3], float64."""
    i = np.arange(n) + 0.5
    z, phi = 1.0 - 2.0 * i / n, np.pi * (1.0 + 5.0**0.5) * i
    r = np.sqrt(1.0 - z * z)
    return torch.tensor(np.stack([r * np.cos(phi), r * np.sin(phi), z], 1))


def test_basis_is_orthonormal():
    """The integral of Y_i Y_j over the sphere is 1 for equal ones, else 0."""
    basis = sh_basis(fibonacci(20_000), 3)
    gram = 4.0 * np.pi / len(basis) * basis.T @ basis
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=1e-3)


def test_basis_is_that_of_scipy():
    """Y_lm in the order m = -l..l; the real forms of scipy's complex ones, Condon-Shortley phase included."""
    d = fibonacci(50).numpy()
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(m), theta, phi)
            columns.append(y.real if m == 0 else np.sqrt(2.0) * (y.imag if m < 0 else y.real))
    np.testing.assert_allclose(sh_basis(torch.tensor(d), 3).numpy(), np.stack(columns, 1), atol=1e-12)


def test_a_constant_is_grey_plus_its_coefficient_and_never_negative():
    """Colour 0.5 + C0 c, as the field's files have it."""
    constant = torch.tensor([[0.0, 1.0, -9.0]])
    color = sh_colors(constant, torch.zeros(1, 15, 3), torch.tensor([[0.0, 0.0, 1.0]]))
    assert torch.allclose(color, torch.tensor([[0.5, 0.5 + 0.28209479, 0.0]]))


def test_spherical_harmonics_learn_and_go_through_density_control(subject, views):
    """The loss falls, Gaussians appear, and every one of them has its coefficients."""
    config = tiny_config(appearance=BASELINE | {"iterations": 60})
    stage = make_stage(subject, config)
    n_start = len(stage.appearance.gaussians)
    losses = [terms["loss"] for terms in run(stage, views, 60)]
    g = stage.appearance.gaussians
    assert len(g) > n_start
    assert g.sh_constant.shape == (len(g), 3)
    assert g.sh_others.shape == (len(g), 15, 3)
    assert np.mean(losses[-6:]) < 0.6 * np.mean(losses[:6])
    assert float(g.sh_others.detach().abs().max()) > 0.0


def test_a_baseline_avatar_is_saved_and_goes_on_from_its_state(subject, views, tmp_path):
    """Both the file and the checkpoint hold the coefficients and the tuned parameters."""
    config = tiny_resolved(appearance=BASELINE)
    stage = make_stage(subject, config)
    run(stage, views, 9)
    other = make_stage(subject, config)
    other.load_state_dict(copy.deepcopy(stage.state_dict()))
    assert run(other, views, 3) == run(stage, views, 3)

    head = stage.appearance.frozen.head
    avatar = Avatar(VertexGaussians(head, config), stage.appearance, CaptureInfo.of(subject), config)
    avatar.save(tmp_path / "avatar.pt")
    loaded = Avatar.load(tmp_path / "avatar.pt")
    assert torch.equal(loaded.head.poses["translation"], head.poses["translation"])
    pose, camera = head.pose(0), views.cameras[0]
    assert torch.equal(loaded.render(pose, camera).image, avatar.render(pose, camera).image)


def test_tuning_brings_a_wrong_translation_back(subject, views):
    """The head starts 3 cm beside where the images show it; the images pull it back."""
    config = tiny_config(
        appearance=BASELINE | {"iterations": 60, "head_tuning": HeadTuningConfig(enabled=True, lr_translation=3e-3)}
    )
    stage = make_stage(subject, config)
    truth = torch.tensor(subject.params.translation)
    seen = sorted(set(views.timesteps))
    with torch.no_grad():
        stage.poses["translation"] += torch.tensor([0.03, 0.0, 0.0])
    run(stage, views, 60)
    error = (stage.poses["translation"].detach() - truth)[seen].norm(dim=1)
    assert float(error.max()) < 0.015


def test_without_tuning_the_tracked_parameters_stay(subject, views):
    """Bit for bit."""
    config = tiny_config(appearance=BASELINE | {"head_tuning": HeadTuningConfig()})
    stage = make_stage(subject, config)
    before = {name: value.detach().clone() for name, value in stage.poses.items()}
    run(stage, views, 4)
    assert all(torch.equal(before[name], value) for name, value in stage.poses.items())


def test_tuning_has_the_gradient_of_finite_differences(subject, views):
    """From the image through the Gaussians, the face frames and the skinning to the translation."""
    config = tiny_config(appearance=BASELINE)
    stage = make_stage(subject, config)
    frozen = stage.appearance.frozen
    timestep = views.timesteps[0]
    weights = torch.rand(len(stage.appearance.gaussians), 3, generator=torch.Generator().manual_seed(0))

    def loss() -> torch.Tensor:
        gaussians, _ = stage.appearance(frozen.posed(frozen.head.pose(timestep)), views.cameras[0])
        return (gaussians.means * weights).sum() + 10.0 * (gaussians.scales * weights).sum()

    loss().backward()
    for name, column in (("translation", 1), ("neck_pose", 0), ("expr", 1)):
        parameter = stage.poses[name]
        assert parameter.grad is not None
        values = []
        for step in (1e-2, -1e-2):
            with torch.no_grad():
                parameter[timestep, column] += step
                values.append(float(loss()))
                parameter[timestep, column] -= step
        assert float(parameter.grad[timestep, column]) == pytest.approx((values[0] - values[1]) / 2e-2, rel=2e-2)


def test_the_mesh_as_tracked_has_the_tracker_s_offsets(subject):
    """``tracked_offsets`` adds ``static_offset`` to the base vertices; vertices that it lacks get none."""
    head_model = tiny_head()
    n = len(head_model.v_template) - 5
    offset = np.random.default_rng(0).normal(size=(n, 3)).astype(np.float32) * 1e-2
    params = replace(subject.params, static_offset=offset)
    body = Body(head_model, subdivisions=1)
    config = tiny_config().geometry
    plain = PersonalHead(body, params, config).canonical()
    moved = PersonalHead(body, params, replace(config, tracked_offsets=True)).canonical() - plain
    assert torch.allclose(moved[:n], torch.tensor(offset), atol=1e-7)
    assert torch.equal(moved[n : n + 5], torch.zeros(5, 3))


@pytest.mark.parametrize("joints", ["refined", "tracked"])
def test_joints_are_those_that_the_configuration_names(subject, joints):
    """Identity offsets move refined joints; the tracker's stay where its shape and offsets put them."""
    offset = np.random.default_rng(0).normal(size=(1, len(tiny_head().v_template), 3)).astype(np.float32)[0] * 1e-2
    params = replace(subject.params, shape=np.array([0.4, -0.3, 0.2, 0.1], np.float32), static_offset=offset)
    body = Body(tiny_head(), subdivisions=1)
    torch.manual_seed(0)
    head = PersonalHead(body, params, tiny_config(geometry={"joints": joints}).geometry)
    torch.nn.init.normal_(head.refine.phi_id[-1].weight)
    base = body.shaped(torch.tensor(params.shape))[: len(offset)]
    expected = body.J_regressor @ (
        base + torch.tensor(offset) if joints == "tracked" else head.canonical()[: len(base)]
    )
    pose = head.pose(1)
    posed = head.posed(pose)
    by_hand = body.posed(head.canonical() + posed.pose_offsets, pose, joints=expected)
    assert torch.allclose(posed.verts, by_hand, atol=1e-6)


@pytest.mark.parametrize("part", ["identity", "pose"])
def test_offsets_that_are_switched_off_stay_zero(subject, views, part):
    """The other part learns."""
    config = tiny_config(geometry={f"{part}_offsets": False})
    head = tiny_personal_head(subject, config)
    run(GeometryStage(VertexGaussians(head, config), config), views, 6)
    posed = head.posed(head.pose(0))
    offsets = {"identity": posed.identity_offsets, "pose": posed.pose_offsets}
    assert float(offsets.pop(part).detach().abs().max()) == 0.0
    assert float(next(iter(offsets.values())).detach().abs().max()) > 0.0


@pytest.mark.parametrize(("name", "learns"), [("jaw", False), ("eyes", False), ("jaw", True), ("eyes", True)])
def test_rotations_learn_where_they_may(subject, views, name, learns):
    """``learn_jaw`` and ``learn_eyes``."""
    config = tiny_config(geometry={f"learn_{name}": learns})
    head = tiny_personal_head(subject, config)
    before = head.poses[f"{name}_pose"].detach().clone()
    run(GeometryStage(VertexGaussians(head, config), config), views, 6)
    assert torch.equal(head.poses[f"{name}_pose"], before) != learns


@pytest.mark.parametrize(("name", "learns"), [("jaw", False), ("eyes", False), ("jaw", True), ("eyes", True)])
def test_tuning_moves_rotations_only_where_they_may_learn(subject, views, name, learns):
    """The same two keys hold them in the appearance stage; the neck is tuned either way."""
    stage = make_stage(subject, tiny_config(geometry={f"learn_{name}": learns}, appearance=BASELINE))
    before = {key: value.detach().clone() for key, value in stage.poses.items()}
    run(stage, views, 6)
    assert torch.equal(stage.poses[f"{name}_pose"], before[f"{name}_pose"]) != learns
    assert not torch.equal(stage.poses["neck_pose"], before["neck_pose"])


def flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """Every number of a configuration by its path."""
    values: dict[str, Any] = {}
    for key, value in dataclasses.asdict(config).items() if dataclasses.is_dataclass(config) else config.items():
        values |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return values


PARTS = {
    "baseline": {"geometry.enabled", "geometry.tracked_offsets", "appearance.colors", "appearance.offset_net.enabled"},
    "no-geometry-stage": {"geometry.enabled"},
    "no-identity-offsets": {"geometry.identity_offsets"},
    "no-pose-offsets": {"geometry.pose_offsets"},
    "no-laplacian": {"geometry.lambda_laplacian"},
    "no-colornet": {"appearance.colors"},
    "no-offsetnet": {"appearance.offset_net.enabled"},
}
PARTS["baseline"] |= {"appearance.head_tuning.enabled"}
PARTS["baseline-tuned"] = PARTS["baseline"]
OF_A_PART_THAT_IS_OFF = {"appearance.sh.lr"}
FIELD = {
    "lr_means": 5e-3, "lr_scales": 1.7e-2, "lr_quats": 1e-3, "lr_opacities": 5e-2, "density.gradient": 2e-4,
    "density.split_scale": 0.01, "density.min_opacity": 0.005, "sh.lr": 2.5e-3, "sh.degree": 3,
    "head_tuning.lr_expr": 1e-3, "head_tuning.lr_pose": 1e-5, "head_tuning.lr_translation": 1e-6,
}  # fmt: skip
"""Rates and thresholds of GaussianAvatars."""


@pytest.mark.parametrize("size", ["quick", "balanced", "paper"])
@pytest.mark.parametrize("preset", PARTS)
def test_ablations_switch_their_part_and_nothing_else(preset, size):
    """Behind a preset of size, all other numbers are that preset's; baseline alone brings the field's rates."""
    whole, part = flat(read_preset(size)), flat(read_preset(f"{size},{preset}"))
    changed = {key for key in whole if whole[key] != part[key]} - OF_A_PART_THAT_IS_OFF
    if preset == "baseline":
        changed -= {f"appearance.{key}" for key in FIELD}
    assert changed == PARTS[preset]


@pytest.mark.parametrize("size", ["quick", "balanced", "paper"])
def test_the_baseline_has_the_field_s_rates_and_thresholds(size):
    """Whatever the preset of size says."""
    values = flat(read_preset(f"{size},baseline"))
    assert {key: values[f"appearance.{key}"] for key in FIELD} == FIELD


def test_presets_merge_from_left_to_right(tmp_path: Path):
    """The last one wins, key by key; an unknown one is named."""
    (tmp_path / "mine.toml").write_text("[appearance.density]\nstart = 7\n")
    table = preset_table(f"quick,{tmp_path / 'mine.toml'}")
    assert table["appearance"]["density"]["start"] == 7
    assert table["appearance"]["density"]["every"] == preset_table("quick")["appearance"]["density"]["every"]
    with pytest.raises(DataError, match="no preset 'nosuch'"):
        preset_table("quick,nosuch")
