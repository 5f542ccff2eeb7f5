"""The table and the picture of ``mgavatar bench trade``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from mgavatar.benchmarks.trade_work import Row

_SIZE = (1500, 760)
_LEFT, _RIGHT, _TOP, _BOTTOM = 92, 30, 56, 66
_TEXT, _SMALL, _MARK, _LEVEL = 19, 16, 8, 15
_INK, _GRID, _PAPER = "#202428", "#dfe3e8", "#ffffff"
_COLORS = {
    "raster.accuracy": "#111111",
    "alpha threshold": "#d1495b",
    "stop": "#00798c",
    "low-pass": "#8f6fc4",
    "extent": "#c77800",
    "exp": "#3d8b37",
    "storage": "#4361c4",
    "image scale": "#a04d9a",
}
"""Knobs of the rasterizer; the others change the objective or the colour model and have no place beside an image."""

_FARTHEST = 4.0
"""Slower marks stand at the right border, and say how much slower they are."""


def table(rows: Sequence[Row]) -> str:
    """Markdown; an empty cell does not apply."""
    head = ["knob", "value", "time", "x default", "PSNR to exact", "worst pixel"]
    head += ["gradient: means", "scales", "opacities", "colours", "note"]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    last = ""
    for row in rows:
        value = f"**{row.value}**" if row.default else row.value
        cells = [row.knob if row.knob != last else "", value, *_numbers(row), row.note]
        lines.append("| " + " | ".join(cells) + " |")
        last = row.knob
    return "\n".join(lines)


def _numbers(row: Row) -> list[str]:
    g = row.gradient
    of_image = f"{_share(g['image'])} (of the image)" if "image" in g else ""
    return [
        "" if row.ms is None else f"{row.ms:.3g} ms" if row.ms < 1000 else f"{row.ms:.0f} ms",
        "" if row.ratio is None else f"{row.ratio:.2f}" if row.ratio < 10 else f"{row.ratio:.0f}",
        "" if row.psnr is None else f"{row.psnr:.1f} dB",
        "" if row.worst is None else f"{row.worst:.1e}",
        of_image or _share(g.get("means")),
        *(_share(g.get(name)) for name in ("scales", "opacities", "colors")),
    ]


def _share(value: float | None) -> str:
    if value is None:
        return ""
    if value < 1e-3:
        return f"{value:.1e}"
    return f"{100 * value:.0f} %" if value >= 0.1 else f"{100 * value:.2g} %"


@dataclass(frozen=True)
class _Axes:
    """Where numbers lie in a panel: x is logarithmic, y is linear in what ``scale`` makes of it."""

    x: tuple[float, float]
    y: tuple[float, float]
    top: int

    def place(self, ratio: float, height: float) -> tuple[float, float]:
        across = (math.log10(ratio) - self.x[0]) / (self.x[1] - self.x[0])
        down = (self.y[1] - height) / (self.y[1] - self.y[0])
        return (
            _LEFT + across * (_SIZE[0] - _LEFT - _RIGHT),
            self.top + _TOP + down * (_SIZE[1] - _TOP - _BOTTOM),
        )


@dataclass(frozen=True)
class _Mark:
    label: str
    knob: str
    ratio: float
    height: float


def draw_chart(rows: Sequence[Row], path: Path, *, title: str) -> None:
    """Two panels, image error and gradient error, each against time: one labelled mark a setting.

    Args:
        rows: All rows; those of the rasterizer that have a time are drawn.
        path: PNG to write.
        title: Above the first panel.
    """
    drawn = [row for row in rows if row.knob in _COLORS and row.ratio and row.psnr is not None and not _repeats(row)]
    canvas = Image.new("RGB", (_SIZE[0], 2 * _SIZE[1]), _PAPER)
    pen = ImageDraw.Draw(canvas)
    images = [_mark(row, row.psnr or 0.0) for row in drawn]
    _panel(pen, images, 0, f"{title}\nPSNR to the exact image [dB], up is better", "{:.0f}".format)
    gradients = [_mark(row, -math.log10(max(row.gradient["means"], 1e-9))) for row in drawn]
    text = "Relative error of the gradient of the means, up is better"
    _panel(pen, gradients, _SIZE[1], text, lambda y: f"1e{-round(y)}")
    canvas.quantize(64).save(path, optimize=True)


def _repeats(row: Row) -> bool:
    """The default of most knobs is one and the same run: one of them is enough."""
    return row.default and row.knob not in ("raster.accuracy", "alpha threshold", "stop", "storage")


def _mark(row: Row, height: float) -> _Mark:
    label = row.value if row.knob in ("raster.accuracy", "storage") else f"{row.knob} {row.value}"
    if row.knob == "storage" and row.default:
        label += ": rounding alone"
    ratio = row.ratio or 1.0
    if ratio > _FARTHEST:
        label += f": {ratio:.0f}x"
    return _Mark(label, row.knob, min(ratio, _FARTHEST), height)


def _panel(
    pen: ImageDraw.ImageDraw, marks: Sequence[_Mark], top: int, title: str, unit: Callable[[float], str]
) -> None:
    axes = _axes(marks, top)
    _frame(pen, axes, title, unit)
    levels = [axes.place(mark.ratio, mark.height) for mark in marks if mark.knob == "raster.accuracy"]
    pen.line(levels, fill=_COLORS["raster.accuracy"], width=2)
    taken = [_box(*axes.place(mark.ratio, mark.height), _MARK + 1) for mark in marks]
    taken += [_box(x, y, 3.0) for a, b in pairwise(levels) for x, y in _between(a, b)]
    for mark in sorted(marks, key=lambda mark: (mark.knob != "raster.accuracy", -mark.height)):
        _draw_mark(pen, mark, axes, taken)


def _axes(marks: Sequence[_Mark], top: int) -> _Axes:
    ratios = [math.log10(mark.ratio) for mark in marks]
    heights = [mark.height for mark in marks]
    room = 0.06 * (max(heights) - min(heights) + 1.0)
    across = 0.06 * (max(ratios) - min(ratios) + 0.1)
    return _Axes((min(ratios) - across, max(ratios) + across), (min(heights) - room, max(heights) + room), top)


def _frame(pen: ImageDraw.ImageDraw, axes: _Axes, title: str, unit: Callable[[float], str]) -> None:
    text, small = ImageFont.load_default(_TEXT), ImageFont.load_default(_SMALL)
    bottom, right = axes.top + _SIZE[1] - _BOTTOM, _SIZE[0] - _RIGHT
    for ratio in (0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 4):
        if axes.x[0] <= math.log10(ratio) <= axes.x[1]:
            x = axes.place(ratio, axes.y[0])[0]
            pen.line([(x, axes.top + _TOP), (x, bottom)], fill=_INK if ratio == 1 else _GRID, width=1)
            pen.text((x, bottom + 8), f"{ratio:g}x", fill=_INK, font=small, anchor="mt")
    step = next(s for s in (1, 2, 5, 10, 20, 50) if (axes.y[1] - axes.y[0]) / s <= 9)
    for k in range(math.ceil(axes.y[0] / step), math.floor(axes.y[1] / step) + 1):
        y = axes.place(1.0, k * step)[1]
        pen.line([(_LEFT, y), (right, y)], fill=_GRID, width=1)
        pen.text((_LEFT - 10, y), unit(k * step), fill=_INK, font=small, anchor="rm")
    pen.rectangle([(_LEFT, axes.top + _TOP), (right, bottom)], outline=_INK)
    pen.text((_LEFT, axes.top + 6), title, fill=_INK, font=text)
    below = "time of projection, blending and their adjoints, relative to the default"
    pen.text(((_LEFT + right) / 2, bottom + 36), below, fill=_INK, font=text, anchor="mt")


def _box(x: float, y: float, half: float) -> tuple[float, float, float, float]:
    return x - half, y - half, x + half, y + half


def _draw_mark(
    pen: ImageDraw.ImageDraw, mark: _Mark, axes: _Axes, taken: list[tuple[float, float, float, float]]
) -> None:
    """A mark and its label at the nearest free place, with a line where that is not beside it."""
    x, y = axes.place(mark.ratio, mark.height)
    level = mark.knob == "raster.accuracy"
    font = ImageFont.load_default(_TEXT if level else _SMALL)
    color = _COLORS[mark.knob]
    gap = 6 + (_LEVEL if level else _MARK)
    left, up, right, down = pen.textbbox((0, 0), mark.label, font=font, anchor="lm")
    places = [(dx, dy) for dy in _spread(18, 16) for dx in (gap, -gap - right, 70, -70 - right, 150)]
    places.sort(key=lambda place: abs(place[1]) + 0.3 * abs(place[0] + (right if place[0] < 0 else 0)))
    dx, dy = next(
        (
            (dx, dy)
            for dx, dy in places
            if _free((x + dx + left, y + dy + up, x + dx + right, y + dy + down), taken, axes)
        ),
        places[0],
    )
    taken.append((x + dx + left, y + dy + up, x + dx + right, y + dy + down))
    if abs(dy) > 10 or dx > 40 or dx < -40 - right:
        pen.line([(x, y), (x + (dx - 2 if dx > 0 else dx + right + 2), y + dy)], fill=color, width=1)
    if level:
        pen.polygon([(x, y - _LEVEL), (x + _LEVEL, y), (x, y + _LEVEL), (x - _LEVEL, y)], fill=color)
    else:
        pen.ellipse(_box(x, y, _MARK), fill=color, outline=_PAPER)
    pen.text((x + dx, y + dy), mark.label, fill=color, font=font, anchor="lm")


def _between(a: tuple[float, float], b: tuple[float, float], n: int = 60) -> list[tuple[float, float]]:
    """Points of a line that labels keep away from."""
    return [(a[0] + (b[0] - a[0]) * k / n, a[1] + (b[1] - a[1]) * k / n) for k in range(n + 1)]


def _spread(step: int, n: int) -> list[int]:
    """0, step, -step, 2 step, ..."""
    return sorted((step * k for k in range(-n, n + 1)), key=abs)


def _free(
    box: tuple[float, float, float, float], taken: Sequence[tuple[float, float, float, float]], axes: _Axes
) -> bool:
    inside = box[0] > _LEFT + 2 and box[2] < _SIZE[0] - _RIGHT - 2
    inside = inside and box[1] > axes.top + _TOP + 2 and box[3] < axes.top + _SIZE[1] - _BOTTOM - 2
    return inside and not any(
        box[0] < other[2] and other[0] < box[2] and box[1] < other[3] and other[1] < box[3] for other in taken
    )
