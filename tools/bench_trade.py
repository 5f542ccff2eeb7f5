"""Measure what every shortcut costs in accuracy and saves in time, on a fitted avatar.

    python tools/bench_trade.py --avatar RUN --data CAPTURE [--out trade]

One knob is changed at a time. Its time is measured with all other knobs at the program's defaults, in turns with the
default, so that a slow moment of the machine slows both. Its error is measured with all other knobs nearly exact, so
that no other error is mixed in.
"""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from command_line import run
from trade_chart import draw_chart, table
from trade_objective import hash_rows, ssim_rows
from trade_raster import Reference, Row, measure_knob, raster_knobs, scenes_of

from mgavatar.avatar import Avatar
from mgavatar.benchmarks.machine import commit_of_checkout, device_name, thread_limit
from mgavatar.capture.read import read_capture
from mgavatar.errors import DataError
from mgavatar.files import make_folder, write_json, write_text
from mgavatar.kernels import bridge


def bench_trade(
    *,
    avatar: Path,
    data: Path,
    out: Path = Path("trade"),
    views: int = 4,
    rounds: int = 4,
    regression_steps: int = 120,
    max_image_size: int = 600,
    threads: int | None = None,
) -> str:
    """Measure every knob on training views of an avatar; write trade.json, trade.md and trade.png.

    The measurement runs on a CPU: most of the knobs belong to its vector form.

    Args:
        avatar: avatar.pt, or the folder of its fit.
        data: Capture that the avatar was fitted to, for cameras, poses and images.
        out: Folder to write to, made if it is missing.
        views: Number of training views, evenly spaced.
        rounds: Number of times that each view is timed with each value.
        regression_steps: Optimizer steps of the colour regression that scores the hash grid.
        max_image_size: Longer side that larger images are reduced to [px].
        threads: CPU threads of kernels and torch, all by default.

    Returns:
        The table with its heading, Markdown.

    Raises:
        DataError: If a number is not positive, or the avatar or the capture cannot be read.
    """
    counts = {"views": views, "rounds": rounds, "regression-steps": regression_steps, "max-image-size": max_image_size}
    n_threads = bridge.num_threads() if threads is None else threads
    for name, value in (counts | {"threads": n_threads}).items():
        if value < 1:
            raise DataError(f"--{name} {value}: must be at least 1")
    make_folder(out)
    loaded = Avatar.load(avatar / "avatar.pt" if avatar.is_dir() else avatar)
    with thread_limit(n_threads):
        scenes = scenes_of(loaded, read_capture(data), views=views, max_image_size=max_image_size)
        reference = Reference(scenes)
        rows = [row for knob in raster_knobs() for row in measure_knob(knob, reference, rounds=rounds)]
        rows += ssim_rows(scenes[0], rounds=rounds) + hash_rows(loaded, scenes, steps=regression_steps)
        remainder = reference.remainder()
    camera = scenes[0].camera
    report: dict[str, Any] = {
        "device": device_name(torch.device("cpu")),
        "threads": n_threads,
        "commit": commit_of_checkout(),
        "date": datetime.now(UTC).date().isoformat(),
        "gaussians": loaded.n_gaussians,
        "views": len(scenes),
        "size": [camera.width, camera.height],
        "exact_remainder": remainder,
    }
    return _write(out, report, rows)


def _write(out: Path, report: dict[str, Any], rows: list[Row]) -> str:
    write_json(out / "trade.json", report | {"rows": [asdict(row) for row in rows]})
    width, height = report["size"]
    scene = f"{report['gaussians']} Gaussians, {width} x {height}, {report['views']} views"
    heading = f"{report['device']}, {report['threads']} threads; {report['date']}, commit {report['commit']}; {scene}"
    remainder = f"Without any threshold the exact image changes by {report['exact_remainder']:.1e}."
    text = f"{heading}\n\n{table(rows)}\n\n{remainder}"
    write_text(out / "trade.md", text + "\n")
    draw_chart(rows, out / "trade.png", title=f"What each shortcut costs: {scene}")
    return text


if __name__ == "__main__":
    run(bench_trade)
