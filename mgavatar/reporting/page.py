"""One self-contained HTML page about a fit: scores, pictures, losses, provenance."""

from __future__ import annotations

import base64
import dataclasses
import io
import logging
import platform
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from mgavatar.errors import DataError
from mgavatar.files import atomic_write, make_folder
from mgavatar.fitting.budget import duration
from mgavatar.reporting.charts import Chart, Line, loss_chart, read_history
from mgavatar.reporting.pictures import ERROR_GAIN, SIDE_DEGREES, comparison, first_timestep, mesh_comparison, strip
from mgavatar.scoring.evaluate import NO_TRUTH, spread
from mgavatar.scoring.truth import read_ground_truth

if TYPE_CHECKING:
    import jinja2

_LIBRARIES = ("torch", "warp-lang", "numpy", "scipy", "kornia", "Pillow")
_TITLES: dict[str, str] = {"val": "Novel views (val)", "test": "Self-reenactment (test)", "train": "Training views"}
_BASELINES = {"white": "white", "mean_image": "mean image", "nearest_frame": "nearest frame"}
_STEPS = {
    "start": "start, as tracked",
    "beta": "identity and poses",
    "identity_offsets": "+ identity offsets",
    "pose_offsets": "+ pose offsets",
}

log = logging.getLogger("mgavatar")


@dataclass(frozen=True)
class _Card:
    """A number in large letters and what it is."""

    value: str
    label: str


@dataclass(frozen=True)
class _Table:
    """A table of text. Its ``kind`` is ``numbers``, ``words``, or ``words facts``, where long values may be broken."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    kind: str = "numbers"


@dataclass(frozen=True, eq=False)
class _Picture:
    """A picture of the page; ``columns`` are the headings above its panels."""

    name: str
    pixels: np.ndarray
    caption: str
    columns: tuple[str, ...] = ()

    @property
    def width(self) -> int:
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        return len(self.pixels)

    def data_url(self) -> str:
        buffer = io.BytesIO()
        Image.fromarray(self.pixels).save(buffer, format="JPEG", quality=90)
        return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"


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
        avatar: The fitted avatar.
        subject: The capture. Ground truth that cannot be read costs its picture and a warning.
        metrics: Result of :func:`mgavatar.scoring.evaluate.evaluate`, or None.
        history: ``metrics.jsonl`` of the fit.
        driving: Motion for the driven frames; the capture's held-out timesteps if None.

    Returns:
        The path of the page.

    Raises:
        DataError: If an image of the capture is damaged, or the folder cannot be written to.
    """
    folder = run / "pictures"
    make_folder(folder)
    views = _view_pictures(avatar, subject)
    mesh, driven = _mesh_picture(avatar, subject), _driven_picture(avatar, subject, driving)
    for picture in (*views, mesh, driven):
        with atomic_write(folder / f"{picture.name}.png") as file:
            Image.fromarray(picture.pixels).save(file, format="PNG")
    stages = read_history(history)
    geometry = (metrics or {}).get("geometry")
    text = (
        templates()
        .get_template("page.html.j2")
        .render(
            name=subject.root.name,
            summary=_summary(avatar, subject),
            cards=_cards(avatar, metrics, stages),
            scores=None if metrics is None else _score_table(metrics),
            geometry=[] if geometry is None else _geometry_tables(geometry),
            geometry_reason=(metrics or {}).get("geometry_reason") or NO_TRUTH,
            views=views,
            mesh=mesh,
            driven=driven,
            charts=[_chart(stage, lines) for stage, lines in stages.items()],
            provenance=_provenance(avatar, subject),
            settings=_Table(["setting", "value", "default"], list(config_changes(avatar.config)), kind="words"),
        )
    )
    page = run / "report.html"
    with atomic_write(page) as file:
        file.write(text.encode())
    return page


def templates() -> jinja2.Environment:
    """Return the templates of this folder; whatever is inserted into them is escaped."""
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("mgavatar.reporting", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def _view_pictures(avatar: Avatar, subject: Subject) -> list[_Picture]:
    """Show some frames of each held-out split, or training frames where nothing is held out."""
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
        f"Surface normals at timestep {subject.timestep_ids[first_timestep(subject)]}, seen from the middle camera and "
        f"from {SIDE_DEGREES:.0f} degrees to the side. Faces that are seen from behind are dark red."
    )
    return _Picture("mesh", mesh_comparison(avatar, subject, truth), caption, columns)


def _truth_mesh(subject: Subject) -> tuple[Tensor, Tensor] | None:
    """Return vertices and faces of the truth at the first training timestep; None if there is none to be read."""
    try:
        truth = read_ground_truth(subject)
    except DataError as error:
        log.warning("the report shows no ground truth: %s", error)
        return None
    if truth is None:
        return None
    row = subject.timestep_ids[first_timestep(subject)]
    return torch.tensor(truth.vertices[row]), truth.faces


def _driven_picture(avatar: Avatar, subject: Subject, driving: Driving | None) -> _Picture:
    if driving is not None:
        return _Picture("driven", strip(avatar, subject, poses_of(avatar, driving)), f"Driven by {driving.path.name}")
    what = "held-out timesteps" if subject.frames["test"] else "timesteps"
    return _Picture("driven", strip(avatar, subject, None), f"The capture's {what}, as tracked")


def _summary(avatar: Avatar, subject: Subject) -> str:
    counts = ", ".join(f"{len(frames)} {split}" for split, frames in subject.frames.items() if frames)
    cameras = len({frame.camera_id for frames in subject.frames.values() for frame in frames})
    return (
        f"MGAvatar fit to {cameras} camera{'s' if cameras != 1 else ''} and {len(subject.params)} timesteps "
        f"({counts} images) with the head model {avatar.head_model.name}."
    )


def _cards(avatar: Avatar, metrics: dict[str, Any] | None, stages: dict[str, list[Line]]) -> list[_Card]:
    cards = []
    if metrics is not None:
        cards += [
            _Card(_number(score["psnr"], 2, " dB"), f"PSNR, {score['task'].replace('-', ' ')}")
            for score in metrics["splits"].values()
        ]
        if metrics["geometry"] is not None:
            cards.append(_Card(_number(metrics["geometry"]["mean_mm"], 2, " mm"), "from the true surface"))
    cards.append(_Card(f"{avatar.n_gaussians:,}", "Gaussians"))
    cards.append(_Card(f"{avatar.head.body.n_verts:,}", "vertices"))
    if metrics is not None:
        cards.append(_Card(_number(1e3 * metrics["seconds_per_frame"], 0, " ms"), f"per frame, on {metrics['device']}"))
    seconds = sum(float(lines[-1].get("seconds", 0.0)) for lines in stages.values() if lines)
    if seconds:
        cards.append(_Card(duration(seconds), "spent in iterations"))
    return cards


def _score_table(metrics: dict[str, Any]) -> _Table:
    rows = []
    for split, score in metrics["splits"].items():
        images = f"{score['frames']} of {score['sampled_from']}" if "sampled_from" in score else str(score["frames"])
        values = [_number(score["ssim"], 4), _number(score["lpips"], 4), _number(score["psnr"], 2)]
        baselines = [_number(score["naive"].get(name), 2) for name in _BASELINES]
        rows.append([_TITLES.get(split, split), images, *values, *baselines])
    return _Table(["", "images", "SSIM", "LPIPS", "PSNR [dB]", *_BASELINES.values()], rows)


def _geometry_tables(geometry: dict[str, Any]) -> list[_Table]:
    """Return the scores by region, then those of the scored region by parts of the fit."""
    numbers = ["mean [mm]", "median [mm]", "95th percentile [mm]", "normals [°]"]
    regions = [["scored region", *_distances(geometry)]]
    regions += [[name.replace("_", " "), *_distances(scores)] for name, scores in geometry["regions"].items()]
    steps = [[_STEPS[name], *_distances(scores), *_folds(scores)] for name, scores in geometry["steps"].items()]
    steps.append(["neutral head", "", "", "", "", *_folds(geometry)])
    folds = ["flipped faces", "crossing faces", "new crossings"]
    return [
        _Table(["true surface to mesh", *numbers], regions),
        _Table(["part of the fit", *numbers, *folds], steps),
    ]


def _distances(scores: dict[str, Any]) -> list[str]:
    millimetres = [_number(scores[name], 2) for name in ("mean_mm", "median_mm", "p95_mm")]
    return [*millimetres, _number(scores["normal_deg"], 1)]


def _folds(scores: dict[str, Any]) -> list[str]:
    pairs = scores["self_intersections"]
    return [str(scores["flipped_faces"]), str(pairs["fitted"]), str(pairs["added"])]


def _chart(stage: str, lines: list[Line]) -> Chart:
    first, last = (int(line.get("gaussians", 0)) for line in (lines[0], lines[-1]))
    return loss_chart(lines, title=stage, caption=f"{stage}, {first:,} to {last:,} Gaussians")


def _provenance(avatar: Avatar, subject: Subject) -> _Table:
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
    return _Table(["what", "value"], rows, kind="words facts")


def config_changes(config: FitConfig) -> Iterable[list[str]]:
    """Yield name, value and default of every setting that differs from its default."""
    yield from _changes(dataclasses.asdict(config), dataclasses.asdict(FitConfig()), "")


def _changes(values: dict[str, Any], defaults: dict[str, Any], prefix: str) -> Iterator[list[str]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _changes(value, defaults[name], f"{prefix}{name}.")
        elif value != defaults[name]:
            yield [prefix + name, str(value), str(defaults[name])]


def _number(value: float | None, digits: int, unit: str = "") -> str:
    return "–" if value is None else f"{value:.{digits}f}{unit}"
