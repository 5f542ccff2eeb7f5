"""The Python interface: what it promises, what its documentation runs, and what it leaves alone."""

from __future__ import annotations

import hashlib
import inspect
import logging
import re
import shutil
import signal
import subprocess
import sys
import threading
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tiny import tiny_config, tiny_head, write_tiny_capture

import mgavatar
from mgavatar.appearance.stage import AppearanceStage
from mgavatar.camera import Camera
from mgavatar.config import RasterConfig
from mgavatar.geometry.stage import GeometryStage
from mgavatar.head.load import save_head_model
from mgavatar.head.params import Pose
from mgavatar.pipeline import FitResult
from mgavatar.presets import to_toml
from mgavatar.progress import FitProgress

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "python.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)


def signatures() -> dict[str, str]:
    """Return every promised name with its signature; of classes, those of their public methods and fields."""
    found = {}
    for name in mgavatar.__all__:
        value = getattr(mgavatar, name)
        if not (inspect.isclass(value) and issubclass(value, Exception)):
            found[name] = str(inspect.signature(value))
        if inspect.isclass(value):
            for member, inner in inspect.getmembers(value, inspect.isfunction):
                if not member.startswith("_"):
                    found[f"{name}.{member}"] = str(inspect.signature(inner))
    for kind in (FitResult, FitProgress, Pose, Camera):
        found[kind.__name__] = str([(entry.name, str(entry.type)) for entry in fields(kind)])
    return found


def test_the_promise_changes_only_with_a_line_in_the_changelog():
    """A changed signature changes the digest; write down what changed in CHANGELOG.md, with the new digest."""
    text = "\n".join(f"{name}{signature}" for name, signature in sorted(signatures().items()))
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"Public API `{digest}`" in changelog, f"the public API is now {digest}: {text}"


def test_every_name_is_there_and_no_other_is_promised():
    """``dir`` shows the names before they are used; an unknown name is an AttributeError."""
    assert set(mgavatar.__all__) <= set(dir(mgavatar))
    assert set(mgavatar.__all__) == set(mgavatar._HOMES)
    with pytest.raises(AttributeError, match="nothing"):
        mgavatar.nothing  # noqa: B018


def test_importing_is_quick_and_brings_nothing_heavy():
    """Below 0.15 s by the interpreter's own clock, without torch, Warp, numpy or scipy."""
    code = (
        "import sys, time; start = time.perf_counter(); import mgavatar; took = time.perf_counter() - start;"
        "assert not {'torch', 'warp', 'numpy', 'scipy', 'kornia', 'trimesh'} & set(sys.modules); print(took)"
    )
    best = min(
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout) for _ in range(3)
    )
    assert best < 0.15


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """A folder with what the page's examples name, and their tiny fit."""
    root = tmp_path_factory.mktemp("python")
    write_tiny_capture(root / "subject_dir")
    save_head_model(root / "head_model.npz", tiny_head())
    (root / "tiny.toml").write_text(to_toml(tiny_config()))
    neck = np.linspace([0.0, -0.2, 0.0], [0.0, 0.2, 0.0], 3, dtype=np.float32)
    np.savez(root / "seq.npz", neck_pose=neck)
    return root


@pytest.fixture(scope="module")
def fitted(inputs) -> FitResult:
    """A tiny fit that wrote ``out.pt`` for the examples that load one."""
    subject = mgavatar.read_capture(inputs / "subject_dir")
    result = mgavatar.fit(subject, tiny_head(), tiny_config(), out=inputs / "fitted" / "out.pt")
    shutil.copy(result.path, inputs / "out.pt")
    return result


def test_the_page_has_its_examples():
    """Fit, render and score in five lines after the import; fit a pose to one picture in about twenty."""
    lines = [line for line in BLOCKS[0].splitlines() if line and not line.startswith("import")]
    assert len(lines) == 5
    assert len([line for line in BLOCKS[-1].splitlines() if line]) <= 22


@pytest.mark.parametrize("index", range(len(BLOCKS)))
def test_every_example_of_the_page_runs(index, inputs, fitted, tmp_path, monkeypatch):
    """As written, but for the preset and the steps, which take minutes there and a second here."""
    work = Path(shutil.copytree(inputs, tmp_path / "work"))
    block = BLOCKS[index].replace('preset("quick")', 'preset("tiny.toml")').replace("range(100)", "range(10)")
    if 'out="out.pt"' in block:
        (work / "out.pt").unlink()
    avatar = fitted.avatar
    picture = avatar.render(avatar.head.pose(1), avatar.capture.mean_camera()).image
    pixels = (255.0 * picture.clamp(0.0, 1.0)).round().byte().permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save(work / "picture.png")
    monkeypatch.chdir(work)
    exec(compile(block, f"{PAGE.name}[{index}]", "exec"), {"__name__": "example"})  # noqa: S102


def test_a_pose_is_found_from_a_picture(fitted):
    """Rotations, translation and expression come back from an image of the avatar itself."""
    avatar = fitted.avatar
    camera = avatar.capture.mean_camera()
    true = replace(
        avatar.mean_pose(),
        rotation=torch.tensor([0.05, 0.2, -0.03]),
        translation=torch.tensor([0.006, -0.004, 0.003]),
    )
    picture = avatar.render(true, camera).image
    pose = avatar.mean_pose()
    optimizer = torch.optim.Adam([{"params": [pose.rotation.requires_grad_()], "lr": 1e-2},
                                  {"params": [pose.translation.requires_grad_()], "lr": 5e-4}])  # fmt: skip
    losses = []
    for _ in range(40):
        loss = (avatar.render(pose, camera, grad=True).image - picture).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]


@pytest.fixture(scope="module")
def smooth(inputs) -> mgavatar.Avatar:
    """An avatar whose image is smooth in everything: no truncation, and colours that no view direction changes."""
    config = tiny_config()
    color_net = replace(config.appearance.color_net, view_frame="none")
    appearance = replace(config.appearance, color_net=color_net)
    config = replace(config, raster=RasterConfig(accuracy="exact"), appearance=appearance)
    return mgavatar.fit(mgavatar.read_capture(inputs / "subject_dir"), tiny_head(), config).avatar


VALUES = ("rotation", "neck_pose", "jaw_pose", "translation", "viewmat", "background")
# Expressions move the tiny head so little that the kinks of OffsetNet's leaky ReLUs hide the difference.
CASES = [(name, True) for name in VALUES] + [(name, False) for name in ("expr", *VALUES)]


@pytest.mark.parametrize(("name", "offset_net"), CASES)
def test_gradients_of_a_rendering_are_those_of_finite_differences(name, offset_net, smooth, request):
    """Along a random direction in the pose, the expression, the camera and the background."""
    if not offset_net:
        request.addfinalizer(partial(setattr, smooth.appearance, "offset_net", smooth.appearance.offset_net))
        smooth.appearance.offset_net = None
    # OffsetNet makes the image rough: shorter steps, and a looser bound. Expressions take longer steps, because single
    # precision would hide the difference.
    step, tolerance = (1e-4, 0.08) if offset_net else (3e-4, 0.03)
    step = 1e-2 if name == "expr" else step
    camera = smooth.capture.mean_camera()
    start = Pose(**{entry.name: getattr(smooth.head.pose(1), entry.name).detach().clone() for entry in fields(Pose)})
    own = {"viewmat": torch.tensor(camera.viewmat, dtype=torch.float32), "background": torch.tensor([0.3, 0.6, 0.9])}
    value = own.get(name, getattr(start, name, None))
    y, x = torch.linspace(-1, 1, camera.height)[:, None], torch.linspace(-1, 1, camera.width)[None]
    weights = torch.stack([y.expand(-1, camera.width), x.expand(camera.height, -1), y * x])

    def loss(value: torch.Tensor, *, grad: bool) -> torch.Tensor:
        pose = start if name in own else replace(start, **{name: value})
        more: dict[str, Any] = {name: value} if name in own else {}
        return (smooth.render(pose, camera, grad=grad, **more).image * weights).double().sum()

    leaf = value.clone().requires_grad_()
    loss(leaf, grad=True).backward()
    torch.manual_seed(1)
    direction = torch.randn_like(value)
    if name == "viewmat":
        direction[3] = 0.0
    ahead, back = (loss(value + sign * step * direction, grad=False) for sign in (1.0, -1.0))
    assert float((leaf.grad * direction).sum()) == pytest.approx(float(ahead - back) / (2.0 * step), rel=tolerance)


def test_without_a_request_nothing_keeps_a_gradient(fitted):
    """Parameters of a finished avatar are frozen, and a rendering has no graph."""
    avatar = fitted.avatar
    pose = replace(avatar.mean_pose(), rotation=torch.zeros(3, requires_grad=True))
    assert not avatar.render(pose, avatar.capture.mean_camera()).image.requires_grad
    assert not any(parameter.requires_grad for parameter in avatar.vertex_gaussians.parameters())
    assert not any(parameter.requires_grad for parameter in avatar.appearance.parameters())


def test_a_fit_without_a_folder_writes_and_prints_nothing(inputs, tmp_path, monkeypatch, capfd):
    """And gives the same avatar as one that writes; torch's global generator goes on as if nothing had been."""
    monkeypatch.chdir(tmp_path)
    subject = mgavatar.read_capture(inputs / "subject_dir")
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    result = mgavatar.fit(subject, tiny_head(), tiny_config())
    assert torch.equal(torch.rand(3), expected)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")
    assert (result.finished, result.path, result.report) == (True, None, None)
    assert result.scores["splits"]["val"]["psnr"] > 10.0
    again = mgavatar.fit(subject, tiny_head(), tiny_config(), out=tmp_path / "run")
    one, other = (fit.avatar.appearance.state_dict() for fit in (result, again))
    assert all(torch.equal(one[name], other[name]) for name in one if isinstance(one[name], torch.Tensor))


def test_two_fits_in_threads(inputs):
    """Each gives what it gives alone, and the handler of Ctrl-C stays the main thread's."""
    subject = mgavatar.read_capture(inputs / "subject_dir")
    handler = signal.getsignal(signal.SIGINT)
    found: dict[int, Any] = {}

    def work(seed: int) -> None:
        found[seed] = mgavatar.fit(subject, tiny_head(), tiny_config(), seed=seed).avatar.appearance.state_dict()

    threads = [threading.Thread(target=work, args=(seed,)) for seed in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert signal.getsignal(signal.SIGINT) is handler
    alone = mgavatar.fit(subject, tiny_head(), tiny_config(), seed=1).avatar.appearance.state_dict()
    for name, value in alone.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(found[1][name], value), name
    assert not torch.equal(found[0]["gaussians.local_means"], found[1]["gaussians.local_means"])


def test_progress_and_stop(inputs, tmp_path):
    """Every iteration is reported; a stopped fit has its avatar and goes on to the same end."""
    subject = mgavatar.read_capture(inputs / "subject_dir")
    seen: list[tuple[str, int, int]] = []

    def note(progress: FitProgress) -> None:
        seen.append((progress.stage, progress.iteration, progress.total))
        assert progress.terms["loss"] > 0.0

    out = tmp_path / "run"
    stopped = mgavatar.fit(subject, tiny_head(), tiny_config(), out=out, progress=note, stop=lambda: len(seen) >= 15)
    assert (stopped.finished, stopped.stopped_at) == (False, "stopped in appearance at 3/12")
    assert seen == [("geometry", n, 12) for n in range(1, 13)] + [("appearance", n, 12) for n in range(1, 4)]
    assert mgavatar.Avatar.load(out).appearance is not None
    whole = mgavatar.fit(subject, tiny_head(), tiny_config(), out=out, resume=True)
    alone = mgavatar.fit(subject, tiny_head(), tiny_config())
    one, other = (fit.avatar.appearance.state_dict() for fit in (whole, alone))
    assert whole.finished
    assert all(torch.equal(one[name], other[name]) for name in one if isinstance(one[name], torch.Tensor))


@pytest.mark.parametrize("broken", ["mgavatar.pipeline.evaluate_sample", "mgavatar.pipeline.write_report"])
def test_scoring_and_reporting_never_cost_a_finished_fit(broken, inputs, tmp_path, monkeypatch, caplog):
    """Whatever goes wrong after the fit is a warning: the avatar is there."""

    def fails(*_: Any, **__: Any) -> None:
        raise RuntimeError("out of\nmemory")

    monkeypatch.setattr(broken, fails)
    subject = mgavatar.read_capture(inputs / "subject_dir")
    with caplog.at_level(logging.WARNING, logger="mgavatar"):
        result = mgavatar.fit(subject, tiny_head(), tiny_config(), out=tmp_path / "run")
    assert result.finished
    assert mgavatar.Avatar.load(result.path).appearance is not None
    assert any("the avatar is complete" in record.message and "\n" not in record.message for record in caplog.records)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": -1}, "--seed -1"),
        ({"device": "tpu"}, "--device tpu"),
        ({"budget": "soon"}, "--budget soon"),
        ({"resume": True}, "nothing to resume"),
    ],
)
def test_a_wrong_argument_is_refused_before_any_iteration(change, words, inputs, tmp_path, monkeypatch):
    """As on the command line, and nothing is written."""
    for stage in (GeometryStage, AppearanceStage):
        monkeypatch.setattr(stage, "step", None)
    subject = mgavatar.read_capture(inputs / "subject_dir")
    with pytest.raises(mgavatar.DataError, match=words):
        mgavatar.fit(subject, tiny_head(), tiny_config(), out=tmp_path / "run", **change)
    assert not (tmp_path / "run").exists()


def test_a_preset_is_checked():
    """A key that does not exist, or a value that cannot be, does not pass."""
    assert mgavatar.preset("quick,monocular").geometry.pose_offsets is False
    with pytest.raises(mgavatar.DataError, match="no preset 'slow'"):
        mgavatar.preset("slow")


def test_head_models_by_name(monkeypatch):
    """``"builtin"``, as on the command line; text and paths both name files."""
    monkeypatch.setattr("mgavatar.head.find.build_head", lambda: "the built-in head")
    assert mgavatar.load_head_model("builtin") == "the built-in head"
    for name in ("absent.npz", Path("absent.npz")):
        with pytest.raises(mgavatar.DataError, match=r"absent\.npz: no such file"):
            mgavatar.load_head_model(name)
