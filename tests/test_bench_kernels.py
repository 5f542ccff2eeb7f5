"""The benchmark of the kernels: plain forms compute the same, table and JSON hold what was measured."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import pytest
import torch
from tiny_avatar import tiny_avatar

from mgavatar import cli
from mgavatar.benchmarks import kernels as bench
from mgavatar.benchmarks import kernels_work
from mgavatar.errors import DataError
from mgavatar.kernels import bridge

CPU = torch.device("cpu")


def loss_of(step):
    """The value whose backward pass a step returns."""
    return float(step().__self__.detach())


@pytest.mark.parametrize(
    "job",
    [
        kernels_work.raster_job("rasterize", 2000, (64, 48), CPU),
        kernels_work.raster_job("rasterize, opaque", 2000, (64, 48), CPU, opaque=True),
        kernels_work.views_job(1000, (64, 48), CPU),
        kernels_work.lbs_job(CPU, n_verts=2000, n_dirs=9),
        *kernels_work.mesh_jobs(CPU),
    ],
    ids=lambda job: job.name,
)
def test_plain_forms_compute_the_same(job):
    """Otherwise the ratio means nothing."""
    value = loss_of(job.step)
    assert value > 0
    assert loss_of(job.plain) == pytest.approx(value, rel=1e-4)


def test_a_fitted_avatar_is_timed_as_it_is_drawn(tmp_path):
    """Its own Gaussians from its own camera; what it is drawn on does not matter."""
    avatar, _ = tiny_avatar(tmp_path)
    avatar.save(tmp_path / "avatar.pt")
    job = kernels_work.avatar_job(tmp_path / "avatar.pt", CPU)
    drawn = avatar.render(avatar.mean_pose(), avatar.capture.mean_camera(), background=torch.zeros(3))
    assert drawn.alphas.mean() > 0.02
    assert loss_of(job.step) == pytest.approx(float(drawn.image.square().sum()), rel=1e-4)
    assert loss_of(job.plain) == pytest.approx(loss_of(job.step), rel=1e-4)
    assert job.operations > 0
    names = [job.name for job in islice(kernels_work.jobs(CPU, tmp_path / "avatar.pt"), 5)]
    assert names[3:] == ["rasterize, several views", "rasterize, fitted avatar"]


def test_a_file_that_is_no_avatar_is_named(tmp_path):
    """The path is in the message."""
    (tmp_path / "avatar.pt").write_bytes(b"no avatar")
    with pytest.raises(DataError, match=r"avatar\.pt"):
        kernels_work.avatar_job(tmp_path / "avatar.pt", CPU)


def test_the_hash_grid_and_its_plain_form_take_the_same_steps():
    """Both step an optimizer, so that the loss falls."""
    job = kernels_work.hash_grid_job(CPU, n=500, log2_table_size=10)
    for step in (job.step, job.plain):
        for _ in range(2):
            step()()


def test_the_head_scene_covers_the_image_alike_for_any_number():
    """Pixels inside ellipses hardly depend on N: sizes shrink as numbers grow."""
    few, many = (kernels_work.raster_job("", n, (512, 512), CPU).operations for n in (5000, 20_000))
    assert 0.5 < few / many < 2
    assert few / sum(kernels_work.RASTER_OPERATIONS) > 5e6


def test_exponent_of_a_power_law():
    """Slope of the logarithms."""
    assert bench._exponent([1, 10, 100], [2, 2 * 10**1.5, 2 * 10**3]) == pytest.approx(1.5)


def test_table_and_json(monkeypatch, tmp_path):
    """One small row goes all the way; threads are put back."""
    small = kernels_work.raster_job("rasterize", 500, (32, 32), CPU)
    monkeypatch.setattr(bench, "jobs", lambda device, avatar: iter([small]))
    monkeypatch.setattr(bench, "_exponents", lambda device: {"Gaussians": 1.0})
    share = bench._blending_share
    monkeypatch.setattr(bench, "_blending_share", lambda n, size, device: share(n // 40, (64, 64), device))
    before = bridge.num_threads()
    text = bench.bench_kernels(threads=1, json_path=tmp_path / "bench.json")
    assert bridge.num_threads() == before
    report = json.loads((tmp_path / "bench.json").read_text())
    (row,) = report["rows"]
    assert {"device", "commit", "rows"} <= set(report)
    assert set(row) == {
        "name", "work", "threads", "forward_ms", "backward_ms", "spread", "floor_ms", "plain_ms"
    }  # fmt: skip
    assert row["threads"] == 1
    assert min(row["forward_ms"], row["backward_ms"], row["floor_ms"], row["plain_ms"]) > 0
    assert "rasterize" in text
    assert "exponents of its time: Gaussians 1.00" in text
    assert 0 < report["blending_share"] < 1.5


def test_no_threads_are_refused():
    """The message names the flag."""
    with pytest.raises(DataError, match="--threads 0: must be at least 1"):
        bench.bench_kernels(threads=0)


@pytest.mark.parametrize("path", ["nowhere/bench.json", "."])
def test_a_report_that_cannot_be_written_is_refused_before_the_measurement(monkeypatch, tmp_path, path):
    """A missing folder and a folder in place of a file."""
    monkeypatch.setattr(bench, "calibrate", lambda device: pytest.fail("measured before the check"))
    with pytest.raises(DataError, match="folder"):
        bench.bench_kernels(threads=1, json_path=tmp_path / path)


def test_flags_of_the_command_arrive(monkeypatch, capsys, tmp_path):
    """``mgavatar bench kernels`` has flags of its own; the folder of a fit stands for its avatar."""
    given = {}
    monkeypatch.setattr(bench, "bench_kernels", lambda **options: given.update(options) or "the table")
    flags = ["--threads", "2", "--json", "rows.json", "--device", "cpu", "--avatar", str(tmp_path)]
    monkeypatch.setattr("sys.argv", ["mgavatar", "bench", "kernels", *flags])
    cli.main()
    assert capsys.readouterr().out == "the table\n"
    avatar = tmp_path / "avatar.pt"
    assert given == {"threads": 2, "json_path": Path("rows.json"), "device": "cpu", "avatar": avatar}


@pytest.mark.parametrize(
    ("argv", "word"), [([], "kernels"), (["nothing"], "nothing"), (["kernels", "--views", "2"], "--views")]
)
def test_a_wrong_benchmark_or_flag_is_a_wrong_command_line(monkeypatch, capsys, argv, word):
    """Exit code 2, and the message says what there is."""
    monkeypatch.setattr("sys.argv", ["mgavatar", "bench", *argv])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    assert word in capsys.readouterr().err
