"""Contact sheet of ``tools/ablate.py``: held-out frames and meshes of several avatars beside the ground truth."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from mgavatar.avatar import Avatar
from mgavatar.capture.images import read_images
from mgavatar.capture.read import read_capture
from mgavatar.capture.subject import Frame, Split, Subject
from mgavatar.driving.writers import to_bytes
from mgavatar.reporting.pictures import at_most, beside, normal_picture
from mgavatar.scoring.evaluate import evaluation_pose, spread
from mgavatar.scoring.image_metrics import psnr
from mgavatar.scoring.truth import Truth

PANEL = 220
"""Largest height of a picture [px]."""

_SHOWN: dict[Split, int] = {"val": 2, "test": 2}
_MARGIN, _LINE, _CHARACTER = 110, 15, 7


def contact_sheet(captures: Mapping[Path, Sequence[tuple[str, Path]]]) -> np.ndarray:
    """Draw held-out frames of each capture and one row of surface normals: the truth, then each avatar with its PSNR.

    Args:
        captures: Titles and avatar files in the order of the columns, by the folder of their capture.

    Returns:
        Pixels [H, W, 3], uint8.
    """
    return _stacked([_block(data, avatars) for data, avatars in captures.items()])


def _block(data: Path, avatars: Sequence[tuple[str, Path]]) -> np.ndarray:
    """Draw one capture: a line of titles, then its rows."""
    loaded = Avatar.load(avatars[0][1])
    config = loaded.config
    subject = read_capture(data, background=config.background, principal_point=config.principal_point)
    frames = [(split, frame) for split, count in _SHOWN.items() for frame in spread(subject.frames[split], count)]
    side = next((frame for _, frame in frames), subject.frames["train"][0])
    targets = [read_images([frame])[0].float() / 255.0 for _, frame in frames]
    labels = [f"{split}\ncamera {f.camera_id}\ntimestep {subject.timestep_ids[f.timestep]}" for split, f in frames]
    columns = [[*map(to_bytes, targets), _true_normals(subject, side)]]
    for _, path in avatars:
        columns.append(_column(Avatar.load(path), subject, [frame for _, frame in frames], targets, side))
    rows = zip([*labels, "normals"], *columns, strict=True)
    widths = [at_most(column[0], PANEL).shape[1] for column in columns]
    titles = [f"{subject.root.name}: truth", *(title for title, _ in avatars)]
    lines = [textwrap.wrap(title, max(1, width // _CHARACTER)) for title, width in zip(titles, widths, strict=True)]
    height = _LINE * max(map(len, lines)) + 4
    head = [
        _words("", _MARGIN, height),
        *(_words("\n".join(line), w, height) for line, w in zip(lines, widths, strict=True)),
    ]
    return _stacked([beside(head), *(_row(label, panels) for label, *panels in rows)])


def _row(label: str, panels: Sequence[np.ndarray]) -> np.ndarray:
    small = [at_most(panel, PANEL) for panel in panels]
    return beside([_words(label, _MARGIN, len(small[0])), *small])


def _column(
    avatar: Avatar, subject: Subject, frames: Sequence[Frame], targets: Sequence[torch.Tensor], side: Frame
) -> list[np.ndarray]:
    """Draw the frames and the mesh of one avatar."""
    panels = []
    for frame, target in zip(frames, targets, strict=True):
        image = (
            avatar.render(evaluation_pose(avatar, subject, frame.timestep), frame.camera).image.clamp(0.0, 1.0).cpu()
        )
        panel = Image.fromarray(to_bytes(image))
        ImageDraw.Draw(panel).text((4, 3), f"{psnr(image, target):.2f} dB", fill="black", font=_font(panel.height))
        panels.append(np.asarray(panel))
    verts = avatar.verts(evaluation_pose(avatar, subject, side.timestep))
    return [*panels, normal_picture(verts, avatar.head.body.faces, side.camera)]


def _true_normals(subject: Subject, frame: Frame) -> np.ndarray:
    if subject.ground_truth is None:
        return _words("no ground\ntruth", frame.camera.width, frame.camera.height)
    truth = Truth.read(subject.ground_truth, subject)
    verts = torch.tensor(truth.vertices[subject.timestep_ids[frame.timestep]])
    return normal_picture(verts, truth.faces.int(), frame.camera)


def _words(text: str, width: int, height: int) -> np.ndarray:
    picture = Image.new("RGB", (width, height), "white")
    ImageDraw.Draw(picture).text((3, 2), text, fill="black", font=ImageFont.load_default(12))
    return np.asarray(picture)


def _font(height: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return a font that has twelve pixels after the picture is reduced."""
    return ImageFont.load_default(12 * max(1.0, height / PANEL))


def _stacked(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Stack pictures on white, with gaps."""
    width = max(part.shape[1] for part in parts)
    padded = [np.pad(p, ((0, 6), (0, width - p.shape[1]), (0, 0)), constant_values=255) for p in parts]
    return np.concatenate(padded)
