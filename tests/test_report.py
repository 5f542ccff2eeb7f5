"""The page about a fit."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tiny import tiny_config, tiny_head
from tiny_avatar import tiny_avatar

from mgavatar.appearance.model import build_appearance
from mgavatar.avatar import Avatar
from mgavatar.camera import look_at
from mgavatar.capture.images import read_images
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, GeometryConfig
from mgavatar.driving.read import read_driving
from mgavatar.driving.writers import to_bytes
from mgavatar.reporting.charts import loss_chart, read_history
from mgavatar.reporting.page import config_changes, templates, write_report
from mgavatar.reporting.pictures import ERROR_GAIN, comparison, normal_picture, start_verts, strip
from mgavatar.scoring.evaluate import evaluate_sample


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Avatar, Subject]:
    return tiny_avatar(tmp_path)


def _history(path: Path, n: int = 40) -> Path:
    lines = [
        {"stage": stage, "iteration": i, "seconds": 0.1 * i, "loss": 1.0 / i, "image": 0.9 / i, "gaussians": 42 + i}
        for stage in ("geometry", "appearance")
        for i in range(1, n + 1)
    ]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"stage": "appear')
    return path


def test_the_page_is_whole_and_self_contained(pair: tuple[Avatar, Subject], tmp_path: Path) -> None:
    """Every section is there; nothing is fetched and nothing runs."""
    avatar, subject = pair
    metrics = evaluate_sample(avatar, subject, avatar_path=tmp_path / "a.pt")
    page = write_report(tmp_path / "run", avatar, subject, metrics, history=_history(tmp_path / "metrics.jsonl"))
    assert page == tmp_path / "run" / "report.html"
    text = page.read_text("utf-8")
    headings = re.findall("<h2>(.*?)</h2>", text)
    assert headings == [
        "Scores", "Capture and avatar", "Mesh", "Driven", "Losses", "Provenance",
        "Settings that differ from the defaults",
    ]  # fmt: skip
    assert "http" not in text
    assert "<script" not in text
    assert all(source.startswith("data:image/") for source in re.findall(r'(?:src|href)="([^"]*)', text))
    assert text.count("<svg") == 2
    assert f"{metrics['splits']['val']['psnr']:.2f} dB" in text
    assert f"{metrics['splits']['test']['naive']['nearest_frame']:.2f}" in text
    assert "geometry.hidden" in text
    names = {path.name for path in (tmp_path / "run" / "pictures").iterdir()}
    assert {"val_0.png", "val_1.png", "test_0.png", "mesh.png", "driven.png"} <= names
    for name in names:
        with Image.open(tmp_path / "run" / "pictures" / name) as image:
            assert min(image.size) > 20


def test_a_page_without_scores_history_or_held_out_frames(tmp_path: Path) -> None:
    """The page states what is missing."""
    avatar, subject = tiny_avatar(tmp_path, n_cameras=1, n_timesteps=2)
    bare = replace(subject, frames={**subject.frames, "test": ()})
    text = write_report(tmp_path / "run", avatar, bare, None, history=tmp_path / "gone.jsonl").read_text("utf-8")
    assert "Not evaluated." in text
    assert "No history was found." in text
    assert "Training views: camera 0" in text


def test_names_from_outside_are_text(pair: tuple[Avatar, Subject], tmp_path: Path) -> None:
    """A folder, a stage or a loss that is called like HTML appears as it is called, in text and in attributes."""
    avatar, subject = pair
    evil = replace(subject, root=Path("""<b>&"'"""))
    line = {"stage": """<i>&"'""", "iteration": 1, "loss": 1.0, """<u>&"'""": 2.0}
    history = tmp_path / "metrics.jsonl"
    history.write_text(json.dumps(line) + "\n", "utf-8")
    metrics = evaluate_sample(avatar, evil, avatar_path=tmp_path / "a.pt")
    metrics["geometry_reason"] = """<s>&"'"""
    text = write_report(tmp_path / "run", avatar, evil, metrics, history=history).read_text("utf-8")
    page = _Page()
    page.feed(text)
    assert not {"i", "u", "s"} & page.tags
    assert text.count("<b>") == text.count('<div class="card"><b>')
    assert """<b>&"'""" in page.texts
    assert """<i>&"'""" in page.texts
    assert """<u>&"'""" in page.texts
    assert """Geometry is not scored: <s>&"'.""" in page.texts
    assert """<i>&"': losses by iteration""" in page.attributes


class _Page(HTMLParser):
    """A page as a browser reads it: names of its tags, texts, values of attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.texts: list[str] = []
        self.attributes: list[str | None] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes += [value for _, value in attrs]

    def handle_data(self, data: str) -> None:
        self.texts.append(data.strip())


def test_geometry_and_truth_appear_where_they_are_known(pair: tuple[Avatar, Subject], tmp_path: Path) -> None:
    avatar, subject = pair
    verts = np.stack([avatar.verts(avatar.head.pose(t)).numpy() for t in range(len(subject.params))])
    path = tmp_path / "truth.npz"
    halves = {"mask_left": verts[0, :, 0] > 0, "mask_right": verts[0, :, 0] <= 0}
    np.savez(path, vertices=verts, faces=avatar.head.body.faces.numpy(), **halves)
    known = replace(subject, ground_truth=path)
    metrics = evaluate_sample(avatar, known, avatar_path=tmp_path / "a.pt")
    text = write_report(tmp_path / "run", avatar, known, metrics, history=tmp_path / "gone").read_text("utf-8")
    assert "<span>truth</span>" in text
    assert "Geometry is not scored" not in text
    for cell in ("true surface to mesh", "<td>left</td>", "<td>right</td>", "<td>+ pose offsets</td>", "new crossings"):
        assert cell in text


def test_truth_that_cannot_be_read_costs_its_picture_only(
    pair: tuple[Avatar, Subject], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A file that was damaged while the fit ran: the score and the page are there, and both say what is missing."""
    avatar, subject = pair
    path = tmp_path / "truth.npz"
    path.write_bytes(b"cut off")
    damaged = replace(subject, ground_truth=path)
    metrics = evaluate_sample(avatar, damaged, avatar_path=tmp_path / "a.pt")
    text = write_report(tmp_path / "run", avatar, damaged, metrics, history=tmp_path / "gone").read_text("utf-8")
    assert metrics["splits"]["val"]["psnr"] > 0
    assert f"Geometry is not scored: {path}: not a readable .npz file" in text
    assert "<span>truth</span>" not in text
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert [warning.partition(":")[0] for warning in warnings if str(path) in warning] == [
        "geometry is not scored",
        "the report shows no ground truth",
    ]


def test_comparison_shows_capture_avatar_and_amplified_error(pair: tuple[Avatar, Subject]) -> None:
    avatar, subject = pair
    frame = subject.frames["val"][0]
    row = comparison(avatar, subject, frame).astype(int)
    width = frame.camera.width
    target, image, error = (row[:, start : start + width] for start in (0, width + 6, 2 * (width + 6)))
    assert np.array_equal(target, read_images([frame])[0].permute(1, 2, 0).numpy())
    drawn = avatar.render(avatar.head.pose(frame.timestep), frame.camera).image
    assert np.array_equal(image, to_bytes(drawn))
    assert np.abs(error - np.minimum(ERROR_GAIN * np.abs(image - target), 255)).max() <= ERROR_GAIN


def test_normals_as_colours() -> None:
    """A square that faces the camera is blue in the middle of the red and green scales; its back is marked."""
    verts = torch.tensor([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
    front = look_at(np.array([0.0, 0.0, 4.0]), np.zeros(3), focal=10.0, width=11, height=11)
    back = look_at(np.array([0.0, 0.0, -4.0]), np.zeros(3), focal=10.0, width=11, height=11)
    assert np.abs(normal_picture(verts, faces, front)[5, 5].astype(int) - [128, 128, 255]).max() <= 1
    assert np.abs(normal_picture(verts, faces, back)[5, 5].astype(int) - [82, 26, 26]).max() <= 1
    assert normal_picture(verts, faces, front)[0, 0].tolist() == [255, 255, 255]
    right = look_at(np.array([-4.0, 0.0, 4.0]), np.zeros(3), focal=10.0, width=11, height=11)
    red, green, blue = normal_picture(verts, faces, right)[5, 5].astype(int)
    half = round(255 * (0.5 + 0.5 * 0.5**0.5))
    assert np.abs([red - half, green - 128, blue - half]).max() <= 1


def test_before_is_the_tracked_or_the_neutral_head(pair: tuple[Avatar, Subject]) -> None:
    """The start does not know what the fit has learned."""
    avatar, subject = pair
    tracked = start_verts(avatar, subject, 0)
    avatar.head.betas += 1.0
    assert torch.equal(start_verts(avatar, subject, 0), tracked)
    neutral = replace(avatar.config, geometry=replace(avatar.config.geometry, start_from_tracked_shape=False))
    avatar.config = neutral
    assert (start_verts(avatar, subject, 0) - tracked).abs().max() > 1e-4


def test_strip_of_few_and_of_many_poses(pair: tuple[Avatar, Subject]) -> None:
    """Eight pictures, or fewer where the capture has few timesteps seen from several sides."""
    avatar, subject = pair
    pose = avatar.head.pose(0)
    assert strip(avatar, subject, [pose] * 20).shape == (32, 8 * 24 + 7 * 6, 3)
    assert strip(avatar, subject, [pose] * 3).shape == (32, 6 * 24 + 5 * 6, 3)


def test_a_driven_page_with_an_appearance(tmp_path: Path) -> None:
    """Face-bound Gaussians with both networks go the same way as vertex-bound ones."""
    avatar, subject = tiny_avatar(tmp_path, model=tiny_head(), n_shape=4, n_expr=3)
    config = replace(tiny_config(), geometry=avatar.config.geometry)
    full = Avatar(avatar.vertex_gaussians, build_appearance(avatar.head, config, seed=0), avatar.capture, config)
    np.savez(tmp_path / "motion.npz", jaw_pose=np.full((3, 3), 0.1))
    driving = read_driving(tmp_path / "motion.npz")
    page = write_report(tmp_path / "run", full, subject, None, history=tmp_path / "gone", driving=driving)
    text = page.read_text("utf-8")
    assert "Driven by motion.npz" in text
    assert "80, bound to faces" in text
    with Image.open(tmp_path / "run" / "pictures" / "driven.png") as image:
        assert np.asarray(image).std() > 1.0


def test_config_changes_are_named_with_their_defaults() -> None:
    config = FitConfig(log_every=7, geometry=GeometryConfig(hidden=9))
    assert list(config_changes(config)) == [["log_every", "7", "20"], ["geometry.hidden", "9", "128"]]


def test_history_survives_a_killed_and_resumed_fit(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    rows: list[dict[str, Any]] = [{"stage": "geometry", "iteration": i, "loss": 1.0} for i in (20, 40, 60)]
    again = [{"stage": "geometry", "iteration": 40, "loss": 0.5}]
    lines = [json.dumps(row) for row in rows] + ['{"stage": "geo', "[]", "{}"] + [json.dumps(row) for row in again]
    path.write_text("\n".join(lines))
    history = read_history(path)
    assert [(line["iteration"], line["loss"]) for line in history["geometry"]] == [(20, 1.0), (40, 0.5), (60, 1.0)]
    assert read_history(tmp_path / "gone.jsonl") == {}


def _drawn(lines: list[dict[str, Any]], title: str) -> str:
    return templates().get_template("chart.svg.j2").render(chart=loss_chart(lines, title=title))


def test_loss_chart_draws_each_positive_term() -> None:
    lines = [
        {"iteration": i, "loss": 10.0 ** -(i / 50), "zero": 0.0, "bad": float("nan"), "x<y": 0.1} for i in range(1, 101)
    ]
    svg = _drawn(lines, "a & b")
    assert svg.count("<polyline") == 2
    for text in ("a &amp; b", "x&lt;y", "iteration", "loss (log scale)", ">0.01<", ">100<"):
        assert text in svg
    heights = _heights(svg)
    assert heights == sorted(heights)  # a falling loss goes down
    assert min(heights) >= 30
    assert max(heights) <= 260 - 44
    assert "no losses were logged" in _drawn([{"iteration": 1}], "t")


def test_losses_of_many_decades_stay_inside_the_chart() -> None:
    """Six decades are drawn; what is smaller lies on the axis."""
    lines = [{"iteration": i, "loss": 10.0**-i} for i in range(1, 31)]
    heights = _heights(_drawn(lines, "t"))
    assert min(heights) >= 30
    assert max(heights) == 260 - 44
    assert len(set(heights)) < len(heights)


def _heights(svg: str) -> list[float]:
    """Heights of the first curve's points, downwards [px]."""
    points = re.findall(r'points="([^"]*)"', svg)[0].split()
    return [float(point.split(",")[1]) for point in points]
