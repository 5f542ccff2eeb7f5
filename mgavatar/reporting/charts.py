"""Loss curves: what ``chart.svg.j2`` draws, as numbers in the units of its drawing."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

COLORS = ("var(--c1)", "var(--c2)", "var(--c3)", "var(--c4)", "var(--c5)", "var(--c6)")
"""Custom properties that the page defines for light and dark."""

_WIDTH, _HEIGHT = 560, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, _WIDTH - 12, 30, _HEIGHT - 44
_POINTS = 160
_LETTER = 7
"""Width of a letter of the legend, roughly."""
_NOT_LOSSES = frozenset({"iteration", "stage", "gaussians", "seconds"})

Line = Mapping[str, Any]


@dataclass(frozen=True)
class Tick:
    """A labelled place on an axis."""

    at: float
    label: str


@dataclass(frozen=True)
class Curve:
    """One term of a loss: the points of a polyline, its colour, and where its name stands in the legend."""

    name: str
    points: str
    color: str
    legend_x: int


@dataclass(frozen=True)
class Chart:
    """Losses of a stage by iteration, on a logarithmic axis; without curves if nothing was logged."""

    title: str
    caption: str
    curves: tuple[Curve, ...] = ()
    x_ticks: tuple[Tick, ...] = ()
    y_ticks: tuple[Tick, ...] = ()
    width: int = _WIDTH
    height: int = _HEIGHT
    left: int = _LEFT
    right: int = _RIGHT
    top: int = _TOP
    bottom: int = _BOTTOM


def read_history(path: Path) -> dict[str, list[Line]]:
    """Read the lines of ``metrics.jsonl`` by stage, in the order of their iterations.

    A line that was cut off when a fit was killed is left out. An iteration that was done twice, because a fit was
    resumed, counts as it was done last. A missing file is an empty history.
    """
    stages: dict[str, dict[int, Line]] = {}
    if not path.is_file():
        return {}
    for text in path.read_text("utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
            stages.setdefault(str(line["stage"]), {})[int(line["iteration"])] = line
        except (ValueError, KeyError, TypeError):
            continue
    return {stage: [lines[iteration] for iteration in sorted(lines)] for stage, lines in stages.items()}


def loss_chart(lines: Sequence[Line], *, title: str, caption: str = "") -> Chart:
    """Chart every positive term of a stage's loss.

    Each point is the mean over a stretch of iterations, because single images differ more than the loss falls.

    Args:
        lines: History of one stage.
        title: Stands above the chart.
        caption: Stands below it.
    """
    terms = {name: curve for name in _terms(lines) if len(curve := _curve(lines, name))}
    if not terms:
        return Chart(title, caption)
    last = max(1.0, *(float(line["iteration"]) for line in lines))
    low, high = _decades(np.concatenate([curve[:, 1] for curve in terms.values()]))

    def across(iteration: float) -> float:
        return round(_LEFT + (_RIGHT - _LEFT) * iteration / last, 1)

    def down(loss: float) -> float:
        decades = high - math.log10(max(loss, 10.0**low))
        return round(_TOP + (_BOTTOM - _TOP) * decades / (high - low), 1)

    curves = []
    for (name, curve), color, x in zip(terms.items(), _colors(len(terms)), _legend(list(terms)), strict=True):
        points = " ".join(f"{across(iteration)},{down(loss)}" for iteration, loss in curve.tolist())
        curves.append(Curve(name, points, color, x))
    return Chart(
        title,
        caption,
        curves=tuple(curves),
        x_ticks=tuple(Tick(across(tick), f"{tick:,.0f}") for tick in _ticks(last)),
        y_ticks=tuple(Tick(down(10.0**power), f"{10.0**power:g}") for power in range(low, high + 1)),
    )


def _terms(lines: Sequence[Line]) -> list[str]:
    """Return the names of the numbers that were logged.

    Terms that all stages have come first, so they have the same colours in all charts.
    """
    names = {name for line in lines for name, value in line.items() if isinstance(value, int | float)}
    return sorted(names - _NOT_LOSSES, key=lambda name: (name != "loss", name != "image", name))


def _curve(lines: Sequence[Line], name: str) -> np.ndarray:
    """Return iterations and means of a term over equal stretches, without those that a log axis lacks; [P, 2]."""
    rows = [(float(line["iteration"]), float(line[name])) for line in lines if isinstance(line.get(name), int | float)]
    n_points = min(_POINTS, max(len(rows) // 4, 20))
    stretches = np.array_split(np.array(rows).reshape(-1, 2), n_points)
    points = [stretch.mean(axis=0) for stretch in stretches if len(stretch)]
    drawn = [point for point in points if np.isfinite(point).all() and point[1] > 0]
    return np.array(drawn).reshape(-1, 2)


def _decades(values: np.ndarray) -> tuple[int, int]:
    """Return the whole powers of ten around the values, at most six of them."""
    high = math.ceil(math.log10(float(values.max())) + 1e-9)
    low = math.floor(math.log10(float(values.min())))
    return max(min(low, high - 1), high - 6), high


def _ticks(last: float) -> list[float]:
    """Return about five round numbers from 0 to ``last``."""
    rough = last / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = max(1.0, next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough))
    return [step * index for index in range(int(last / step) + 1)]


def _colors(count: int) -> list[str]:
    return [COLORS[index % len(COLORS)] for index in range(count)]


def _legend(names: Sequence[str]) -> list[int]:
    """Return where each name begins, so that the last one ends at the right edge."""
    starts = []
    x = _RIGHT
    for name in reversed(names):
        x -= _LETTER * len(name) + 30
        starts.append(x)
    return starts[::-1]
