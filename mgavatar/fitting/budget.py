"""A fit that ends when it is told to: how far through its schedule each iteration may go.

A stage's schedule (rates, density control) is counted in iterations as configured. Without a budget each iteration
moves it by one. With one it moves by the share of what is left that an iteration takes of the time that is left, at the
pace of the last few: the schedule ends with the time, whatever other work does to the machine and however the number of
Gaussians grows. ``docs/presets-and-budgets.md`` explains it.
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
"""Of the time for both stages; what the ``quick`` preset takes."""

RESERVE = 0.02
"""Share of the budget that is kept for writing the avatar."""

LEAST = 20
"""Iterations that each stage gets, whatever happens: fewer are no fit."""

SHORTEST = 10.0
"""Seconds; less does not even read a capture."""


class TooShort(DataError):
    """The budget does not allow a fit."""


_WARM_UP = 3  # iterations before the pace is known: the first ones load or compile kernels
_WINDOW = 15  # iterations that the pace is the median of: a checkpoint or a hiccup among them does not matter
_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def parse_budget(text: str) -> float:
    """Seconds of ``90s``, ``5m`` or ``1.5h``.

    Raises:
        DataError: If it is none of these, or too short for any fit.
    """
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)([smh])", text.strip())
    if not found:
        raise DataError(f"--budget {text}: give a time such as 90s, 5m or 1.5h")
    seconds = float(found[1]) * _UNITS[found[2]]
    if not SHORTEST <= seconds <= 1e8:
        raise DataError(f"--budget {text}: give at least {SHORTEST:.0f}s; `quick` takes about 3m")
    return seconds


def duration(seconds: float) -> str:
    """A time as :func:`parse_budget` reads it, rounded up to what it shows: 90s, 5m, 1.5h."""
    if seconds < 120.0:
        return f"{math.ceil(seconds - 1e-9)}s"
    unit, name = (60.0, "m") if seconds < 7200.0 else (3600.0, "h")
    return f"{math.ceil(10.0 * seconds / unit - 1e-9) / 10.0:g}{name}"


class Budget:
    """Seconds for a whole fit, counted from when this is made.

    Attributes:
        seconds: All of them.
        spent: Of these before this process, when a fit goes on.
        clock: Seconds that only ever grow.
    """

    def __init__(self, seconds: float, *, spent: float = 0.0, clock: Callable[[], float] = time.monotonic) -> None:
        self.seconds, self.spent, self.clock = seconds, spent, clock
        self.started = clock()

    @property
    def used(self) -> float:
        """Seconds used so far."""
        return self.spent + self.clock() - self.started

    def pacer(self, iterations: int, *, share: float, must_fit: bool) -> Pacer:
        """Return the pacer of a stage that starts now.

        Args:
            iterations: Of the stage's schedule.
            share: Of the time that is left.
            must_fit: Refuse the budget if the stage cannot make its least iterations; otherwise make them anyway.
        """
        left = self.seconds * (1.0 - RESERVE) - self.used
        return Pacer(self, iterations, self.clock() + share * left, share if must_fit else None)


def geometry_share(progress: float) -> float:
    """Share of the remaining time that the geometry stage gets when it is through ``progress`` (0..1) of itself."""
    rest = GEOMETRY_SHARE * (1.0 - progress)
    return rest / (rest + 1.0 - GEOMETRY_SHARE)


class Pacer:
    """How far each iteration of one stage moves the schedule, so that both it and the time end together."""

    def __init__(self, budget: Budget, iterations: int, deadline: float, share: float | None) -> None:
        self.budget, self.iterations, self.deadline, self.share = budget, iterations, deadline, share
        self.last: float | None = None
        self.seconds: deque[float] = deque(maxlen=_WINDOW)
        self.n = 0

    @property
    def calibrated(self) -> bool:
        """Whether the last iteration was the first whose pace was known."""
        return self.n == _WARM_UP + 1

    @property
    def left(self) -> float:
        """Seconds until the stage is to end."""
        return self.deadline - self.budget.clock()

    def schedule_step(self, position: float) -> float:
        """Call it before every iteration, at ``position``: configured iterations by which it moves the schedule.

        Raises:
            TooShort: Once the pace is known, if the budget is too small for the first stage.
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
