"""The machine that a benchmark runs on: its name, its clock, its threads and its speed."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch

from mgavatar.kernels import bridge


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Speed of the machine, measured in the same run: multiply-adds and bytes read per second."""

    operations: float
    bytes: float


def calibrate(device: torch.device) -> Machine:
    """Measure the machine with a matrix product that stays in the caches and a sum over more than they hold."""
    n = 768 if device.type == "cpu" else 8192
    a = torch.rand(n, n, device=device)
    out = torch.empty_like(a)
    many = torch.ones(64 * 2**20 if device.type == "cpu" else 2**30, device=device)
    return Machine(
        operations=n**3 / median_of(lambda: torch.mm(a, a, out=out), 15, device),
        bytes=4.0 * many.numel() / median_of(many.sum, 7, device),
    )


def median_of(function: Callable[[], object], repeats: int, device: torch.device) -> float:
    """Return the median time of a call [s], after one that warms up."""
    function()
    times = []
    for _ in range(repeats):
        start = now(device)
        function()
        times.append(now(device) - start)
    return median(times)


def now(device: torch.device) -> float:
    """Return the clock [s] after all work on the device has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


@contextmanager
def thread_limit(n: int) -> Iterator[None]:
    """Let kernels and torch use ``n`` CPU threads inside the block."""
    before = bridge.num_threads(), torch.get_num_threads()
    bridge.set_num_threads(n)
    torch.set_num_threads(n)
    try:
        yield
    finally:
        bridge.set_num_threads(before[0])
        torch.set_num_threads(before[1])


def device_name(device: torch.device) -> str:
    """Return the model of the GPU, or of the processor with its number of cores."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [
            line.split(":", 1)[1].strip()
            for line in info.read_text("utf-8").splitlines()
            if line.startswith("model name")
        ]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores"


def commit_of_checkout() -> str | None:
    """Return the current commit if the program runs from a checkout with git."""
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(folder), "rev-parse", "--short", "HEAD"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None
