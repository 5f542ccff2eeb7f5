"""``mgavatar bench kernels``: time the kernels beside their plain forms and the lower bound of this machine.

Machines differ and drift, so everything is timed in one run. What counts are the ratios: to the plain form, and to the
floor, the time that the machine would need for the arithmetic or the bytes alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch

from mgavatar.benchmarks.kernels_work import Job, Step, blending_step, head_scene, jobs, raster_job
from mgavatar.benchmarks.machine import (
    Machine,
    calibrate,
    commit_of_checkout,
    device_name,
    median_of,
    now,
    thread_limit,
)
from mgavatar.errors import DataError
from mgavatar.files import check_writable, write_json
from mgavatar.kernels import bridge
from mgavatar.kernels.rasterize import RasterSettings
from mgavatar.reporting.markdown import markdown_table

ROUNDS, REPEATS = 3, 3
"""Each round times the kernel a few times and its plain form once, so that a slow moment slows both."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the table; times are medians [ms]."""

    name: str
    work: str
    threads: int
    forward_ms: float
    backward_ms: float
    spread: float
    """Half the interquartile range of forward + backward over its median."""
    floor_ms: float
    plain_ms: float
    """Time of the plain form, forward + backward."""

    @property
    def total_ms(self) -> float:
        """Return the time of forward + backward."""
        return self.forward_ms + self.backward_ms


def _time(step: Step, repeats: int, device: torch.device) -> list[tuple[float, float]]:
    """Return the seconds of each forward and backward pass."""
    times = []
    for _ in range(repeats):
        start = now(device)
        backward = step()
        middle = now(device)
        backward()
        times.append((middle - start, now(device) - middle))
    return times


def _row(job: Job, machine: Machine, threads: int, device: torch.device) -> Row:
    job.step()()  # compiles and warms up
    job.plain()()
    times, plain = [], []
    for _ in range(ROUNDS):
        times += _time(job.step, REPEATS, device)
        plain += _time(job.plain, 1, device)
    totals = sorted(f + b for f, b in times)
    middle = median(totals)
    quarter = len(totals) // 4
    return Row(
        name=job.name,
        work=job.work,
        threads=threads,
        forward_ms=1e3 * median(f for f, _ in times),
        backward_ms=1e3 * median(b for _, b in times),
        spread=(totals[-1 - quarter] - totals[quarter]) / (2 * middle),
        floor_ms=1e3 * job.floor(machine),
        plain_ms=1e3 * median(f + b for f, b in plain),
    )


def _exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Fit the slope of log time over log size by least squares."""
    x = [math.log(s) for s in sizes]
    y = [math.log(s) for s in seconds]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    rise = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True))
    return rise / sum((a - mean_x) ** 2 for a in x)


def _exponents(device: torch.device) -> dict[str, float]:
    """Fit the exponents with which the rasterizer's time grows with Gaussians, pixels and views."""

    def seconds(n: int, side: int, views: int = 1) -> float:
        scene = head_scene(n, (side, side), device)

        def run() -> None:
            for _ in range(views):
                scene.loss(RasterSettings()).backward()

        return median_of(run, 5, device)

    counts, sides, views = (10_000, 20_000, 40_000, 80_000), (128, 256, 512, 1024), (1, 2, 4)
    return {
        "Gaussians": _exponent(counts, [seconds(n, 512) for n in counts]),
        "pixels": _exponent([side**2 for side in sides], [seconds(20_000, side) for side in sides]),
        "views": _exponent(views, [seconds(20_000, 256, n) for n in views]),
    }


def _table(rows: Sequence[Row]) -> str:
    header = ["kernel", "work", "threads", "forward", "backward", "spread", "x floor", "plain / it"]
    cells = [
        [
            row.name,
            row.work,
            str(row.threads),
            f"{row.forward_ms:.2f} ms",
            f"{row.backward_ms:.2f} ms",
            f"{100 * row.spread:.0f} %",
            f"{row.total_ms / row.floor_ms:.1f}",
            f"{row.plain_ms / row.total_ms:.1f}",
        ]
        for row in rows
    ]
    return markdown_table(header, cells)


def _blending_share(n: int, size: tuple[int, int], device: torch.device) -> float:
    """Measure the share of blending in the rasterizer's time; the two forms take turns."""
    whole, part = raster_job("", n, size, device).step, blending_step(n, size, device)
    shares = []
    for _ in range(2 + ROUNDS * REPEATS):
        parts, wholes = _time(part, 1, device)[0], _time(whole, 1, device)[0]
        shares.append(sum(parts) / sum(wholes))
    return median(shares[2:])


def bench_kernels(
    *, threads: int | None = None, json_path: Path | None = None, device: str = "cpu", avatar: Path | None = None
) -> str:
    """Time every kernel, its plain form and the machine itself.

    Args:
        threads: CPU threads for kernels and torch; all of the machine's by default.
        json_path: File to write the rows to as JSON.
        device: ``cpu`` or ``cuda``.
        avatar: File of a fitted avatar to time beside the synthetic scenes.

    Returns:
        A Markdown table between a line about the machine and notes.

    Raises:
        DataError: If ``threads`` is not positive, ``avatar`` cannot be read, or ``json_path`` cannot be written.
    """
    where = torch.device(device)
    n = bridge.num_threads() if threads is None else threads
    if n < 1:
        raise DataError(f"--threads {n}: must be at least 1")
    if json_path is not None:
        check_writable(json_path)
    rows: list[Row] = []
    with thread_limit(n):
        machine = calibrate(where)
        rows.extend(_row(job, machine, n, where) for job in jobs(where, avatar))
        exponents = _exponents(where)
        share = _blending_share(20_000, (512, 512), where)
    name = device_name(where)
    if json_path is not None:
        report: dict[str, Any] = {
            "device": name,
            "commit": commit_of_checkout(),
            "operations_per_s": machine.operations,
            "bytes_per_s": machine.bytes,
            "exponents": exponents,
            "blending_share": share,
            "rows": [asdict(row) for row in rows],
        }
        write_json(json_path, report)
    growth = ", ".join(f"{what} {exponent:.2f}" for what, exponent in exponents.items())
    speed = f"{machine.operations / 1e9:.0f} G multiply-adds/s, {machine.bytes / 1e9:.1f} GB/s"
    notes = [f"blending is {100 * share:.0f} % of rasterize at 20K, 512 x 512", f"exponents of its time: {growth}"]
    return "\n".join([f"{name}; {speed}", "", _table(rows), "", *notes])
