"""One self-contained HTML page about a fit: scores, pictures, losses, provenance."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import platform
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from mgavatar import __version__
from mgavatar.avatar import Avatar
from mgavatar.capture.subject import Split, Subject
from mgavatar.config import FitConfig
from mgavatar.driving.motion import Driving
from mgavatar.driving.retarget import poses_of
from mgavatar.files import atomic_write
from mgavatar.reporting.charts import Line, loss_chart, read_history
from mgavatar.reporting.pictures import ERROR_GAIN, SIDE_DEGREES, comparison, first_timestep, mesh_comparison, strip
from mgavatar.scoring.evaluate import spread
from mgavatar.scoring.truth import Truth

_LIBRARIES = ("torch", "warp-lang", "numpy", "scipy", "kornia", "Pillow")
_TITLES: dict[str, str] = {"val": "Novel views (val)", "test": "Self-reenactment (test)", "train": "Training views"}
_NAIVE = {"white": "white", "mean_image": "mean image", "nearest_frame": "nearest frame"}

_STEPS = {
    "start": "start, as tracked",
    "beta": "identity and poses",
    "identity_offsets": "+ identity offsets",
    "pose_offsets": "+ pose offsets",
}

_STYLE = """
:root { color-scheme: light dark; --bg: #fafaf9; --card: #fff; --text: #1c1c1a; --quiet: #66655f; --line: #dddcd6;
  --c1: #1f4e9c; --c2: #c2581a; --c3: #2f7d46; --c4: #8a3b8f; --c5: #8a6d0f; --c6: #0f7a85; }
@media (prefers-color-scheme: dark) {
  :root { --bg: #161615; --card: #1f1f1d; --text: #e8e7e2; --quiet: #a3a199; --line: #3a3935;
    --c1: #86b0f5; --c2: #f0a06c; --c3: #7fcf97; --c4: #d79bdc; --c5: #d9bd62; --c6: #6fcbd6; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--bg); color: var(--text); font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 24px 20px 64px; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.15rem; margin: 40px 0 8px; }
p { margin: 4px 0 12px; } .quiet, figcaption { color: var(--quiet); font-size: 0.9rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(135px, 1fr)); gap: 12px; margin-top: 20px; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 12px 14px; }
.card { color: var(--quiet); font-size: 0.9rem; }
.card b { display: block; color: var(--text); white-space: nowrap; font-size: 1.35rem; line-height: 1.3;
  font-variant-numeric: tabular-nums; }
figure { margin: 0 0 18px; } figure img { display: block; max-width: 100%; height: auto; border-radius: 6px; }
figcaption { margin-top: 4px; }
.columns { display: grid; font-size: 0.9rem; color: var(--quiet); max-width: 100%; margin-bottom: 2px; }
.columns span { text-align: center; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; background: var(--card); }
th, td { border: 1px solid var(--line); padding: 5px 12px; text-align: right; }
th { font-weight: 600; } th:first-child, td:first-child { text-align: left; }
table.words td, table.words th { text-align: left; white-space: normal; overflow-wrap: anywhere; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 460px), 1fr)); gap: 16px; }
svg { width: 100%; height: auto; background: var(--card); border: 1px solid var(--line); border-radius: 8px; }
svg text { fill: var(--quiet); font: 11px system-ui, sans-serif; }
svg text.title { fill: var(--text); font-size: 13px; font-weight: 600; }
svg .grid { stroke: var(--line); } svg .axis { stroke: var(--quiet); }
""".strip()


@dataclass(frozen=True, eq=False)
class _Picture:
    """One picture of the page; ``columns`` are the headings above its panels."""

    name: str
    pixels: np.ndarray
    caption: str
    columns: tuple[str, ...] = ()


def write_report(
    run: Path,
    avatar: Avatar,
    subject: Subject,
    metrics: dict[str, Any] | None,
    *,
    history: Path,
    driving: Driving | None = None,
) -> Path:
    """Write ``RUN/report.html``, with its pictures inside, and the pictures as PNG files in ``RUN/pictures/``.

    Args:
        run: Folder of the fit; made if it is missing.
        avatar: What was fitted.
        subject: The capture.
        metrics: What :func:`mgavatar.evaluate.evaluate` returned, or None.
        history: ``metrics.jsonl`` of the fit.
        driving: Motion for the driven frames; the capture's held-out timesteps if None.

    Returns:
        The path of the page.

    Raises:
        DataError: If an image of the capture is damaged, or the folder cannot be written to.
    """
    folder = run / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    views = _view_pictures(avatar, subject)
    mesh, driven = _mesh_picture(avatar, subject), _driven_picture(avatar, subject, driving)
    for picture in (*views, mesh, driven):
        with atomic_write(folder / f"{picture.name}.png") as file:
            Image.fromarray(picture.pixels).save(file, format="PNG")
    stages = read_history(history)
    sections = [
        _header(avatar, subject, metrics, stages),
        _section("Scores", _scores(metrics)),
        _section("Capture and avatar", "".join(map(_figure, views))),
        _section("Mesh", _figure(mesh)),
        _section("Driven", _figure(driven)),
        _section("Losses", _losses(stages)),
        _section("Provenance", _provenance(avatar, subject)),
    ]
    page = run / "report.html"
    with atomic_write(page) as file:
        file.write(_page(f"MGAvatar: {subject.root.name}", sections).encode())
    return page


def _page(title: str, sections: Iterable[str]) -> str:
    body = "\n".join(sections)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>\n{_STYLE}\n</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _section(title: str, content: str) -> str:
    return f"<section>\n<h2>{html.escape(title)}</h2>\n{content}\n</section>"


def _view_pictures(avatar: Avatar, subject: Subject) -> list[_Picture]:
    """Some frames of each held-out split; training frames where nothing is held out."""
    wanted: dict[Split, int] = {"val": 2, "test": 3}
    if not any(subject.frames[split] for split in wanted):
        wanted = {"train": 3}
    columns = ("capture", "avatar", f"difference × {ERROR_GAIN}")
    pictures = []
    for split, count in wanted.items():
        for index, frame in enumerate(spread(subject.frames[split], count)):
            timestep = subject.timestep_ids[frame.timestep]
            caption = f"{_TITLES[split]}: camera {frame.camera_id}, timestep {timestep}"
            pictures.append(_Picture(f"{split}_{index}", comparison(avatar, subject, frame), caption, columns))
    return pictures


def _mesh_picture(avatar: Avatar, subject: Subject) -> _Picture:
    truth = _truth_mesh(subject)
    start = "tracked shape" if avatar.config.geometry.start_from_tracked_shape else "neutral template"
    columns = (f"before ({start})", "after", *(("truth",) if truth is not None else ()))
    caption = (
        f"Surface normals at timestep {subject.timestep_ids[first_timestep(subject)]}, from the middle camera and from "
        f"{SIDE_DEGREES:.0f} degrees to the side. Dark red: faces seen from behind."
    )
    return _Picture("mesh", mesh_comparison(avatar, subject, truth), caption, columns)


def _truth_mesh(subject: Subject) -> tuple[Tensor, Tensor] | None:
    if subject.ground_truth is None:
        return None
    truth = Truth.read(subject.ground_truth, subject)
    row = subject.timestep_ids[first_timestep(subject)]
    return torch.tensor(truth.vertices[row]), truth.faces


def _driven_picture(avatar: Avatar, subject: Subject, driving: Driving | None) -> _Picture:
    if driving is not None:
        return _Picture("driven", strip(avatar, subject, poses_of(avatar, driving)), f"Driven by {driving.path.name}")
    what = "held-out timesteps" if subject.frames["test"] else "timesteps"
    return _Picture("driven", strip(avatar, subject, None), f"The capture's {what}, as tracked")


def _figure(picture: _Picture) -> str:
    width = picture.pixels.shape[1]
    heading = ""
    if picture.columns:
        names = "".join(f"<span>{html.escape(name)}</span>" for name in picture.columns)
        columns = f"grid-template-columns: repeat({len(picture.columns)}, 1fr)"
        heading = f'<div class="columns" style="width: {width}px; {columns}">{names}</div>'
    caption = html.escape(picture.caption)
    image = f'<img src="{_embedded(picture.pixels)}" width="{width}" height="{len(picture.pixels)}" alt="{caption}">'
    return f"<figure>{heading}{image}<figcaption>{caption}</figcaption></figure>\n"


def _embedded(pixels: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=90)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _header(avatar: Avatar, subject: Subject, metrics: dict[str, Any] | None, stages: dict[str, list[Line]]) -> str:
    body = avatar.head.body
    cards = [
        (_number(score.get("psnr"), 2, " dB"), f"PSNR, {score['task'].replace('-', ' ')}")
        for score in (metrics or {}).get("splits", {}).values()
    ]
    if metrics and metrics.get("geometry"):
        cards.append((_number(metrics["geometry"]["mean_mm"], 2, " mm"), "from the true surface"))
    cards += [(f"{avatar.n_gaussians:,}", "Gaussians"), (f"{body.n_verts:,}", "vertices")]
    if metrics:
        cards.append((_number(1e3 * metrics["seconds_per_frame"], 0, " ms"), f"a frame, on {metrics['device']}"))
    seconds = sum(float(lines[-1].get("seconds", 0.0)) for lines in stages.values() if lines)
    if seconds:
        cards.append((_duration(seconds), "of iterations"))
    inner = "".join(f'<div class="card"><b>{html.escape(value)}</b>{html.escape(name)}</div>' for value, name in cards)
    summary = f'<p class="quiet">{_summary(avatar, subject)}</p>'
    return f'<h1>{html.escape(subject.root.name)}</h1>\n{summary}\n<div class="cards">{inner}</div>'


def _summary(avatar: Avatar, subject: Subject) -> str:
    counts = ", ".join(f"{len(frames)} {split}" for split, frames in subject.frames.items() if frames)
    cameras = len({frame.camera_id for frames in subject.frames.values() for frame in frames})
    return html.escape(
        f"MGAvatar fit to {cameras} camera{'s' if cameras != 1 else ''} and {len(subject.params)} timesteps "
        f"({counts} images) with the head model {avatar.head_model.name}."
    )


def _duration(seconds: float) -> str:
    return (
        f"{seconds:.0f} s"
        if seconds < 120
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.1f} h"
    )


def _scores(metrics: dict[str, Any] | None) -> str:
    if metrics is None:
        return '<p class="quiet">Not evaluated.</p>'
    head = ["", "images", "SSIM", "LPIPS", "PSNR [dB]", *_NAIVE.values()]
    rows = []
    for split, score in metrics["splits"].items():
        naive = score.get("naive", {})
        images = f"{score['frames']} of {score['sampled_from']}" if "sampled_from" in score else str(score["frames"])
        values = [_number(score.get("ssim"), 4), _number(score.get("lpips"), 4), _number(score.get("psnr"), 2)]
        rows.append([_TITLES.get(split, split), images, *values, *(_number(naive.get(name), 2) for name in _NAIVE)])
    notes = (
        '<p class="quiet">The last three columns are the PSNR of predictors that know nothing of heads: a white image, '
        "the mean training image, and the training image nearest in camera and pose. A score means something above "
        "them.</p>"
    )
    return _table(head, rows) + notes + _geometry(metrics.get("geometry"))


def _geometry(geometry: dict[str, Any] | None) -> str:
    if geometry is None:
        return '<p class="quiet">Geometry is not scored: the capture has no ground truth.</p>'
    numbers = ["mean [mm]", "median [mm]", "95th percentile [mm]", "normals [°]"]
    rows = [["scored region", *_distances(geometry)]]
    rows += [[name, *_distances(scores)] for name, scores in geometry["regions"].items()]
    steps = [[_STEPS[name], *_distances(scores), *_folds(scores)] for name, scores in geometry["steps"].items()]
    steps.append(["neutral head", "", "", "", "", *_folds(geometry)])
    folds = ["flipped faces", "faces that cross", "new crossings"]
    note = (
        '<p class="quiet">Above by region, below the scored region at each point of the construction. Faces cross in '
        "the parametric head too, at teeth and eyes; new crossings are those that it does not have. Pose offsets are "
        "counted in their worst pose.</p>"
    )
    return (
        _table(["true surface to mesh", *numbers], rows) + note + _table(["point of the fit", *numbers, *folds], steps)
    )


def _distances(scores: dict[str, Any]) -> list[str]:
    return [
        *(_number(scores[name], 2) for name in ("mean_mm", "median_mm", "p95_mm")),
        _number(scores["normal_deg"], 1),
    ]


def _folds(scores: dict[str, Any]) -> list[str]:
    pairs = scores["self_intersections"]
    return [str(scores["flipped_faces"]), str(pairs["fitted"]), str(pairs["added"])]


def _losses(stages: dict[str, list[Line]]) -> str:
    if not stages:
        return '<p class="quiet">No history was found.</p>'
    charts = []
    for stage, lines in stages.items():
        count = f", {int(lines[0].get('gaussians', 0)):,} to {int(lines[-1].get('gaussians', 0)):,} Gaussians"
        charts.append(
            f"<figure>{loss_chart(lines, title=stage)}<figcaption>{html.escape(stage + count)}</figcaption></figure>"
        )
    note = '<p class="quiet">Means over stretches of iterations; terms are weighted as in the loss.</p>'
    return f'<div class="charts">{"".join(charts)}</div>{note}'


def _provenance(avatar: Avatar, subject: Subject) -> str:
    libraries = ", ".join(f"{name} {metadata.version(name)}" for name in _LIBRARIES)
    rows = [
        ["MGAvatar", __version__],
        ["Capture", str(subject.root)],
        ["Head model", f"{avatar.head_model.name} ({avatar.head_model.expr_basis} expressions)"],
        ["Mesh", f"{avatar.head.body.n_verts:,} vertices, {len(avatar.head.body.faces):,} faces"],
        ["Gaussians", f"{avatar.n_gaussians:,}, bound to {'faces' if avatar.appearance else 'vertices'}"],
        ["Libraries", libraries],
        ["Machine", f"Python {platform.python_version()}, {platform.system()} {platform.machine()}, {avatar.device}"],
    ]
    changed = list(config_changes(avatar.config))
    settings = (
        _table(["setting", "value", "default"], changed, kind="words") if changed else "<p>All at their defaults.</p>"
    )
    return _table(["what", "value"], rows, kind="words") + "<h2>Settings that differ from the defaults</h2>" + settings


def config_changes(config: FitConfig) -> Iterable[list[str]]:
    """Name, value and default of every setting that differs from its default."""
    yield from _changes(dataclasses.asdict(config), dataclasses.asdict(FitConfig()), "")


def _changes(values: dict[str, Any], defaults: dict[str, Any], prefix: str) -> Iterable[list[str]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _changes(value, defaults[name], f"{prefix}{name}.")
        elif value != defaults[name]:
            yield [prefix + name, str(value), str(defaults[name])]


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "numbers") -> str:
    top = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    lines = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table class="{kind}"><tr>{top}</tr>{lines}</table></div>\n'


def _number(value: float | None, digits: int, unit: str = "") -> str:
    return "–" if value is None else f"{value:.{digits}f}{unit}"
