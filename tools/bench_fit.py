"""Measure which parts of an optimizer step take its time, for both stages at three sizes.

    python tools/bench_fit.py [--threads N] [--json FILE]

The steps are those of a fit to a synthetic capture. Each step is timed as it is and, in turns with that, in parts.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Literal

import torch
from command_line import run
from step_profile import APPEARANCE, GEOMETRY, Parts, Profile
from step_work import Bench, Size, refine, sizes

from mgavatar.appearance.stage import AppearanceStage
from mgavatar.benchmarks.machine import commit_of_checkout, device_name, thread_limit
from mgavatar.errors import DataError
from mgavatar.files import check_writable, write_json
from mgavatar.fitting.stage import Stage
from mgavatar.kernels import bridge
from mgavatar.reporting.markdown import markdown_table

SizeName = Literal["quick", "balanced", "paper"]


@dataclass(frozen=True, kw_only=True)
class StageProfile:
    """One stage at one size; times are medians [ms].

    Attributes:
        size: ``quick``, ``balanced`` or ``paper``.
        stage: ``geometry`` or ``appearance``.
        work: Image size and number of Gaussians.
        step_ms: One step as it is in a fit.
        parts_ms: Each part of a step. Their sum is a little more than ``step_ms``, because timing takes time too.
        refine_ms: One event of density control, divided by the number of steps between two of them.
    """

    size: str
    stage: str
    work: str
    step_ms: float
    parts_ms: dict[str, float]
    refine_ms: float = 0.0

    def share(self, part: str) -> float:
        """Return the time of a part over the sum of all parts."""
        return self.parts_ms.get(part, 0.0) / sum(self.parts_ms.values())


def _profile(bench: Bench, stage: Stage, parts: Parts, steps: int) -> tuple[float, dict[str, float]]:
    """Return the seconds of a step and of each of its parts."""
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
    """Time one event of density control, divided by the number of steps between two of them."""
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
    """Return one Markdown table per stage: one row per part, one column per size."""
    return "\n\n".join(
        _stage_table([row for row in rows if row.stage == stage]) for stage in ("geometry", "appearance")
    )


def _stage_table(rows: Sequence[StageProfile]) -> str:
    stage = rows[0].stage
    lines = [["step", *(f"{row.step_ms:.0f} ms, {1e3 / row.step_ms:.1f}/s" for row in rows)]]
    # The largest size last measured decides the order of the parts.
    parts = dict.fromkeys(part for row in reversed(rows) for part in row.parts_ms)
    lines += [[part, *(_part_cell(row, part) for row in rows)] for part in parts]
    if stage == "appearance":
        lines.append(["density events, per step", *(f"{row.refine_ms:.1f} ms" for row in rows)])
    return markdown_table([stage, *(f"{row.size}: {row.work}" for row in rows)], lines)


def _part_cell(row: StageProfile, part: str) -> str:
    return f"{row.parts_ms.get(part, 0.0):.1f} ms, {100 * row.share(part):.0f} %"


def bench_fit(
    *,
    threads: int | None = None,
    json: Path | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    names: tuple[SizeName, ...] = ("quick", "balanced", "paper"),
    steps: int = 15,
) -> str:
    """Time the parts of one optimizer step of each stage.

    Args:
        threads: CPU threads of kernels and torch, all by default.
        json: Also write the rows to this file.
        device: Where to compute.
        names: Sizes to measure.
        steps: Number of steps that each median is taken over.

    Returns:
        Tables in Markdown, with a heading line.

    Raises:
        DataError: If a number is not positive, torch cannot use the device, or ``json`` cannot be written.
    """
    n_threads = bridge.num_threads() if threads is None else threads
    for name, value in (("threads", n_threads), ("steps", steps)):
        if value < 1:
            raise DataError(f"--{name} {value}: must be at least 1")
    if device == "cuda" and not torch.cuda.is_available():
        raise DataError("--device cuda: this machine has no CUDA device that torch can use; give --device cpu")
    if json is not None:
        check_writable(json)
    where = torch.device(device)
    chosen = [size for size in sizes() if size.name in names]
    with thread_limit(n_threads):
        rows = [row for size in chosen for row in _profiles(size, where, steps)]
    name = device_name(where)
    if json is not None:
        report = {"device": name, "threads": n_threads, "commit": commit_of_checkout()}
        write_json(json, report | {"rows": [asdict(row) for row in rows]})
    return f"{name}; {n_threads} threads; medians of {steps} steps\n\n{fit_table(rows)}"


if __name__ == "__main__":
    run(bench_fit)
