"""Configs: the paper's numbers, presets, and their way through TOML and the command line."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from types import UnionType
from typing import Any, Union, get_args, get_origin

import pytest
import torch
from torch import nn

from mgavatar import cli
from mgavatar.appearance.color_net import ColorNet
from mgavatar.appearance.offset_net import OffsetNet
from mgavatar.config import (
    ACCURACY,
    AppearanceConfig,
    ColorNetConfig,
    FitConfig,
    GeometryConfig,
    OffsetNetConfig,
    RasterConfig,
    ResolvedConfig,
    check,
    flag_of,
    from_dict,
    keys,
    resolve,
)
from mgavatar.errors import DataError
from mgavatar.geometry.refine_net import RefineNet
from mgavatar.head.body import Body
from mgavatar.head.procedural.build import build_head
from mgavatar.kernels.binding import N_OFFSETS
from mgavatar.presets import preset, preset_names, preset_summary, preset_table, to_toml

PAPER = {
    "random_background": False,
    "loss.color": 0.8,  # lambda_c, Eq. 4 and 11
    "loss.ssim": 0.2,  # lambda_m, Eq. 4 and 11
    "geometry.iterations": 100_000,
    "geometry.lr_refine": 1e-3,  # eta_geo
    "geometry.lr_triplane": 1e-3,  # RefineNet is triplane and networks
    "geometry.lambda_offset": 10.0,  # lambda_o, Eq. 7
    "geometry.lambda_laplacian": 1e5,  # lambda_l, Eq. 7
    "geometry.max_image_size": 8192,  # nothing is reduced
    "geometry.hidden": 128,
    "geometry.pose_offsets": True,
    "geometry.surface_shift": 0.0,  # Gaussians are at the vertices
    "geometry.scales_follow_mesh": False,
    "appearance.iterations": 240_000,  # 340k in all
    "appearance.max_image_size": 8192,
    "appearance.lambda_position": 0.01,  # lambda_mu, Eq. 11
    "appearance.lambda_scale": 1.0,  # lambda_s, Eq. 11
    "appearance.epsilon_position": 1.0,  # epsilon_mu, Eq. 11
    "appearance.epsilon_scale": 0.6,  # epsilon_s, Eq. 11
    "appearance.color_net.lr": 1e-2,  # eta_color
    "appearance.color_net.levels": 16,
    "appearance.color_net.base_resolution": 16,
    "appearance.color_net.max_resolution": 4096,
    "appearance.color_net.hidden": 64,
    "appearance.offset_net.enabled": True,
    "appearance.offset_net.lr": 1e-4,  # eta_offset
    "appearance.offset_net.regularize": 0.01,  # lambda_a, Eq. 11
}


def number(config: FitConfig, key: str) -> Any:
    """The value at a dotted key."""
    value: Any = config
    for name in key.split("."):
        value = getattr(value, name)
    return value


class Parsed(Exception):
    """Ends the command as soon as its config is known."""


def parsed(monkeypatch: pytest.MonkeyPatch, *argv: str) -> FitConfig:
    """The config that ``mgavatar fit`` gets from a command line."""

    def stop(config: FitConfig) -> None:
        raise Parsed(config)

    monkeypatch.setattr(cli.configs, "check", stop)
    monkeypatch.setattr("sys.argv", ["mgavatar", "fit", "--data", "x", "--out", "y", *argv])
    with pytest.raises(Parsed) as caught:
        cli.main()
    return caught.value.args[0]


@pytest.mark.parametrize("key", PAPER)
def test_the_default_is_the_papers_number(key):
    """Every number that the paper states is what the program does when nobody says otherwise."""
    assert number(FitConfig(), key) == PAPER[key]


def test_the_paper_preset_changes_nothing():
    """``--preset paper`` is the defaults."""
    assert preset_table("paper") == {}


def test_the_offset_networks_have_the_papers_layers():
    """Phi_id and Phi_pose: four layers, 128 channels; three planes."""
    net = RefineNet(torch.rand(5, 3), GeometryConfig(), mean_pose=torch.zeros(12))
    assert len(net.planes) == 3
    for mlp in (net.phi_id, net.phi_pose):
        layers = [layer for layer in mlp if isinstance(layer, nn.Linear)]
        assert [layer.out_features for layer in layers] == [128, 128, 128, 3]


def test_color_net_has_the_papers_layers():
    """16 levels of 2 features from 16 to 4096 cells, the direction, then two layers with 64 channels between."""
    net = ColorNet(torch.zeros(3), torch.ones(3), ColorNetConfig(log2_table_size=8), seed=0)
    levels = net.grid.shape.table_levels()
    assert net.grid.shape.features == 2
    assert (len(levels), int(levels[0, 0]), int(levels[-1, 0])) == (16, 16, 4096)
    layers = [layer for layer in net.mlp if isinstance(layer, nn.Linear)]
    assert [(layer.in_features, layer.out_features) for layer in layers] == [(16 * 2 + 3, 64), (64, 3)]


def test_offset_net_has_the_papers_layers():
    """One layer embeds 9 map channels, eight extract, five decode to 13."""
    net = OffsetNet(OffsetNetConfig(resolution=16))
    count = {name: sum(isinstance(m, nn.Conv2d) for m in part.modules()) for name, part in net.named_children()}
    assert (count["embed"], count["encoder"], count["decoder"] + count["last"]) == (1, 8, 5)
    assert net.embed[0].in_channels == 9
    assert net.last.out_channels == N_OFFSETS == 13


def test_subdivision_gives_the_papers_mesh():
    """5K vertices and 10K faces become 20K and 40K."""
    head = build_head()
    body = Body(head, subdivisions=1)
    assert (round(len(head.v_template), -3), round(len(head.faces), -3)) == (5000, 10000)
    assert (round(body.n_verts, -3), round(len(body.faces), -3)) == (20000, 40000)


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_is_read_and_can_work(name, monkeypatch):
    """A preset that ships has only known keys, says what it says, and passes the checks."""
    config = parsed(monkeypatch, "--preset", name)
    check(config)

    def compare(table: dict[str, Any], prefix: str = "") -> None:
        for key, value in table.items():
            if isinstance(value, dict):
                compare(value, f"{prefix}{key}.")
            else:
                assert number(config, prefix + key) == value

    compare(preset_table(name))


def test_quick_and_paper_ship():
    """The two presets that the documentation names."""
    assert {"quick", "paper"} <= set(preset_names())


def test_the_users_flags_win_over_the_preset(monkeypatch):
    """Wherever the flag stands, and also over a preset that says the opposite of a switch."""
    quick = preset_table("quick")["geometry"]["iterations"]
    assert parsed(monkeypatch).geometry.iterations == quick
    for argv in (["--geometry.iterations", "7", "--preset=quick"], ["--preset", "quick", "--geometry.iterations=7"]):
        config = parsed(monkeypatch, *argv)
        assert config.geometry.iterations == 7
        assert config.geometry.hidden == preset_table("quick")["geometry"]["hidden"]


def test_switches_and_choices_come_through_a_file(tmp_path, monkeypatch):
    """Booleans, words, nested tables and both kinds of ``subdivisions``."""
    path = tmp_path / "mine.toml"
    path.write_text(
        'principal_point = "opengl"\n[geometry]\npose_offsets = false\nsubdivisions = 0\n'
        '[appearance.color_net]\nview_frame = "world"\n[appearance.offset_net]\nenabled = false\n'
    )
    config = parsed(monkeypatch, "--preset", str(path))
    assert config.principal_point == "opengl"
    assert config.geometry.pose_offsets is False
    assert config.geometry.subdivisions == 0
    assert config.appearance.color_net.view_frame == "world"
    assert config.appearance.offset_net.enabled is False
    chosen = parsed(monkeypatch, "--preset", str(path), "--geometry.pose-offsets", "true")
    assert chosen.geometry.pose_offsets is True
    assert parsed(monkeypatch, "--preset", "paper").geometry.subdivisions == "auto"


def test_what_the_plan_may_decide_comes_as_flag_and_as_file(tmp_path, monkeypatch):
    """``auto`` beside true, false and numbers, either way; a switch without ``auto`` stays a switch."""
    resolved = FitConfig(
        geometry=GeometryConfig(pose_offsets="auto", learn_jaw=False, learn_eyes="auto", subdivisions="auto"),
        appearance=AppearanceConfig(
            colors="auto",
            color_net=ColorNetConfig(levels="auto", max_resolution="auto", view_frame="auto"),
            offset_net=OffsetNetConfig(enabled="auto", resolution=64),
        ),
    )
    path = tmp_path / "config.toml"
    path.write_text(to_toml(resolved))
    assert 'pose_offsets = "auto"\n' in path.read_text()
    assert "learn_jaw = false\n" in path.read_text()
    assert parsed(monkeypatch, "--preset", str(path)) == resolved
    flags = ["--geometry.learn-jaw=auto", "--appearance.offset-net.enabled", "true", "--geometry.no-enabled"]
    config = parsed(monkeypatch, "--preset", str(path), *flags, "--appearance.color-net.levels=3")
    assert (config.geometry.learn_jaw, config.geometry.enabled) == ("auto", False)
    assert (config.appearance.offset_net.enabled, config.appearance.color_net.levels) == (True, 3)
    assert from_dict(dataclasses.asdict(config), FitConfig) == config
    check(resolved)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[geometry]\nlr_refin = 1e-3\n", ("unknown key geometry.lr_refin", "--geometry.lr-refine")),
        ("log_evry = 3\n", ("unknown key log_evry", "--log-every")),
        ('[geometry]\nhidden = "many"\n', ("--geometry.hidden many", "a whole number between 1 and 4096")),
        ('[geometry]\njoints = "bananas"\n', ("--geometry.joints bananas", "refined or tracked")),
        ("[geometry]\nenabled = 1\n", ("--geometry.enabled 1", "true or false")),
        ("[geometry]\niterations = true\n", ("--geometry.iterations true", "a whole number")),
        ("[geometry]\niterations = 3.5\n", ("--geometry.iterations 3.5", "a whole number")),
        ("geometry = 3\n", ("geometry is 3", "a table")),
    ],
)
def test_a_file_with_a_wrong_key_or_value_is_one_line(text, words, tmp_path):
    """It names the file and the flag; a misspelt key never falls back to a default."""
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(DataError) as error:
        preset(f"quick,{path}")
    for word in ("mine.toml", *words):
        assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_toml_round_trip(tmp_path, monkeypatch):
    """``RUN/config.toml`` given back as a preset is the same fit, to the last digit."""
    config = FitConfig(
        checkpoint_minutes=1.0 / 3.0,
        principal_point="opencv",
        geometry=GeometryConfig(lr_pose=1.2345678901234567e-5, pose_offsets=False, subdivisions=2),
        appearance=AppearanceConfig(offset_net=OffsetNetConfig(enabled=False), epsilon_scale=0.1 + 0.2),
    )
    path = tmp_path / "config.toml"
    path.write_text(to_toml(config))
    assert from_dict(tomllib.loads(path.read_text()), FitConfig) == config
    assert parsed(monkeypatch, "--preset", str(path)) == config
    path.write_text(to_toml(FitConfig()))
    assert parsed(monkeypatch, "--preset", str(path)) == FitConfig()


def test_dict_round_trip():
    """The config that an avatar carries comes back equal."""
    config = FitConfig(log_every=3, geometry=GeometryConfig(hidden=5), appearance=AppearanceConfig(iterations=9))
    assert from_dict(dataclasses.asdict(config), FitConfig) == config
    assert from_dict({}, FitConfig) == FitConfig()


@pytest.mark.parametrize(
    "table", [{"log_evry": 1.0}, {"geometry": {"hiden": 1}}, {"appearance": {"density": {"x": 1}}}]
)
def test_a_stored_config_with_an_unknown_key_is_refused(table):
    """At any depth."""
    with pytest.raises(ValueError, match="unknown key"):
        from_dict(table, FitConfig)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("nothing", None, ("nothing", "quick", "paper", ".toml")),
        ("absent.toml", None, ("absent.toml", "no such file", "quick")),
        ("broken.toml", b"[geometry\niterations = 3", ("broken.toml", "not a TOML file")),
        ("bytes.toml", b"\xff\xfe\x00", ("bytes.toml", "not a TOML file")),
    ],
)
def test_a_preset_that_cannot_be_read(name, text, words, tmp_path, monkeypatch):
    """One line that names it and says what there is."""
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / name).write_bytes(text)
    with pytest.raises(DataError) as error:
        preset_table(name)
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("section", "key", "value", "flag"),
    [
        ("geometry", "max_image_size", 15, "--geometry.max-image-size"),
        ("appearance", "max_image_size", 0, "--appearance.max-image-size"),
        (None, "log_every", 0, "--log-every"),
        ("geometry", "iterations", 0, "--geometry.iterations"),
        ("geometry", "subdivisions", 4, "--geometry.subdivisions"),
        ("geometry", "subdivisions", -1, "--geometry.subdivisions"),
        ("geometry", "triplane_resolution", 1, "--geometry.triplane-resolution"),
        ("geometry", "hidden", 0, "--geometry.hidden"),
        ("geometry", "lr_final_factor", 0.0, "--geometry.lr-final-factor"),
        ("geometry", "initial_scale", 0.0, "--geometry.initial-scale"),
        ("geometry", "initial_scale", float("nan"), "--geometry.initial-scale"),
        ("appearance", "iterations", 0, "--appearance.iterations"),
        ("appearance", "lr_final_factor", 2.0, "--appearance.lr-final-factor"),
        ("appearance", "initial_opacity", 1.0, "--appearance.initial-opacity"),
        ("appearance.color_net", "levels", 0, "--appearance.color-net.levels"),
        ("appearance.color_net", "log2_table_size", 25, "--appearance.color-net.log2-table-size"),
        ("appearance.color_net", "max_resolution", 8, "--appearance.color-net.max-resolution"),
        ("appearance.offset_net", "resolution", 8, "--appearance.offset-net.resolution"),
        ("appearance.offset_net", "resolution", 60, "multiple of 8"),
        ("appearance.density", "every", 0, "--appearance.density.every"),
        ("appearance.sh", "degree", 4, "--appearance.sh.degree"),
        ("raster", "alpha_threshold", -0.1, "--raster.alpha-threshold"),
        ("raster", "stop", 0.6, "--raster.stop"),
        ("raster", "accuracy", "perfect", "--raster.accuracy"),
    ],
)
def test_numbers_that_cannot_work_are_refused(section, key, value, flag):
    """Each by the name of its flag, before any work."""
    table: dict[str, Any] = {key: value}
    for name in reversed((section or "").split(".") if section else []):
        table = {name: table}
    with pytest.raises(ValueError, match=re.escape(flag)):
        from_dict(table, FitConfig)


def test_an_accuracy_level_stands_for_two_thresholds(monkeypatch):
    """The level decides unless a threshold is given; levels are ordered, and the default is the field's."""
    assert FitConfig().raster.thresholds() == ACCURACY["balanced"] == (1 / 255, 1e-4)
    chosen = parsed(monkeypatch, "--raster.accuracy", "fast").raster
    assert chosen.thresholds() == ACCURACY["fast"]
    chosen = parsed(monkeypatch, "--raster.accuracy", "fast", "--raster.stop", "0").raster
    assert chosen.thresholds() == (ACCURACY["fast"][0], 0.0)
    levels = [ACCURACY[name] for name in ("exact", "accurate", "balanced", "fast")]
    assert levels == sorted(levels)
    assert len(set(levels)) == len(levels)


def test_thresholds_that_are_not_given_stay_out_of_the_file(tmp_path, monkeypatch):
    """TOML has no word for None; what is given survives, and so do avatars from before there were levels."""
    assert "alpha_threshold" not in to_toml(FitConfig())
    config = FitConfig(raster=RasterConfig(accuracy="accurate", stop=1e-3))
    path = tmp_path / "config.toml"
    path.write_text(to_toml(config))
    assert parsed(monkeypatch, "--preset", str(path)) == config
    old = from_dict({"raster": {"alpha_threshold": 1 / 64, "stop": 0.0}}, FitConfig)
    assert old.raster.thresholds() == (1 / 64, 0.0)


def test_the_defaults_pass_the_checks():
    """What ships can work."""
    check(FitConfig())


KEYS = dict(keys())


NONSENSE = (float("nan"), float("-inf"), -1, -1e-3, 1e12, "bananas", None, [], True)


def allowed(value: Any, hint: Any) -> bool:
    """Return True if a key's type says itself that this value is fine."""
    return (value is True and "bool" in str(hint)) or (value is None and type(None) in get_args(hint))


@pytest.mark.parametrize(
    ("key", "value"), [(key, value) for key in KEYS for value in NONSENSE if not allowed(value, KEYS[key])]
)
def test_every_key_refuses_nonsense(key, value):
    """No key is without a range: each refuses NaN, negative and huge numbers, and whatever is of another type."""
    table: Any = value
    for name in reversed(key.split(".")):
        table = {name: table}
    with pytest.raises(ValueError, match=re.escape(flag_of(key))):
        from_dict(table, FitConfig)


def test_every_number_has_a_range():
    """A key whose type is a bare number would accept anything."""
    for key, hint in KEYS.items():
        for option in get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,):
            assert option not in (int, float), key


def test_resolving_leaves_no_auto():
    """A request becomes a configuration of another type, with every auto decided or refused."""
    request = FitConfig(geometry=GeometryConfig(subdivisions="auto"))
    with pytest.raises(ValueError, match=r"--geometry\.subdivisions auto"):
        resolve(request)
    resolved = resolve(request, {"geometry.subdivisions": 1})
    assert type(resolved) is ResolvedConfig
    assert resolved.geometry.subdivisions == 1
    assert from_dict(dataclasses.asdict(resolved), ResolvedConfig) == resolved
    with pytest.raises(ValueError, match="subdivisions"):
        resolve(request, {"geometry.subdivisions": 7})


def test_every_preset_says_in_a_line_what_it_is_for():
    """The command line lists them."""
    for name in preset_names():
        assert 10 < len(preset_summary(name)) < 80, name
