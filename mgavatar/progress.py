"""Progress of long jobs: a live line on a terminal, plain lines elsewhere, and ``metrics.jsonl`` in both cases."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mgavatar.files import append_line

_PLAIN_SECONDS = 10.0


class Reporter:
    """Progress of one job of known length on stderr."""

    def __init__(self, title: str, total: int, *, done: int = 0) -> None:
        self.title, self.total, self.first = title, total, done
        self.started = self.last = time.monotonic()
        console = Console(stderr=True)
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
            TimeRemainingColumn(compact=True), TextColumn("{task.fields[note]}"),
        )  # fmt: skip
        self.live = Progress(*columns, console=console, transient=True) if console.is_terminal else None
        self.task = self.live.add_task(title, total=total, completed=done, note="") if self.live else None

    def __enter__(self) -> Reporter:
        if self.live:
            self.live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.live:
            self.live.stop()
        if kind is None:
            seconds = time.monotonic() - self.started
            print(f"{self.title}: {self.total} done in {seconds:.0f} s", file=sys.stderr, flush=True)

    def update(self, done: int, note: str = "", *, total: int | None = None) -> None:
        """Show that ``done`` of the total are done.

        Args:
            done: Number that is done.
            note: Text beside the numbers.
            total: New total, if it has changed.
        """
        self.total = self.total if total is None else total
        now = time.monotonic()
        rate = (done - self.first) / max(now - self.started, 1e-9)
        if self.live and self.task is not None:
            self.live.update(self.task, completed=done, total=self.total, note=f"{rate:.1f}/s  {note}")
        elif now - self.last >= _PLAIN_SECONDS:
            self.last = now
            left = (self.total - done) / max(rate, 1e-9)
            print(
                f"{self.title} {done}/{self.total}  {rate:.1f}/s  {note}  {left:.0f} s left",
                file=sys.stderr,
                flush=True,
            )


@dataclass(frozen=True)
class FitProgress:
    """The state of a fit after one iteration.

    Attributes:
        stage: ``"geometry"`` or ``"appearance"``.
        iteration: Iterations of this stage so far.
        total: Iterations that this stage will have, an estimate if the fit has a budget.
        terms: Weighted terms of the loss by their names, and the number of ``gaussians``.
    """

    stage: str
    iteration: int
    total: int
    terms: Mapping[str, float]


class FitReporter:
    """Report the progress of a fit on stderr, one stage after the other."""

    def __init__(self) -> None:
        self._stage: str | None = None
        self._stack = ExitStack()

    def __enter__(self) -> FitReporter:
        return self

    def __call__(self, progress: FitProgress) -> None:
        """Take the progress of an iteration."""
        if progress.stage != self._stage:
            self._stack.close()
            self._stage = progress.stage
            done = progress.iteration - 1
            self._reporter = self._stack.enter_context(Reporter(progress.stage, progress.total, done=done))
        terms = progress.terms
        note = f"loss {terms['loss']:.4f}  {int(terms['gaussians'])} Gaussians"
        self._reporter.update(progress.iteration, note, total=progress.total)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)


class MetricsLog:
    """A file of one JSON object per line, each on the disk once it is written."""

    def __init__(self, path: Path | None) -> None:
        """Append to the file, or write nothing if ``path`` is None."""
        self.path = path

    def write(self, **values: object) -> None:
        """Append one line.

        Raises:
            DataError: If the file cannot be written.
        """
        if self.path is not None:
            append_line(self.path, json.dumps(values))
