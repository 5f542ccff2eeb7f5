"""The price of every shortcut: the table is complete, the exact setting is exact, errors grow with what is left out."""

from __future__ import annotations

import json
from dataclasses import replace

import bench_trade as trade
import command_line
import pytest
import torch
import trade_objective as objective
import trade_raster as raster
from markdown_cells import cells_of
from PIL import Image
from tiny_avatar import tiny_avatar
from trade_chart import table

from mgavatar.config import ACCURACY, RasterConfig
from mgavatar.gaussians import Gaussians, draw
from mgavatar.losses import ssim

KNOBS = {
    "raster.accuracy": ["exact", "accurate", "balanced", "fast"],
    "alpha threshold": ["0", "1e-8", "1e-6", "1/1024", "1/255", "1/64"],
    "stop": ["0", "1e-4", "1e-3", "1e-2"],
    "low-pass": ["0", "0.1", "0.3"],
    "extent": ["ellipse", "3 sigma"],
    "exp": ["polynomial", "exact"],
    "storage": ["float64, plain form", "float32, plain form", "float32", "float16"],
    "image scale": ["1", "1/2"],
    "SSIM window": ["11", "7"],
    "SSIM scale": ["1", "1/2"],
    "hash levels": ["16", "8", "4"],
    "hash table": ["2^19", "2^16", "2^14"],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One small measurement: its rows by knob and value, its text and its folder."""
    root = tmp_path_factory.mktemp("trade")
    avatar, _ = tiny_avatar(root, size=(24, 32))
    avatar.save(root / "avatar.pt")
    text = trade.bench_trade(
        avatar=root,
        data=root / "capture",
        out=root / "out",
        views=2,
        rounds=1,
        regression_steps=4,
        threads=1,
    )
    report = json.loads((root / "out" / "trade.json").read_text())
    return {(row["knob"], row["value"]): row for row in report["rows"]}, report, text, root / "out"


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Exact steps of two small views."""
    avatar, subject = tiny_avatar(tmp_path_factory.mktemp("views"), size=(24, 32))
    return raster.Reference(raster.scenes_of(avatar, subject, views=2, max_image_size=600))


def test_no_knob_and_no_value_is_missing(run):
    """Every knob of the kernels is there, with one default to compare its times with."""
    rows = run[0]
    found = {knob: [value for k, value in rows if k == knob] for knob, _ in rows}
    assert found == KNOBS
    for knob in KNOBS:
        assert sum(row["default"] for (k, _), row in rows.items() if k == knob) == 1


def test_every_row_is_filled(run):
    """Rows of the rasterizer have an image, gradients and, except what is emulated, a time; the others theirs."""
    for (knob, value), row in run[0].items():
        if (knob, value) != ("storage", "float16"):
            assert row["ratio"] > 0
        if knob.startswith("SSIM"):
            assert set(row["gradient"]) == {"image"}
        elif knob.startswith("hash"):
            assert 0 < row["psnr"] < 100
        else:
            assert set(row["gradient"]) == set(raster.GRADIENTS)
            assert row["psnr"] > 20
            assert row["worst"] < 1


def test_the_exact_setting_is_exact(reference):
    """Against itself there is no error at all; below its threshold there is nothing left."""
    same = raster._score([reference.step(0, 0.3)], [raster.run_step(reference.scenes[0], raster.EXACT)])
    assert same.psnr == raster.PSNR_LIMIT
    assert same.worst == 0
    assert set(same.gradient.values()) == {0}
    assert reference.remainder() < 1e-9


def test_errors_grow_with_the_alpha_threshold(run):
    """Image and gradients, from rounding to what is plainly visible; the level of the same name is no better."""
    rows = [run[0]["alpha threshold", value] for value in ("1e-6", "1/1024", "1/255", "1/64")]
    assert [r["psnr"] for r in rows] == sorted((r["psnr"] for r in rows), reverse=True)
    for name in ("means", "scales"):
        errors = [r["gradient"][name] for r in rows]
        assert errors == sorted(errors)
    assert run[0]["alpha threshold", "1e-8"]["psnr"] > 110 > rows[1]["psnr"]
    assert rows[-1]["gradient"]["means"] > 10 * rows[1]["gradient"]["means"]


def test_levels_are_ordered_and_are_their_thresholds(run):
    """Each level leaves out what the configuration says, and more than the one before it."""
    values = [run[0]["raster.accuracy", name] for name in ACCURACY]
    assert [r["psnr"] for r in values] == sorted((r["psnr"] for r in values), reverse=True)
    settings = {s.value: s.timed for s in raster.raster_knobs()[0]}
    assert {name: (s.alpha_threshold, s.stop) for name, s in settings.items()} == ACCURACY


def test_drawing_follows_the_level(reference):
    """What the table calls a level is what an avatar with that configuration is drawn with."""
    scene = reference.scenes[0]
    gaussians = Gaussians(*scene.gaussians)
    for setting in raster.raster_knobs()[0]:
        config = RasterConfig(accuracy=setting.value)
        image = draw(gaussians, scene.camera, background=scene.background, config=config).image
        assert torch.equal(image, raster.run_step(scene, setting.timed, setting).image)


def test_what_is_emulated_has_an_effect(run):
    """The edit reaches the blending and is gone afterwards; rounding to half costs more than to single precision."""
    rows = run[0]
    assert rows["storage", "float64, plain form"]["psnr"] > rows["storage", "float32"]["psnr"] + 10
    assert rows["storage", "float32"]["psnr"] > rows["storage", "float16"]["psnr"] + 10
    assert rows["extent", "ellipse"]["psnr"] > rows["extent", "3 sigma"]["psnr"] + 10
    assert rows["image scale", "1"]["psnr"] > rows["image scale", "1/2"]["psnr"] + 10
    assert rows["storage", "float16"]["ms"] is None
    assert "another image" in rows["low-pass", "0"]["note"]


def test_both_exponentials_agree(reference):
    """The C library's and the polynomial differ by rounding; they are two builds, not one."""
    scene = reference.scenes[0]
    settings = [replace(raster.NEARLY_EXACT, exp=name) for name in ("polynomial", "exact")]
    images = [raster.run_step(scene, s, raster._changed("exp", s.exp, exp=s.exp)).image for s in settings]
    assert float((images[0] - images[1]).abs().max()) < 1e-6
    assert not torch.equal(*images)
    with pytest.raises(ValueError, match="exp must be one of polynomial, exact"):
        raster.run_step(scene, replace(raster.BALANCED, exp="table"))


def test_the_plain_window_is_the_ssim_of_the_losses(rng):
    """With 11 pixels; with 7 it is another number."""
    a, b = torch.rand(2, 3, 20, 17, generator=rng, dtype=torch.float64)
    assert float(objective.window_ssim(a, b, 11)) == pytest.approx(float(ssim(a, b)), abs=1e-9)
    assert abs(float(objective.window_ssim(a, b, 7)) - float(ssim(a, b))) > 1e-6


def test_colors_are_those_of_the_capture(reference):
    """A Gaussian in front gets the image's colour at its centre, one behind the head none."""
    scene = reference.scenes[0]
    flat = replace(scene, target=torch.tensor([0.2, 0.4, 0.6])[:, None, None].expand_as(scene.target))
    colors, seen = objective.seen_colors([flat])
    assert 0 < int(seen.sum()) < len(seen)
    assert torch.allclose(colors[seen], torch.tensor([0.2, 0.4, 0.6]).expand(int(seen.sum()), 3), atol=1e-6)
    depth = scene.gaussians[0] @ torch.tensor(scene.camera.viewmat[2, :3], dtype=torch.float32)
    assert depth[seen].mean() < depth[~seen].mean()


def test_table_and_picture(run):
    """The text names machine, scene and every knob; the picture is small enough for a page."""
    rows, report, text, folder = run
    assert {"device", "threads", "commit", "date", "gaussians", "views", "size", "rows"} <= set(report)
    assert (report["views"], report["size"]) == (2, [24, 32])
    assert (folder / "trade.md").read_text() == text + "\n"
    for knob in KNOBS:
        assert f"| {knob} " in text
    assert len(cells_of(text)) == len(rows) + 1
    with Image.open(folder / "trade.png") as picture:
        assert min(picture.size) > 1000
        assert len(picture.convert("RGB").getcolors(10**6)) > 8
    assert (folder / "trade.png").stat().st_size < 200_000


def test_cells():
    """Small shares as powers, large ones in percent, nothing where nothing applies."""
    row = raster.Row(
        knob="a", value="b", ratio=0.91234, psnr=51.23, worst=0.012, gradient={"means": 0.0312, "quats": 1e-5}
    )
    assert cells_of(table([row]))[1] == ["a", "b", "", "0.91", "51.2 dB", "1.2e-02", "3.1 %", "", "", "", ""]


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (1 / 255, "1/255"), (1e-4, "1e-4"), (1e-2, "1e-2"), (0.3, "0.3"), (1 / 64, "1/64")]
)
def test_fractions(value, text):
    """As a person would write them."""
    assert raster.fraction(value) == text


def run_tool(monkeypatch, *flags):
    """Call the script's command line; return its exit code."""
    monkeypatch.setattr("sys.argv", ["tools/bench_trade.py", *map(str, flags)])
    with pytest.raises(SystemExit) as stop:
        command_line.run(trade.bench_trade)
    return stop.value.code


def test_a_wrong_command_line_is_said_in_one_line(monkeypatch, capsys, tmp_path):
    """A number out of range, a folder that cannot be made and a missing avatar: exit code 1, before any work."""
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    flags = ("--avatar", tmp_path / "nothing.pt", "--data", tmp_path)
    place = "a file stands where a folder is needed; give another path"
    for more, words in (
        (("--views", 0), "bench_trade.py: --views 0: must be at least 1\n"),
        (("--out", blocked / "out"), f"{blocked / 'out'}: cannot be written: Not a directory; {place}\n"),
        (("--out", tmp_path / "out"), "nothing.pt: no such file\n"),
    ):
        assert run_tool(monkeypatch, *flags, *more) == 1
        assert capsys.readouterr().err.endswith(words)


def test_a_missing_flag_is_a_wrong_command_line(monkeypatch, capsys, tmp_path):
    """Exit code 2, and the message names the flag."""
    assert run_tool(monkeypatch, "--avatar", tmp_path) == 2
    assert "--data" in capsys.readouterr().err
