"""The table and the picture of ``tools/bench_trade.py``."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from trade_raster import Row

from mgavatar.files import atomic_write
from mgavatar.reporting.markdown import markdown_table

LEVELS = "raster.accuracy"
"""Knob whose settings are joined by a line."""

COLORS = {
    LEVELS: "#111111",
    "alpha threshold": "#d1495b",
    "stop": "#00798c",
    "low-pass": "#8f6fc4",
    "extent": "#c77800",
    "exp": "#3d8b37",
    "storage": "#4361c4",
    "image scale": "#a04d9a",
}
"""Colour of each knob of the rasterizer. Knobs of the objective and of the colour model have no image error to draw."""

FARTHEST = 4.0
"""Largest ratio of times on the axis. Slower settings stand at this border; their labels give the ratio."""

_SMALLEST_ERROR = 1e-9
"""Gradient errors below this are drawn at this height: a logarithmic axis has no zero."""


def table(rows: Sequence[Row]) -> str:
    """Return all rows as a Markdown table; an empty cell does not apply."""
    header = ["knob", "value", "time", "x default", "PSNR to exact", "worst pixel"]
    header += ["gradient: means", "scales", "opacities", "colours", "note"]
    lines = []
    previous = ""
    for row in rows:
        value = f"**{row.value}**" if row.default else row.value
        lines.append([row.knob if row.knob != previous else "", value, *_numbers(row), row.note])
        previous = row.knob
    return markdown_table(header, lines)


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


def draw_chart(rows: Sequence[Row], path: Path, *, title: str) -> None:
    """Draw image error and gradient error against time, one labelled mark per setting of the rasterizer.

    Args:
        rows: All rows; those of the rasterizer that have a time are drawn.
        path: PNG to write.
        title: Heading of the picture.
    """
    drawn = [row for row in rows if row.knob in COLORS and row.ratio and row.psnr is not None and not _repeats(row)]
    figure = Figure(figsize=(11.0, 11.5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(title)
    above, below = figure.subplots(2)
    above.set_ylabel("PSNR to the exact image [dB], up is better")
    below.set_ylabel("relative error of the gradient of the means, up is better")
    below.set_xlabel("time of projection, blending and their adjoints over the default's")
    below.set_yscale("log")
    panels = {
        above: [row.psnr or 0.0 for row in drawn],
        below: [max(row.gradient["means"], _SMALLEST_ERROR) for row in drawn],
    }
    for axes, heights in panels.items():
        _draw_marks(axes, drawn, heights)
    below.invert_yaxis()
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=len(COLORS), frameon=False)
    canvas.draw()  # lays the figure out: labels are placed in pixels
    figure.set_layout_engine("none")
    for axes, heights in panels.items():
        _place_labels(axes, drawn, heights)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=figure.dpi)


def _repeats(row: Row) -> bool:
    """Return True if a mark would repeat another: the default of most knobs is one and the same run."""
    return row.default and row.knob not in (LEVELS, "alpha threshold", "stop", "storage")


def _shown_ratio(row: Row) -> float:
    return min(row.ratio or 1.0, FARTHEST)


def _label(row: Row) -> str:
    label = f"{row.value}: rounding alone" if row.knob == "storage" and row.default else row.value
    return label if (row.ratio or 0.0) <= FARTHEST else f"{label}: {row.ratio:.0f} x"


def _draw_marks(axes: Axes, rows: Sequence[Row], heights: Sequence[float]) -> None:
    ratios = [_shown_ratio(row) for row in rows]
    ticks = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0)
    axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlim(0.9 * min(ratios), 1.1 * max(ratios))
    axes.margins(y=0.08)
    axes.grid(color="#dfe3e8")
    axes.axvline(1.0, color="black", linewidth=0.8)
    for knob, color in COLORS.items():
        marks = [(ratio, height) for row, ratio, height in zip(rows, ratios, heights, strict=True) if row.knob == knob]
        form, size = ("D-", 10) if knob == LEVELS else ("o", 7)
        axes.plot(*zip(*marks, strict=True), form, color=color, label=knob, markersize=size, linewidth=1.0)


def _place_labels(axes: Axes, rows: Sequence[Row], heights: Sequence[float]) -> None:
    """Label each mark at the nearest place that covers no mark, no other label and no part of the levels' line."""
    marks = [(_shown_ratio(row), height) for row, height in zip(rows, heights, strict=True)]
    centers = axes.transData.transform(marks)
    taken = [_square(center, 7.0) for center in centers]
    for start, end in pairwise(centers[[row.knob == LEVELS for row in rows]]):
        taken += [_square(start + t * (end - start), 2.0) for t in np.linspace(0.0, 1.0, 100)]
    # Levels first: they are what people choose from, so their labels stand closest.
    for index in sorted(range(len(rows)), key=lambda index: rows[index].knob != LEVELS):
        row = rows[index]
        taken.append(_place_label(axes, _label(row), marks[index], COLORS[row.knob], taken))


def _square(center: np.ndarray, half: float) -> Bbox:
    return Bbox([center - half, center + half])


def _place_label(axes: Axes, label: str, mark: tuple[float, float], color: str, taken: Sequence[Bbox]) -> Bbox:
    """Write one label with a line to its mark and return the pixels that it covers.

    The first place is taken where every place is covered.
    """
    line = {"arrowstyle": "-", "color": color, "linewidth": 0.7, "shrinkA": 0.0, "shrinkB": 6.0}
    text = axes.annotate(
        label, mark, xytext=(0.0, 0.0), textcoords="offset pixels", color=color, va="center", arrowprops=line
    )
    at_mark = text.get_window_extent()
    beside = (11.0, -11.0 - at_mark.width, -0.5 * at_mark.width, 60.0, -60.0 - at_mark.width)
    shifts = [(dx, dy) for dx in beside for dy in np.arange(-150.0, 151.0, 5.0)]
    # Distance from the mark to the nearer end of the label. A step up or down costs more than one along the line.
    shifts.sort(key=lambda shift: max(shift[0], -shift[0] - at_mark.width, 0.0) + 1.5 * abs(shift[1]))
    boxes = [at_mark.translated(*shift) for shift in shifts]
    free = [
        index
        for index, box in enumerate(boxes)
        if not box.count_overlaps(taken) and axes.bbox.x0 < box.x0 and box.x1 < axes.bbox.x1
    ]
    chosen = free[0] if free else 0
    text.set_position(shifts[chosen])
    return boxes[chosen]
