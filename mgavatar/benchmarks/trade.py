"""``mgavatar bench trade``: what every shortcut costs in accuracy and saves in time, on a fitted avatar.

One knob is changed at a time. Its time is measured with all others at the program's defaults, taking turns with the
default so that a slow moment of the machine meets both; its error with all others nearly exact, so that it is its own.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from mgavatar.avatar import Avatar
from mgavatar.benchmarks.machine import commit_of_checkout, device_name, thread_limit
from mgavatar.benchmarks.trade_chart import draw_chart, table
from mgavatar.benchmarks.trade_parts import hash_rows, ssim_rows
from mgavatar.benchmarks.trade_work import Reference, Row, measure_knob, raster_knobs, scenes_of
from mgavatar.capture.read import read_capture
from mgavatar.kernels import bridge


def bench_trade(
    avatar_path: Path,
    data: Path,
    *,
    out: Path,
    views: int = 4,
    rounds: int = 4,
    regression_steps: int = 120,
    max_image_size: int = 600,
    threads: int | None = None,
) -> str:
    """Measure every knob on training views of an avatar; write ``trade.json``, ``trade.md`` and ``trade.png``.

    On a CPU: its vector form is what most of the knobs belong to.

    Args:
        avatar_path: The avatar file.
        data: The capture that it was fitted to, for cameras, poses and images.
        out: Folder to write to, made if it is missing.
        views: Evenly spaced training views.
        rounds: Times that each view is timed with each value.
        regression_steps: Optimizer steps of the colour regression that scores the hash grid.
        max_image_size: Larger images are reduced until their longer side has this many pixels.
        threads: CPU threads of kernels and torch, all by default.

    Returns:
        The table with its heading, Markdown.

    Raises:
        DataError: If the avatar or the capture cannot be read.
        ValueError: If a number is not positive.
    """
    for name, value in (("views", views), ("rounds", rounds), ("regression_steps", regression_steps)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    n_threads = bridge.num_threads() if threads is None else threads
    avatar = Avatar.load(avatar_path)
    with thread_limit(n_threads):
        scenes = scenes_of(avatar, read_capture(data), views=views, max_image_size=max_image_size)
        reference = Reference(scenes)
        rows = [row for knob in raster_knobs() for row in measure_knob(knob, reference, rounds=rounds)]
        rows += ssim_rows(scenes[0], rounds=rounds) + hash_rows(avatar, scenes, steps=regression_steps)
        remainder = reference.remainder()
    camera = scenes[0].camera
    report: dict[str, Any] = {
        "device": device_name(torch.device("cpu")),
        "threads": n_threads,
        "commit": commit_of_checkout(),
        "date": datetime.now(UTC).date().isoformat(),
        "gaussians": avatar.n_gaussians,
        "views": len(scenes),
        "size": [camera.width, camera.height],
        "exact_remainder": remainder,
    }
    return _write(out, report, rows)


def _write(out: Path, report: dict[str, Any], rows: list[Row]) -> str:
    out.mkdir(parents=True, exist_ok=True)
    whole = report | {"rows": [asdict(row) for row in rows]}
    (out / "trade.json").write_text(json.dumps(whole, indent=2) + "\n", encoding="utf-8")
    width, height = report["size"]
    scene = f"{report['gaussians']} Gaussians, {width} x {height}, {report['views']} views"
    heading = f"{report['device']}, {report['threads']} threads; {report['date']}, commit {report['commit']}; {scene}"
    remainder = f"Without any threshold the exact image changes by {report['exact_remainder']:.1e}."
    text = f"{heading}\n\n{table(rows)}\n\n{remainder}"
    (out / "trade.md").write_text(text + "\n", encoding="utf-8")
    draw_chart(rows, out / "trade.png", title=f"The price of every shortcut: {scene}")
    return text
