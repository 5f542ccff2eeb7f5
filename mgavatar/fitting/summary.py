"""The summary of a fit, ``summary.json``: time and iterations of its stages, memory, size."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from mgavatar.files import write_json


class Summary:
    """Adds up over the interruptions of a fit.

    Attributes:
        seconds: Of the fit before this process.
        peak_mib: Peak memory before this process [MiB], or None where the system does not tell.
        stages: Iterations, configured iterations and seconds of each stage so far.
    """

    def __init__(self, before: dict[str, Any] | None = None, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Start, or go on from the ``state`` in a checkpoint."""
        before = before or {"seconds": 0.0, "peak_mib": None, "stages": {}}
        self.seconds: float = before["seconds"]
        self.peak_mib: float | None = before["peak_mib"]
        self.stages: dict[str, dict[str, Any]] = {name: dict(stage) for name, stage in before["stages"].items()}
        self.clock = clock
        self.started = clock()

    def stage(self, name: str, *, iterations: int, configured: int, seconds: float) -> None:
        """Note the place of a stage.

        Args:
            name: Name of the stage.
            iterations: Iterations so far.
            configured: Iterations of its schedule.
            seconds: Time of its loop since this was last called [s].
        """
        before = self.stages.get(name, {"seconds": 0.0})["seconds"]
        self.stages[name] = {
            "iterations": iterations,
            "configured": configured,
            "seconds": round(before + seconds, 3),
        }

    def describe(self) -> str:
        """Return the iterations of each stage as text."""
        stages = self.stages.items()
        return ", ".join(f"{name} {stage['iterations']} of {stage['configured']} iterations" for name, stage in stages)

    def state(self) -> dict[str, Any]:
        """Return the part of the summary that a checkpoint keeps."""
        peaks = [peak for peak in (self.peak_mib, peak_mib()) if peak is not None]
        return {
            "seconds": round(self.seconds + self.clock() - self.started, 3),
            "peak_mib": max(peaks, default=None),
            "stages": self.stages,
        }

    def write(self, path: Path, **more: Any) -> None:
        """Write the summary as JSON, with further entries ``more``."""
        table = self.state() | more
        if torch.cuda.is_available():
            table["peak_cuda_mib"] = round(torch.cuda.max_memory_allocated() / 2**20, 1)
        write_json(path, table)


def peak_mib() -> float | None:
    """Return the most memory that this process has held [MiB], or None on Windows, where Python does not know."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)
