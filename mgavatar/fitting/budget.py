"""A fit that ends on time: the step of each iteration through its stage's schedule.

A stage's schedule (rates, density control) is counted in iterations as configured. Without a budget, each iteration
moves it by one. With a budget, an iteration that takes a share of the time left moves it by the same share of the
schedule left, at the pace of the last few iterations. So the schedule ends with the time, whatever else the machine
does and however the number of Gaussians grows. ``docs/presets-and-budgets.md`` explains it.
"""

from __future__ import annotations

import math
import re
import statistics
import time
from collections import deque
from collections.abc import Callable

from mgavatar.errors import DataError

GEOMETRY_SHARE = 0.22
"""Share of the geometry stage in the time of both stages, as in the ``quick`` preset."""

RESERVE = 0.02
"""Share of the budget that is kept for writing the avatar."""

LEAST = 20
"""Least number of iterations per stage; fewer are no fit."""

SHORTEST = 10.0
"""Shortest budget [s]; less does not even read a capture."""


class TooShort(DataError):
    """The budget does not allow a fit."""


_WARM_UP = 3  # iterations before the pace is known: the first ones load or compile kernels
_WINDOW = 15  # iterations of which the pace is the median: a checkpoint among them does not count
_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def parse_budget(text: str) -> float:
    """Return the seconds of a time such as ``90s``, ``5m`` or ``1.5h``.

    Raises:
        DataError: If the text is not such a time, or too short for any fit.
    """
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)([smh])", text.strip())
    if not found:
        raise DataError(f"--budget {text}: give a time such as 90s, 5m or 1.5h")
    seconds = float(found[1]) * _UNITS[found[2]]
    if not SHORTEST <= seconds <= 1e8:
        raise DataError(f"--budget {text}: give at least {SHORTEST:.0f}s; `quick` takes about 3m")
    return seconds


def duration(seconds: float) -> str:
    """Write seconds as a time that :func:`parse_budget` reads, rounded up: 90s, 5m, 1.5h."""
    if seconds < 120.0:
        return f"{math.ceil(seconds - 1e-9)}s"
    unit, name = (60.0, "m") if seconds < 7200.0 else (3600.0, "h")
    return f"{math.ceil(10.0 * seconds / unit - 1e-9) / 10.0:g}{name}"


class Budget:
    """The time of a whole fit; it runs as soon as the object is made.

    Attributes:
        seconds: The whole time [s].
        spent: Time spent before this process, if the fit is resumed [s].
        clock: Monotonic clock [s].
    """

    def __init__(self, seconds: float, *, spent: float = 0.0, clock: Callable[[], float] = time.monotonic) -> None:
        self.seconds, self.spent, self.clock = seconds, spent, clock
        self.started = clock()

    @property
    def used(self) -> float:
        """Return the time used so far [s]."""
        return self.spent + self.clock() - self.started

    def pacer(self, iterations: int, *, share: float, must_fit: bool) -> Pacer:
        """Return the pacer of a stage that starts now.

        Args:
            iterations: Iterations of the stage's schedule.
            share: Share of the stage in the time that is left.
            must_fit: Refuse the budget if it is too short for the least number of iterations; otherwise exceed it.
        """
        left = self.seconds * (1.0 - RESERVE) - self.used
        return Pacer(self, iterations, self.clock() + share * left, share if must_fit else None)


def geometry_share(progress: float) -> float:
    """Return the share of the geometry stage in the time left, after ``progress`` (0..1) of the stage."""
    rest = GEOMETRY_SHARE * (1.0 - progress)
    return rest / (rest + 1.0 - GEOMETRY_SHARE)


class Pacer:
    """The step of each iteration of one stage, so that schedule and time end together."""

    def __init__(self, budget: Budget, iterations: int, deadline: float, share: float | None) -> None:
        self.budget, self.iterations, self.deadline, self.share = budget, iterations, deadline, share
        self.last: float | None = None
        self.seconds: deque[float] = deque(maxlen=_WINDOW)
        self.n = 0

    @property
    def calibrated(self) -> bool:
        """Return True at the first iteration with a known pace."""
        return self.n == _WARM_UP + 1

    @property
    def left(self) -> float:
        """Return the time until the stage should end [s]."""
        return self.deadline - self.budget.clock()

    def schedule_step(self, position: float) -> float:
        """Return the step of the iteration that begins now; call it once per iteration.

        Args:
            position: Place in the schedule, in configured iterations.

        Returns:
            Step through the schedule, in configured iterations.

        Raises:
            TooShort: At the first iteration with a known pace, if the budget is too short for the first stage.
        """
        now = self.budget.clock()
        if self.last is not None:
            self.seconds.append(now - self.last)
        self.last = now
        self.n += 1
        rest = self.iterations - position
        most = min(rest, self.iterations / LEAST)
        if self.n <= _WARM_UP:
            return min(1.0, most)
        each, left = statistics.median(self.seconds), self.deadline - now
        if self.calibrated and self.share is not None:
            self._check(each, left)
        # left / each iterations still fit into the time; this one moves the schedule by one part in so many of what is
        # left of it. ``most`` keeps at least LEAST iterations, even if they exceed the time.
        return most if left <= each else min(rest * each / left, most)

    def _check(self, each: float, left: float) -> None:
        if left >= (LEAST - _WARM_UP) * each:
            return
        budget = self.budget
        assert self.share is not None  # noqa: S101  for the type checker
        needed = (budget.used + LEAST * each / self.share) / (1.0 - RESERVE)
        raise TooShort(
            f"--budget {duration(budget.seconds)}: reading the capture and starting took {budget.used:.0f} s (longer "
            f"where kernels are compiled), and an iteration takes {each:.2f} s; give at least {duration(needed)}"
        )
