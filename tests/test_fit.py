"""The fit as a whole: repeatable, interruptible, resumable, and what it leaves in its folder."""

from __future__ import annotations

import itertools
import json
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checks import threads
from tiny import tiny_config, tiny_head

from mgavatar.appearance.stage import AppearanceStage
from mgavatar.avatar import Avatar
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, ResolvedConfig, from_dict
from mgavatar.errors import DataError
from mgavatar.fitting.fit import fit_avatar
from mgavatar.fitting.loop import Interrupted
from mgavatar.fitting.plan import plan
from mgavatar.fitting.run import Run, open_run
from mgavatar.fitting.summary import Summary
from mgavatar.fitting.views import ViewOrder, Views
from mgavatar.geometry.stage import GeometryStage

STAGES = {"geometry": GeometryStage, "appearance": AppearanceStage}


def fit_into(
    out: Path, subject: Subject, *, seed: int = 0, resume: bool = False, config: FitConfig | None = None
) -> Run:
    """Fit the tiny subject; density control works at steps 4 and 8."""
    run = open_run(out, resume=resume)
    device = torch.device("cpu")
    fit_avatar(subject, tiny_head(), config or tiny_config(), run, device=device, seed=seed, resume=resume)
    return run


@pytest.fixture(scope="module")
def whole(subject, tmp_path_factory) -> Run:
    """A fit that nobody interrupted."""
    return fit_into(tmp_path_factory.mktemp("whole") / "run", subject)


def contents(run: Run) -> dict[str, Any]:
    """Everything in the avatar file by its path."""

    def flat(value: Any, prefix: str) -> Iterator[tuple[str, Any]]:
        items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
        if items is None:
            yield prefix, value
            return
        for key, inner in items:
            yield from flat(inner, f"{prefix}/{key}")

    return dict(flat(torch.load(run.avatar, weights_only=True), ""))


def differing(a: Run, b: Run) -> list[str]:
    """Names of what is not the same, to the bit, in two avatars."""
    one, other = contents(a), contents(b)
    assert one.keys() == other.keys()
    return [
        name
        for name, value in one.items()
        if not (torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name])
    ]


@contextmanager
def at_step(monkeypatch: pytest.MonkeyPatch, stage: str, step: int, act: Callable[[], None]) -> Iterator[None]:
    """Do something during a step of a stage."""
    kind = STAGES[stage]
    count = itertools.count(1)
    original = kind.step

    def stepped(self: Any, *args: Any) -> Any:
        if next(count) == step:
            act()
        return original(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(kind, "step", stepped)
        yield


def press_ctrl_c() -> None:
    """What the terminal does."""
    signal.raise_signal(signal.SIGINT)


def log_lines(run: Run) -> list[dict[str, Any]]:
    """``metrics.jsonl``, parsed."""
    return [json.loads(line) for line in run.metrics.read_text().splitlines()]


@pytest.mark.parametrize("n_threads", [1, 2])
def test_a_seed_repeats_a_fit_to_the_bit(n_threads, whole, subject, tmp_path):
    """Again, with one thread or two: the same avatar."""
    with threads(n_threads):
        again = fit_into(tmp_path / "run", subject)
    assert differing(whole, again) == []


def test_another_seed_is_another_fit(whole, subject, tmp_path):
    """Views come in another order, networks start elsewhere."""
    names = differing(whole, fit_into(tmp_path / "run", subject, seed=1))
    assert "/geometry/head.refine.planes" in names
    assert "/appearance/color_net.grid.table" in names


def test_a_fit_leaves_a_usable_avatar(whole, subject):
    """It draws the subject better than nothing at all, and holds what density control added."""
    avatar = Avatar.load(whole.avatar)
    assert avatar.appearance is not None
    assert avatar.n_gaussians > len(avatar.head.body.faces)
    frame = subject.frames["train"][0]
    target = Views.of(subject, 64, with_masks=False).images[0].float() / 255.0
    image = avatar.render(avatar.head.pose(frame.timestep), frame.camera).image
    assert (image - target).square().mean() < 0.5 * (1.0 - target).square().mean()


def test_what_is_in_the_folder(whole, subject):
    """Configuration, log, checkpoint and avatar; nothing half-written."""
    names = sorted(path.name for path in whole.folder.iterdir())
    assert names == ["avatar.pt", "checkpoint.pt", "config.toml", "metrics.jsonl", "summary.json"]
    resolved, _ = plan(tiny_config(), tiny_head(), subject)
    assert from_dict(tomllib.loads((whole.folder / "config.toml").read_text()), ResolvedConfig) == resolved


def test_what_the_fit_took(whole):
    """``summary.json``: time, iterations, memory and size, and why the fit was done as it was."""
    summary = json.loads((whole.folder / "summary.json").read_text())
    avatar = Avatar.load(whole.avatar)
    assert avatar.appearance is not None
    assert summary["gaussians"] == avatar.n_gaussians
    parts = (avatar.vertex_gaussians, avatar.appearance)
    assert summary["parameters"] == sum(value.numel() for part in parts for value in part.parameters())
    assert list(summary["stages"]) == ["geometry", "appearance"]
    for stage in summary["stages"].values():
        assert stage["iterations"] == stage["configured"] == 12
        assert stage["seconds"] > 0
    assert summary["seconds"] > sum(stage["seconds"] for stage in summary["stages"].values())
    assert summary["peak_mib"] is None if sys.platform == "win32" else 50 < summary["peak_mib"] < 50_000
    assert (summary["seed"], summary["device"], summary["budget_seconds"]) == (0, "cpu", None)
    (decision,) = summary["plan"]
    assert (decision["key"], decision["value"]) == ("geometry.subdivisions", 1)
    assert "edges of" in decision["reason"]


def test_a_summary_on_windows(tmp_path, monkeypatch):
    """Python has no module there that knows the peak of the memory; the rest of the summary stands without it."""
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setitem(sys.modules, "resource", None)  # so that importing it fails
    Summary().write(tmp_path / "summary.json", gaussians=7)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["peak_mib"], summary["gaussians"]) == (None, 7)
    assert Summary({"seconds": 1.0, "peak_mib": 80.0, "stages": {}}).state()["peak_mib"] == 80.0


def test_interrupted_and_resumed_the_summary_adds_up(subject, tmp_path, monkeypatch):
    """Both parts of a stage count; a fit that was interrupted has no summary yet."""
    with at_step(monkeypatch, "appearance", 5, press_ctrl_c), pytest.raises(Interrupted):
        fit_into(tmp_path / "run", subject)
    assert not (tmp_path / "run" / "summary.json").exists()
    before = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["summary"]
    assert before["stages"]["appearance"]["iterations"] == 5
    run = fit_into(tmp_path / "run", subject, resume=True)
    after = json.loads((run.folder / "summary.json").read_text())
    assert after["stages"]["geometry"] == before["stages"]["geometry"]
    assert after["stages"]["appearance"]["iterations"] == 12
    for one, other in ((before["stages"]["appearance"], after["stages"]["appearance"]), (before, after)):
        assert other["seconds"] > one["seconds"] > 0


def test_a_fit_plans_first(subject, tmp_path, caplog):
    """With everything left open, all decisions are said, and neither avatar nor run stores an ``auto``."""
    config = tiny_config(geometry={"pose_offsets": "auto", "learn_jaw": "auto", "learn_eyes": "auto"})
    nets = {
        "color_net": replace(config.appearance.color_net, levels="auto", max_resolution="auto", view_frame="auto"),
        "offset_net": replace(config.appearance.offset_net, enabled="auto", resolution="auto"),
    }
    config = replace(config, appearance=replace(config.appearance, colors="auto", **nets))
    with caplog.at_level("INFO", logger="mgavatar"):
        run = fit_into(tmp_path / "run", subject, config=config)
    said = [record.message for record in caplog.records if record.message.startswith("plan: ")]
    assert len(said) == 10
    assert "auto" not in (run.folder / "config.toml").read_text()
    avatar = Avatar.load(run.avatar)
    assert plan(config, tiny_head(), subject)[0] == avatar.config
    assert len(json.loads((run.folder / "summary.json").read_text())["plan"]) == 10


def test_without_a_geometry_stage(subject, tmp_path):
    """The appearance is learned on the mesh as tracked."""
    run = fit_into(tmp_path / "run", subject, config=tiny_config(geometry={"enabled": False}))
    assert {line["stage"] for line in log_lines(run)} == {"appearance"}
    head = Avatar.load(run.avatar).head
    n = head.body.model.n_shape
    assert np.array_equal(head.betas.numpy(), subject.params.shape[:n])
    assert np.allclose(head.poses["jaw_pose"].numpy(), subject.params.jaw_pose)
    assert torch.equal(head.canonical(), head.body.shaped(head.betas))


def test_without_a_geometry_stage_a_fit_resumes_too(subject, tmp_path, monkeypatch):
    """To the same bits."""
    config = tiny_config(geometry={"enabled": False})
    whole = fit_into(tmp_path / "whole", subject, config=config)
    with at_step(monkeypatch, "appearance", 5, press_ctrl_c), pytest.raises(Interrupted):
        fit_into(tmp_path / "run", subject, config=config)
    assert differing(whole, fit_into(tmp_path / "run", subject, config=config, resume=True)) == []


def test_the_log(whole):
    """Every fourth step of both stages, each with all of its terms, and they add up."""
    lines = log_lines(whole)
    assert [(line["stage"], line["iteration"]) for line in lines] == [
        (stage, iteration) for stage in ("geometry", "appearance") for iteration in (4, 8, 12)
    ]
    for line in lines:
        parts = ("image", "offset", "laplacian") if line["stage"] == "geometry" else ("image", "offset", "binding")
        assert line["loss"] == pytest.approx(sum(line[part] for part in parts), rel=1e-5)
        assert line["gaussians"] >= 162
        assert line["seconds"] >= 0


def test_the_last_step_is_logged_whatever_the_interval(subject, tmp_path):
    """Also where it is no multiple."""
    run = fit_into(tmp_path / "run", subject, config=replace(tiny_config(), log_every=7))
    assert [line["iteration"] for line in log_lines(run)] == [7, 12, 7, 12]


@pytest.mark.parametrize(
    ("stage", "step"),
    [("geometry", 1), ("geometry", 5), ("geometry", 12), ("appearance", 2), ("appearance", 6), ("appearance", 12)],
)
def test_ctrl_c_leaves_an_avatar_and_resume_ends_as_if_nothing_had_been(
    stage, step, whole, subject, tmp_path, monkeypatch
):
    """In either stage, before, after and at the end of density control: the same bits as in one go."""
    before = signal.getsignal(signal.SIGINT)
    with at_step(monkeypatch, stage, step, press_ctrl_c), pytest.raises(Interrupted, match=f"{stage} at {step}/12"):
        fit_into(tmp_path / "run", subject)
    assert signal.getsignal(signal.SIGINT) is before
    avatar = Avatar.load(tmp_path / "run" / "avatar.pt")
    assert (avatar.appearance is None) is (stage == "geometry")
    assert avatar.render(avatar.head.pose(0), avatar.capture.mean_camera()).alphas.max() > 0.5
    resumed = fit_into(tmp_path / "run", subject, resume=True)
    assert differing(whole, resumed) == []
    drop = ("seconds",)
    logs = [[{k: v for k, v in line.items() if k not in drop} for line in log_lines(run)] for run in (whole, resumed)]
    assert logs[0] == logs[1]


def test_random_backgrounds_repeat_and_resume_too(subject, tmp_path, monkeypatch):
    """The colour of an iteration depends on the seed and on nothing before it."""
    config = replace(tiny_config(), random_background=True)
    whole = fit_into(tmp_path / "whole", subject, config=config)
    with at_step(monkeypatch, "geometry", 5, press_ctrl_c), pytest.raises(Interrupted):
        fit_into(tmp_path / "run", subject, config=config)
    assert differing(whole, fit_into(tmp_path / "run", subject, config=config, resume=True)) == []
    plain = fit_into(tmp_path / "plain", subject)
    assert "/geometry/colors" in differing(whole, plain)


def test_a_target_on_another_background(subject):
    """The subject keeps its colours, what is behind it takes the new one; without masks nothing changes."""
    white, new = torch.ones(3), torch.tensor([0.2, 0.7, 0.4])
    views = Views.of(subject, 64, with_masks=True)
    image, mask = views.images[2].float() / 255.0, views.masks[2] == 255
    assert 0 < mask.sum() < mask.numel()
    target = views.target(2, white, new)
    assert torch.allclose(target[:, mask], image[:, mask])
    assert torch.allclose(target[:, ~mask], new[:, None].expand(3, int((~mask).sum())), atol=1e-6)
    assert torch.equal(Views.of(subject, 64, with_masks=False).target(2, white, new), image)


def test_two_interruptions(whole, subject, tmp_path, monkeypatch):
    """In both stages, one after the other."""
    with at_step(monkeypatch, "geometry", 7, press_ctrl_c), pytest.raises(Interrupted):
        fit_into(tmp_path / "run", subject)
    with at_step(monkeypatch, "appearance", 5, press_ctrl_c), pytest.raises(Interrupted):
        fit_into(tmp_path / "run", subject, resume=True)
    assert differing(whole, fit_into(tmp_path / "run", subject, resume=True)) == []


def test_a_finished_fit_can_be_resumed(whole, subject, tmp_path):
    """Nothing is left to do, and the avatar is the same."""
    run = fit_into(tmp_path / "run", subject)
    run.avatar.unlink()
    assert differing(whole, fit_into(tmp_path / "run", subject, resume=True)) == []


def test_the_second_ctrl_c_stops_at_once(subject, tmp_path, monkeypatch):
    """Whoever presses twice does not wait for the step to end; the handler is put back."""
    before = signal.getsignal(signal.SIGINT)

    def twice() -> None:
        press_ctrl_c()
        press_ctrl_c()

    with at_step(monkeypatch, "geometry", 3, twice), pytest.raises(KeyboardInterrupt):
        fit_into(tmp_path / "run", subject)
    assert signal.getsignal(signal.SIGINT) is before
    assert not (tmp_path / "run" / "avatar.pt").exists()


@pytest.mark.parametrize(("stage", "step"), [("geometry", 6), ("appearance", 7)])
def test_a_crash_costs_what_came_after_the_last_checkpoint(stage, step, whole, subject, tmp_path, monkeypatch):
    """Checkpoints are written as the fit goes; a fit that was killed goes on from there to the same bits."""
    often = replace(tiny_config(), checkpoint_minutes=0.0)

    def crash() -> None:
        raise RuntimeError("power cut")

    with at_step(monkeypatch, stage, step, crash), pytest.raises(RuntimeError, match="power cut"):
        fit_into(tmp_path / "run", subject, config=often)
    checkpoint = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert (checkpoint["stage"], checkpoint["iteration"]) == (stage, step - 1)
    resumed = fit_into(tmp_path / "run", subject, config=often, resume=True)
    assert differing(whole, resumed) == ["/config/checkpoint_minutes"]


def test_a_loss_that_is_not_finite_stops_the_fit(subject, tmp_path, monkeypatch):
    """With the stage, the step and what to do."""
    step = GeometryStage.step

    def diverged(stage: GeometryStage, *args: Any) -> dict[str, float]:
        return step(stage, *args) | {"loss": float("nan")}

    monkeypatch.setattr(GeometryStage, "step", diverged)
    with pytest.raises(DataError, match=r"geometry loss is not finite at iteration .*; lower the learning rates"):
        fit_into(tmp_path / "run", subject)
    assert not (tmp_path / "run" / "avatar.pt").exists()


def test_an_avatar_by_its_own_path(subject, tmp_path):
    """``--out x.pt`` puts the avatar there, and the rest into the folder beside it."""
    run = fit_into(tmp_path / "x.pt", subject)
    assert run.avatar == tmp_path / "x.pt"
    assert run.folder == tmp_path / "x"
    assert Avatar.load(tmp_path / "x.pt").n_gaussians > 0


def test_where_a_fit_may_write(tmp_path):
    """A new folder or an empty one; never over what is there."""
    assert open_run(tmp_path / "new", resume=False).avatar == tmp_path / "new" / "avatar.pt"
    (tmp_path / "empty").mkdir()
    assert open_run(tmp_path / "empty", resume=False).folder == tmp_path / "empty"
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("out", "resume", "words"),
    [
        ("full", False, "full: already exists and is not an empty folder; .*--resume"),
        ("file", False, "file: already exists and is not an empty folder"),
        ("full.pt", False, "full: already exists and is not an empty folder"),
        ("taken.pt", False, r"taken\.pt: already exists; .*another name"),
        ("full", True, r"checkpoint\.pt: nothing to resume; leave --resume out"),
        ("absent", True, r"checkpoint\.pt: nothing to resume"),
    ],
)
def test_where_a_fit_may_not_write(out, resume, words, tmp_path):
    """One line with the path and the remedy, and nothing is touched."""
    (tmp_path / "full").mkdir()
    for name in ("full/something", "file", "taken.pt"):
        (tmp_path / name).write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DataError, match=words):
        open_run(tmp_path / out, resume=resume)
    assert sorted(tmp_path.rglob("*")) == before


def test_resuming_with_another_configuration_is_refused(whole, subject):
    """The remedy is the configuration that the run itself wrote down."""
    config = tiny_config(geometry={"lr_color": 0.5})
    with pytest.raises(DataError, match=r"checkpoint\.pt: was made with another configuration; .*config\.toml"):
        fit_into(whole.folder, subject, resume=True, config=config)


def test_resuming_with_another_seed_is_refused(whole, subject):
    """It would see the views in another order, and be no continuation."""
    with pytest.raises(DataError, match=r"checkpoint\.pt: was made with --seed 0, not 5; give --seed 0"):
        fit_into(whole.folder, subject, seed=5, resume=True)


def test_resuming_with_another_capture_is_refused(whole, subject):
    """One that has other timesteps cannot be what the checkpoint was made of."""
    params = replace(subject.params, **{
        name: np.repeat(getattr(subject.params, name), 2, 0)
        for name in ("expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation")
    })  # fmt: skip
    before = whole.avatar.read_bytes()
    with pytest.raises(DataError, match=r"checkpoint\.pt: does not fit; give the capture"):
        fit_into(whole.folder, replace(subject, params=params), resume=True)
    assert whole.avatar.read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\x03\x04"])
def test_a_broken_checkpoint_is_refused(content, subject, tmp_path):
    """In one line, which names it."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoint.pt").write_bytes(content)
    with pytest.raises(DataError, match=r"checkpoint\.pt: not a checkpoint"):
        fit_into(tmp_path / "run", subject, resume=True)


def test_every_view_comes_once_in_a_pass():
    """Shuffled passes, another order in each, the same for the same seed."""
    views = list(itertools.islice(ViewOrder(7, 3), 21))
    passes = [views[i : i + 7] for i in (0, 7, 14)]
    assert all(sorted(each) == list(range(7)) for each in passes)
    assert passes[0] != passes[1]
    assert views == list(itertools.islice(ViewOrder(7, 3), 21))
    assert views != list(itertools.islice(ViewOrder(7, 4), 21))


@pytest.mark.parametrize(("max_size", "side"), [(40, 40), (1000, 40), (20, 20), (17, 17)])
def test_images_and_cameras_are_reduced_together(subject, max_size, side):
    """Never enlarged; what the camera sees stays where it was."""
    views = Views.of(subject, max_size, with_masks=True)
    assert views.images.shape == (6, 3, side, side)
    assert views.images.dtype == torch.uint8
    assert views.masks.shape == (6, side, side)
    point = np.array([0.03, -0.02, 0.04, 1.0])
    for frame, camera in zip(subject.frames["train"], views.cameras, strict=True):
        assert (camera.width, camera.height) == (side, side)
        full, small = (c.K @ (c.viewmat @ point)[:3] for c in (frame.camera, camera))
        assert np.allclose(full[:2] / full[2] / 40, small[:2] / small[2] / side)
    assert views.timesteps == [frame.timestep for frame in subject.frames["train"]]
