"""``mgavatar bench fit``: what the time of one optimizer step goes into, for both stages at three sizes.

The steps are those of a fit, on a synthetic capture. Each is timed as it is and, in turn with that, in parts.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch

from mgavatar.appearance.stage import AppearanceStage
from mgavatar.benchmarks.fit_parts import APPEARANCE, GEOMETRY, Parts, Profile
from mgavatar.benchmarks.fit_work import Bench, Size, refine, sizes
from mgavatar.benchmarks.machine import commit_of_checkout, device_name, thread_limit
from mgavatar.fitting.stage import Stage
from mgavatar.kernels import bridge


@dataclass(frozen=True, kw_only=True)
class StageProfile:
    """One stage at one size; times are medians [ms].

    Attributes:
        size: ``quick``, ``balanced`` or ``paper``.
        stage: ``geometry`` or ``appearance``.
        work: Image size and number of Gaussians.
        step_ms: One step, as it is in a fit.
        parts_ms: Each part of a step; their sum is a little more than a step, for they are watched.
        refine_ms: One event of density control, spread over the steps between two of them.
    """

    size: str
    stage: str
    work: str
    step_ms: float
    parts_ms: dict[str, float]
    refine_ms: float = 0.0

    def share(self, part: str) -> float:
        """Of the sum of all parts."""
        return self.parts_ms.get(part, 0.0) / sum(self.parts_ms.values())


def _profile(bench: Bench, stage: Stage, parts: Parts, steps: int) -> tuple[float, dict[str, float]]:
    """Seconds of a step, and of its parts."""
    profile = Profile(bench.device)
    whole, times = [], []
    for iteration in range(steps):
        start = profile.now()
        bench.step(stage, iteration)
        whole.append(profile.now() - start)
        with profile.wrapped(parts), profile.step():
            bench.step(stage, iteration)
        times.append(dict(profile.seconds))
    names = {name for step in times for name in step}
    return median(whole), {name: median(step.get(name, 0.0) for step in times) for name in names}


def _refine_seconds(bench: Bench, stage: AppearanceStage) -> float:
    """One event of density control, spread over the steps between two of them."""
    start = time.perf_counter()
    refine(stage)
    return (time.perf_counter() - start) / bench.config.appearance.density.every


def _profiles(size: Size, device: torch.device, steps: int) -> list[StageProfile]:
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(size, Path(folder) / "capture", device)
    pixels = f"{size.image[0]} x {size.image[1]}"
    geometry = bench.geometry()
    step, parts = _profile(bench, geometry, GEOMETRY, steps)
    work = f"{pixels}, {bench.head.body.n_verts // 1000}K vertices"
    rows = [StageProfile(size=size.name, stage="geometry", work=work, step_ms=1e3 * step, parts_ms=_ms(parts))]
    appearance = bench.appearance()
    step, parts = _profile(bench, appearance, APPEARANCE, steps)
    work = f"{pixels}, {len(appearance.appearance.gaussians) // 1000}K Gaussians"
    more = 1e3 * _refine_seconds(bench, appearance)
    rows.append(
        StageProfile(
            size=size.name, stage="appearance", work=work, step_ms=1e3 * step, parts_ms=_ms(parts), refine_ms=more
        )
    )
    return rows


def _ms(seconds: dict[str, float]) -> dict[str, float]:
    ordered = sorted(seconds, key=lambda name: -seconds[name])
    return {name: 1e3 * seconds[name] for name in ordered}


def fit_table(rows: Sequence[StageProfile]) -> str:
    """A Markdown table a stage: its parts down, the sizes across."""
    tables = []
    for stage in ("geometry", "appearance"):
        chosen = [row for row in rows if row.stage == stage]
        names = list(dict.fromkeys(name for row in reversed(chosen) for name in row.parts_ms))
        lines = [
            f"| {stage} | " + " | ".join(f"{row.size}: {row.work}" for row in chosen) + " |",
            "|---" * (len(chosen) + 1) + "|",
            "| a step | " + " | ".join(f"{row.step_ms:.0f} ms, {1e3 / row.step_ms:.1f}/s" for row in chosen) + " |",
        ]
        for name in names:
            cells = (f"{row.parts_ms.get(name, 0.0):.1f} ms, {100 * row.share(name):.0f} %" for row in chosen)
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        if stage == "appearance":
            lines.append("| density events, a step | " + " | ".join(f"{row.refine_ms:.1f} ms" for row in chosen) + " |")
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


def bench_fit(
    *,
    threads: int | None = None,
    json_path: Path | None = None,
    device: str = "cpu",
    names: Sequence[str] = ("quick", "balanced", "paper"),
    steps: int = 15,
) -> str:
    """Time the parts of one step of each stage.

    Args:
        threads: CPU threads for kernels and torch; all of the machine's by default.
        json_path: Where to write the rows as JSON.
        device: ``cpu`` or ``cuda``.
        names: Sizes to measure.
        steps: Steps that each median is of.

    Returns:
        Tables in Markdown, with a heading line.

    Raises:
        ValueError: If ``threads`` is not positive.
    """
    n = bridge.num_threads() if threads is None else threads
    with thread_limit(n):
        rows = [row for size in sizes() if size.name in names for row in _profiles(size, torch.device(device), steps)]
    name = device_name(torch.device(device))
    if json_path is not None:
        report: dict[str, Any] = {
            "device": name,
            "threads": n,
            "commit": commit_of_checkout(),
            "rows": [asdict(row) for row in rows],
        }
        json_path.write_text(json.dumps(report, indent=2) + "\n")
    return f"{name}; {n} threads; medians of {steps} steps\n\n{fit_table(rows)}"
