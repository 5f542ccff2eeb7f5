"""Loss curves as inline SVG: no scripts, colours from the page."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

COLORS = ("var(--c1)", "var(--c2)", "var(--c3)", "var(--c4)", "var(--c5)", "var(--c6)")
"""Custom properties that the page defines for light and dark."""

_WIDTH, _HEIGHT = 560, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 12, 30, 44
_POINTS = 160
_NOT_LOSSES = frozenset({"iteration", "stage", "gaussians", "seconds"})

Line = Mapping[str, Any]


def read_history(path: Path) -> dict[str, list[Line]]:
    """Lines of ``metrics.jsonl`` by stage, in the order of their iterations.

    A line that was cut off when a fit was killed is left out; of an iteration that was done twice, after a resume, the
    last one counts. A missing file is an empty history.
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


def loss_chart(lines: Sequence[Line], *, title: str) -> str:
    """Every positive term of a stage's loss over its iterations, on a logarithmic axis.

    Each point is the mean over a stretch of iterations, because single images differ more than the loss falls.

    Args:
        lines: History of one stage.
        title: Stands above the chart.

    Returns:
        An ``<svg>`` element, or a paragraph if there is nothing to draw.
    """
    curves = {name: curve for name in _terms(lines) if len(curve := _curve(lines, name))}
    if not curves:
        return f"<p>{escape(title)}: no losses were logged.</p>"
    last = max(float(line["iteration"]) for line in lines)
    values = np.concatenate([curve[:, 1] for curve in curves.values()])
    low, high = _decades(values)

    def place(x: float, y: float) -> tuple[float, float]:
        across = (_WIDTH - _LEFT - _RIGHT) * x / max(last, 1.0)
        down = (_HEIGHT - _TOP - _BOTTOM) * (high - math.log10(y)) / (high - low)
        return _LEFT + across, _TOP + down

    parts = [*_grid(place, last, low, high), *_axis_labels()]
    for index, (name, curve) in enumerate(curves.items()):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*row) for row in curve.tolist()))
        color = COLORS[index % len(COLORS)]
        width = 2.2 if name == "loss" else 1.4
        parts.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="{width}"/>')
    parts.append(_legend(list(curves)))
    label = escape(f"{title}: losses by iteration")
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{label}">'
        f'<text x="{_LEFT}" y="16" class="title">{escape(title)}</text>{"".join(parts)}</svg>'
    )


def _terms(lines: Sequence[Line]) -> list[str]:
    """Names of the numbers that were logged; what all stages have comes first, and so has the same colour in all."""
    names = {name for line in lines for name, value in line.items() if isinstance(value, int | float)}
    return sorted(names - _NOT_LOSSES, key=lambda name: (name != "loss", name != "image", name))


def _curve(lines: Sequence[Line], name: str) -> np.ndarray:
    """Iterations and means of a term over equal stretches, positive ones only, shape [P, 2]."""
    rows = [(float(line["iteration"]), float(line[name])) for line in lines if isinstance(line.get(name), int | float)]
    chunks = np.array_split(np.array(rows).reshape(-1, 2), max(1, min(_POINTS, max(len(rows) // 4, 20))))
    points = [chunk.mean(axis=0) for chunk in chunks if len(chunk)]
    good = [point for point in points if np.isfinite(point).all() and point[1] > 0]
    return np.array(good).reshape(-1, 2)


def _decades(values: np.ndarray) -> tuple[int, int]:
    """Whole powers of ten around the values, at most six of them: what is smaller is cut."""
    high = math.ceil(math.log10(float(values.max())) + 1e-9)
    low = math.floor(math.log10(float(values.min())))
    return max(min(low, high - 1), high - 6), high


def _grid(place: Any, last: float, low: int, high: int) -> list[str]:
    parts = []
    for power in range(low, high + 1):
        x, y = place(0.0, 10.0**power)
        parts.append(f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{_WIDTH - _RIGHT}" y2="{y:.1f}" class="grid"/>')
        parts.append(f'<text x="{x - 6:.1f}" y="{y + 4:.1f}" text-anchor="end">{10.0**power:g}</text>')
    for tick in _ticks(last):
        x, y = place(tick, 10.0**low)
        parts.append(f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x:.1f}" y2="{y + 4:.1f}" class="axis"/>')
        parts.append(f'<text x="{x:.1f}" y="{y + 17:.1f}" text-anchor="middle">{tick:,.0f}</text>')
    return parts


def _ticks(last: float) -> list[float]:
    """About five round numbers from 0 to ``last``."""
    rough = max(last, 1.0) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = max(1.0, next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough))
    return [step * index for index in range(int(last / step) + 1)]


def _axis_labels() -> list[str]:
    middle = (_TOP + _HEIGHT - _BOTTOM) / 2
    return [
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{_HEIGHT - 6}" text-anchor="middle">iteration</text>',
        f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">loss (log scale)</text>',
    ]


def _legend(names: Sequence[str]) -> str:
    parts = []
    x = _WIDTH - _RIGHT
    for index in reversed(range(len(names))):
        x -= 7 * len(names[index]) + 30
        color = COLORS[index % len(COLORS)]
        parts.append(f'<line x1="{x}" y1="12" x2="{x + 16}" y2="12" stroke="{color}" stroke-width="3"/>')
        parts.append(f'<text x="{x + 20}" y="16">{escape(names[index])}</text>')
    return "".join(parts)
