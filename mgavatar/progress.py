"""How a long job tells what it does: a live line on a terminal, plain lines elsewhere, ``metrics.jsonl`` always."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import IO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

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
        """Say that ``done`` of the total are done; a ``total`` takes the place of the one so far."""
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


class MetricsLog:
    """Appends one JSON object a line, flushed, so that nothing is lost when the process is."""

    def __init__(self, path: Path) -> None:
        self.file: IO[str] = path.open("a", encoding="utf-8")

    def write(self, **values: object) -> None:
        self.file.write(json.dumps(values) + "\n")
        self.file.flush()

    def close(self) -> None:
        self.file.close()
