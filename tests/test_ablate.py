"""Presets side by side: which cells are fitted, what the table says, what the sheet shows."""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import ablate
import numpy as np
import pytest
import torch
from ablate import Options, main, plan_cells, run_command
from ablate_sheet import contact_sheet
from markdown_cells import cells_of
from PIL import Image
from tiny import tiny_config, tiny_head, write_tiny_capture
from tiny_avatar import tiny_avatar

from mgavatar.errors import DataError
from mgavatar.head.load import save_head_model
from mgavatar.presets import to_toml

REASON = "no weights given (--lpips-weights)"
GEOMETRY = {
    "mean_mm": 1.5,
    "flipped_faces": 2,
    "self_intersections": {"fitted": 1234, "parametric": 1200, "added": 40},
    "regions": {"face+scalp": {"mean_mm": 2.5}, "all": {"mean_mm": 3.25}},
}


@pytest.fixture
def captures(tmp_path: Path) -> list[str]:
    """Folders that look like captures from outside."""
    for name in ("ann", "bob"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "transforms_train.json").write_text("{}")
    return [str(tmp_path / "ann"), str(tmp_path / "bob")]


class FakeMgavatar:
    """Takes the place of the processes: writes what they would, remembers what it was asked for."""

    def __init__(self) -> None:
        self.asked: list[Sequence[str]] = []
        self.breaks: Callable[[Sequence[str]], bool] = lambda command: False

    def __call__(self, command: Sequence[str], log: Path) -> int:
        self.asked.append(command)
        values = dict(itertools.pairwise(command))
        if self.breaks(command):
            log.write_text("mgavatar: something\nmgavatar: bob.png: is damaged\n\n")
            return 1
        if command[0] == "fit":
            stages = {"geometry": {"iterations": 500}, "appearance": {"iterations": 1800}}
            run = Path(values["--out"])
            run.mkdir(exist_ok=True)
            summary = {"seconds": 61.4, "peak_mib": 812.3, "gaussians": 40128, "stages": stages}
            (run / "summary.json").write_text(json.dumps(summary))
        else:
            psnr = 31.0 if "baseline" in values["--avatar"] else 30.0
            psnr += 2.0 * ("seed5" in values["--avatar"])
            lpips = 0.125 if "--lpips-weights" in values else None
            score = {"psnr": psnr, "ssim": 0.9, "lpips": lpips, "lpips_reason": None if lpips else REASON}
            metrics = {"splits": {"val": score, "test": score}, "geometry": GEOMETRY}
            if "bob" in values["--data"]:
                metrics = {"splits": {"test": score}, "geometry": None}
            Path(values["--json"]).write_text(json.dumps(metrics))
        return 0

    def verbs(self) -> list[str]:
        return [command[0] + (" --resume" if "--resume" in command else "") for command in self.asked]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeMgavatar:
    made = FakeMgavatar()
    monkeypatch.setattr(ablate, "run_command", made)
    monkeypatch.setattr(ablate, "write_sheet", lambda cells, options: None)
    return made


def _run(tmp_path: Path, captures: Sequence[str], *more: str) -> int:
    return main(
        ["--presets", "quick", "quick,baseline", "--captures", *captures, "--out", str(tmp_path / "out"), *more]
    )


def test_every_cell_is_fitted_and_scored_under_the_same_conditions(
    tmp_path: Path, captures: list[str], fake: FakeMgavatar
) -> None:
    head = tmp_path / "head.npz"
    head.write_text("")
    assert _run(tmp_path, [captures[0], f"{captures[1]}:{head}"], "--budget", "3m", "--seeds", "7") == 0
    assert fake.verbs() == ["fit", "evaluate"] * 4
    fits = [command for command in fake.asked if command[0] == "fit"]
    for command in fits:
        assert [command[i : i + 2] for i in range(7, len(command)) if command[i] in ("--seed", "--budget")] == [
            ["--seed", "7"],
            ["--budget", "3m"],
        ]
    assert [command[6] for command in fits] == ["quick", "quick,baseline"] * 2
    assert ["--head-model" in command for command in fits] == [False, False, True, True]
    assert fits[3][4] == str(tmp_path / "out/bob/quick+baseline/seed7/run")
    rows = json.loads((tmp_path / "out/table.json").read_text())["rows"]
    assert [(row["capture"], row["preset"]) for row in rows] == [
        ("ann", "quick"), ("ann", "quick,baseline"), ("bob", "quick"), ("bob", "quick,baseline"),
    ]  # fmt: skip
    assert rows[1]["val"] == {"psnr": 31.0, "ssim": 0.9, "lpips": None, "lpips_reason": REASON}
    assert rows[1]["geometry"] == {
        "mean_mm": 1.5, "face_scalp_mm": 2.5, "all_mm": 3.25, "flipped_faces": 2, "crossings": 1234,
        "new_crossings": 40,
    }  # fmt: skip
    assert rows[1]["iterations"] == {"geometry": 500, "appearance": 1800}
    assert (rows[1]["gaussians"], rows[1]["seconds"], rows[1]["peak_mib"]) == (40128, 61.4, 812.3)
    assert (rows[3]["val"], rows[3]["geometry"]) == (None, None)


def test_the_table_shows_differences_to_the_first_preset(
    tmp_path: Path, captures: list[str], fake: FakeMgavatar
) -> None:
    assert _run(tmp_path, captures) == 0
    text = (tmp_path / "out/table.md").read_text()
    titles, first, second, third, _ = cells_of(text)
    named = dict(zip(titles, second, strict=True))
    assert named["val PSNR"] == "31.00 (+1.00)"
    assert named["val LPIPS"] == "–"
    assert named["crossings"] == "1,234 (+0)"
    assert named["Gaussians"] == "40,128"
    assert named["iterations"] == "500 + 1,800"
    assert dict(zip(titles, first, strict=True))["val PSNR"] == "30.00"
    assert dict(zip(titles, third, strict=True))["test PSNR"] == "30.00"  # another capture: compared with its own first
    assert dict(zip(titles, third, strict=True))["val PSNR"] == "–"
    assert text.count(f"* LPIPS: {REASON}.") == 1


def test_several_seeds_become_one_row_of_means(tmp_path: Path, captures: list[str], fake: FakeMgavatar) -> None:
    """Each seed is a cell of its own; one that fails is said and left out of the means."""
    assert _run(tmp_path, captures[:1], "--seeds", "4", "5") == 0
    fits = [dict(itertools.pairwise(command)) for command in fake.asked if command[0] == "fit"]
    assert [(fit["--preset"], fit["--seed"]) for fit in fits] == list(
        itertools.product(["quick", "quick,baseline"], ["4", "5"])
    )
    rows = json.loads((tmp_path / "out/table.json").read_text())["rows"]
    assert [row["val"]["psnr"] for row in rows] == [30.0, 32.0, 31.0, 33.0]
    text = (tmp_path / "out/table.md").read_text()
    assert [row[:3] for row in cells_of(text)[1:]] == [
        ["ann", "quick", "31.00 ± 1.41"],
        ["ann", "quick,baseline", "32.00 ± 1.41 (+1.00)"],
    ]
    assert "seeds 4, 5" in text
    fake.breaks = lambda command: "seed6" in " ".join(command)
    assert _run(tmp_path, captures[:1], "--seeds", "4", "6") == 1
    text = (tmp_path / "out/table.md").read_text()
    assert cells_of(text)[1][:3] == ["ann", "quick", "30.00"]
    assert "* ann, quick, seed 6: fit ended with 1" in text
    with pytest.raises(DataError, match="share a name"):
        plan_cells(["quick"], captures, Options(tmp_path / "out", seeds=(1, 1)))


def test_what_is_done_is_not_done_again(tmp_path: Path, captures: list[str], fake: FakeMgavatar) -> None:
    """Scores stay; an interrupted fit goes on; one that had not saved itself starts again; a finished one is scored."""
    ann = tmp_path / "out/ann/quick/seed0"
    assert _run(tmp_path, captures) == 0
    fake.asked.clear()
    assert _run(tmp_path, captures) == 0
    assert fake.asked == []
    (ann / "metrics.json").unlink()
    assert _run(tmp_path, captures) == 0
    assert fake.verbs() == ["evaluate"]
    fake.asked.clear()
    for name in ("metrics.json", "run/summary.json"):
        (ann / name).unlink()
    (ann / "run/checkpoint.pt").write_text("")
    assert _run(tmp_path, captures) == 0
    assert fake.verbs() == ["fit --resume", "evaluate"]
    fake.asked.clear()
    for name in ("metrics.json", "run/summary.json", "run/checkpoint.pt"):
        (ann / name).unlink()
    (ann / "run/config.toml").write_text("")
    assert _run(tmp_path, captures) == 0
    assert fake.verbs() == ["fit", "evaluate"]
    assert not (ann / "run/config.toml").exists()
    fake.asked.clear()
    weights = tmp_path / "w.pth"
    assert _run(tmp_path, captures, "--lpips-weights", str(weights)) == 0
    assert fake.verbs() == ["evaluate"] * 4
    assert _run(tmp_path, captures, "--lpips-weights", str(weights)) == 0
    assert len(fake.asked) == 4


def test_a_failed_cell_is_reported_and_the_others_go_on(
    tmp_path: Path, captures: list[str], fake: FakeMgavatar, capsys: pytest.CaptureFixture[str]
) -> None:
    fake.breaks = lambda command: "bob/quick/" in " ".join(command)
    assert _run(tmp_path, captures[::-1]) == 1
    assert "fit ended with 1: mgavatar: bob.png: is damaged" in capsys.readouterr().err
    text = (tmp_path / "out/table.md").read_text()
    assert ["bob", "quick", "failed"] in [row[:3] for row in cells_of(text)]
    assert "* bob, quick, seed 0: fit ended with 1: mgavatar: bob.png: is damaged" in text
    assert ["bob", "quick,baseline"] in [
        row[:2] for row in cells_of(text)
    ]  # its reference is missing, its figures are not
    fake.breaks = lambda command: command[0] == "evaluate"
    assert _run(tmp_path, captures[::-1]) == 1
    assert "evaluate ended with 1" in capsys.readouterr().err
    fake.breaks = lambda command: False
    fake.asked.clear()
    assert _run(tmp_path, captures[::-1]) == 0
    assert fake.verbs() == ["evaluate"]


def test_cells_of_other_conditions_are_refused(
    tmp_path: Path, captures: list[str], fake: FakeMgavatar, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another budget, or a preset whose file has changed: figures would not be comparable."""
    assert _run(tmp_path, captures) == 0
    fake.asked.clear()
    assert _run(tmp_path, captures, "--budget", "1m") == 1
    assert "was made under other conditions" in capsys.readouterr().err
    assert fake.asked == []
    preset = tmp_path / "mine.toml"
    preset.write_text("[geometry]\niterations = 3\n")
    options = Options(tmp_path / "out")
    (cell,) = plan_cells([str(preset)], captures[:1], options)
    assert cell.folder == tmp_path / "out/ann/mine/seed0"
    assert ablate.complete(cell) is None
    preset.write_text("[geometry]\niterations = 4\n")
    with pytest.raises(DataError, match="was made under other conditions"):
        plan_cells([str(preset)], captures[:1], options)


def test_what_is_missing_is_said_before_any_work(tmp_path: Path, captures: list[str], fake: FakeMgavatar) -> None:
    options = Options(tmp_path / "out")
    for presets, places, message in (
        (["quik"], captures, "no preset 'quik'"),
        (["quick"], [str(tmp_path / "gone")], "no transforms_train.json"),
        (["quick"], [f"{captures[0]}:{tmp_path}/head.npz"], r"head\.npz: no such file"),
        (["quick", "quick"], captures, "share a name"),
        (["quick"], [captures[0], captures[0]], "share a name"),
    ):
        with pytest.raises(DataError, match=message):
            plan_cells(presets, places, options)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="processes are stopped by POSIX signals")
def test_an_interrupt_reaches_the_fit_once_and_waits_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fit saves itself; a second signal would stop it at once, so it does not get the terminal's Ctrl-C too."""
    child = """
import os, signal, sys, time
seen = []
signal.signal(signal.SIGINT, lambda *_: seen.append(1))
print("ready", flush=True)
while not seen: time.sleep(0.01)
time.sleep(0.3)
print("saved", len(seen), sys.argv[1:], os.getpgrp() == os.getpgid(os.getppid()), flush=True)
sys.exit(130)
"""
    monkeypatch.setattr(ablate, "MGAVATAR", (sys.executable, "-c", child))
    log = tmp_path / "log.txt"
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background start without it

    def interrupt() -> None:
        while not log.exists() or "ready" not in log.read_text():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    waiting = threading.Thread(target=interrupt)
    waiting.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_command(["fit", "--out", "x"], log)
    finally:
        signal.signal(signal.SIGINT, before)
    waiting.join()
    assert log.read_text().splitlines() == ["$ mgavatar fit --out x", "ready", "saved 1 ['fit', '--out', 'x'] False"]


def test_a_tiny_fit_from_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Merged presets on a ball, in processes of their own: figures and a sheet; nothing to do the second time."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    write_tiny_capture(tmp_path / "ball")
    save_head_model(tmp_path / "head.npz", tiny_head())
    (tmp_path / "tiny.toml").write_text(to_toml(tiny_config()))
    arguments = [
        "--presets",
        f"{tmp_path}/tiny.toml,no-offsetnet",
        "--captures",
        f"{tmp_path}/ball:{tmp_path}/head.npz",
    ]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 0
    (row,) = json.loads((tmp_path / "out/table.json").read_text())["rows"]
    assert row["failure"] is None
    assert row["iterations"] == {"geometry": 12, "appearance": 12}
    assert row["seconds"] > 0
    assert 100 < row["peak_mib"] < 4000
    assert row["val"]["psnr"] > 5
    assert row["geometry"] is None
    cell = tmp_path / "out/ball/tiny+no-offsetnet/seed0"
    assert "enabled = false" in (cell / "run/config.toml").read_text().partition("[appearance.offset_net]")[2]
    with Image.open(tmp_path / "out/sheet.png") as sheet:
        assert sheet.size[0] == 110 + 2 * (6 + 40)
    monkeypatch.setattr(ablate, "run_command", None)
    (tmp_path / "out/sheet.png").unlink()
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/sheet.png").is_file()


def test_the_sheet_shows_truth_and_avatars(tmp_path: Path) -> None:
    """Each capture's rows: held-out frames, then normals; a column is the same avatar all the way down."""
    avatar, subject = tiny_avatar(tmp_path)
    avatar.save(tmp_path / "a.pt")
    avatar.vertex_gaussians.colors.copy_(torch.zeros_like(avatar.vertex_gaussians.colors))
    avatar.save(tmp_path / "b.pt")
    one = contact_sheet({subject.root: [("a", tmp_path / "a.pt")]})
    two = contact_sheet({subject.root: [("a", tmp_path / "a.pt"), ("b", tmp_path / "b.pt")]})
    width, height = 24, 32  # of the capture's images
    assert two.shape == (one.shape[0], one.shape[1] + width + 6, 3)
    assert np.array_equal(two[25:, : one.shape[1]], one[25:])
    starts = [two.shape[1] - (width + 6) * (2 - i) + 6 for i in range(2)]
    rows = [two.shape[0] - 6 - (height + 6) * (i + 1) + 6 for i in range(5)]
    columns = [[two[top : top + height, left : left + width] for top in rows] for left in starts]
    assert np.array_equal(columns[0][0], columns[1][0])  # the mesh is the same
    assert all(not np.array_equal(a, b) for a, b in zip(columns[0][1:], columns[1][1:], strict=True))
    other = tiny_avatar(tmp_path / "other", size=(48, 32))[1]
    both = contact_sheet({subject.root: [("a", tmp_path / "a.pt")], other.root: [("b", tmp_path / "b.pt")]})
    assert len(both) > 2 * 5 * (height + 6)
    assert both.shape[1] == one.shape[1] + 2 * (48 - width)
    assert np.array_equal(both[: len(one), : one.shape[1]], one)
