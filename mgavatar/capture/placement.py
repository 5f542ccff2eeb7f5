"""Checks that the tracked head stands where the images show it, before hours are spent on a fit.

Cameras in millimetres, axes of another convention or another head model pose a head without any error, but not where
the person is. A few training images tell, and trying the usual mistakes tells which one it is.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from mgavatar.capture.images import read_masks
from mgavatar.capture.subject import Frame, Subject
from mgavatar.capture.transforms import OPENGL_TO_OPENCV
from mgavatar.errors import DataError
from mgavatar.head.body import Body
from mgavatar.head.model import HeadModel
from mgavatar.head.params import pad_or_truncate

N_VIEWS = 12
"""Training images that are looked at, spread over the capture."""

N_VERTS = 1500
"""Vertices that are projected, spread over the head."""

TYPICAL_SIZE = 0.6
"""Size of a head in an image, relative to the shorter side, where no mask shows its size."""

DOT, SMALL = 0.04, 0.12
"""Sizes of a head below which a fit cannot work, and below which it is unlikely."""

LARGE, HUGE = 6.0, 30.0
"""Sizes above which a fit is unlikely, and above which it cannot work."""

SEEN_AT_ALL, SEEN_WELL = 0.02, 0.3
"""Shares of a head inside the image below which a fit cannot work, and below which it is unlikely."""

ON_MASK = 0.5
"""Share of a head's points in the image that lie on the mask; less means that they are not the same head."""

MASK_RATIO = 5.0
"""Ratio of the sizes of head and mask above which one of them is wrong; hair and shoulders make up to 2.5."""

FLAME_VERTS, TEETH_VERTS = 5023, 5143
"""Vertices of FLAME, and of FLAME with the teeth that VHAP adds."""

USUAL = 1.6
"""Factor on the score of a usual mistake: without masks, the size of a head is known no better than that."""

UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 1e-1: "decimetres", 1e3: "kilometres"}

log = logging.getLogger("mgavatar")


@dataclass(frozen=True)
class _View:
    """A training image beside the tracked head.

    Attributes:
        frame: The frame.
        verts: Vertices of the posed head in world space [m], shape [V, 3].
        translation: Translation of the timestep, part of ``verts`` [m], shape [3].
        viewmat: World to camera, OpenCV axes, shape [4, 4].
        mask: The foreground, shape [H, W], bool, or None.
    """

    frame: Frame
    verts: np.ndarray
    translation: np.ndarray
    viewmat: np.ndarray
    mask: np.ndarray | None

    @property
    def short_side(self) -> int:
        return min(self.frame.camera.width, self.frame.camera.height)

    @property
    def mask_size(self) -> float | None:
        """Return the larger extent of the mask relative to the shorter side of the image, or None."""
        if self.mask is None or not self.mask.any():
            return None
        rows, columns = (np.flatnonzero(self.mask.any(axis=axis)) for axis in (1, 0))
        return max(float(np.ptp(rows)), float(np.ptp(columns)), 1.0) / self.short_side


@dataclass(frozen=True)
class _Placement:
    """Place of a head in an image.

    Attributes:
        is_in_front: All of it is in front of the camera.
        size: Larger extent in the image relative to the shorter side; NaN behind the camera.
        seen: Share of the head inside the image.
        on_mask: Share of these that lie on the mask; NaN without a mask.
        score: From 0, out of sight, to 1, in sight and of the size that is expected.
    """

    is_in_front: bool
    size: float
    seen: float
    on_mask: float
    score: float


@dataclass(frozen=True)
class _Mistake:
    """A usual mistake in a capture, undone.

    Attributes:
        text: Clause for a message that says what to do.
        views: The views without it.
        is_usual: It is one of axes or of a unit with a name, and more likely than any odd factor.
    """

    text: str
    views: list[_View]
    is_usual: bool = True


def check_placement(subject: Subject, head: HeadModel) -> None:
    """Refuse a capture whose cameras do not see the tracked head, and warn where that is in doubt.

    Args:
        subject: The capture.
        head: Head model that is fitted.

    Raises:
        DataError: If the head is a dot, fills no part of the image, or is behind the camera, in most of the training
            images; the message has the factor or the change of axes that would put it into view, if there is one.
    """
    _warn_of_other_topology(subject, head)
    views = _views(subject, head)
    places = [_place(view) for view in views]
    count = f"of {len(views)} training images looked at, for example {views[0].frame.image_path}"
    behind = sum(not place.is_in_front for place in places)
    if 2 * behind > len(views):
        raise DataError(f"{subject.root}: the head is behind the camera in {behind} {count}; {_remedy(views, places)}")
    size = float(np.nanmedian([place.size for place in places]))
    seen = float(np.median([place.seen for place in places]))
    pixels = f"{size * views[0].short_side:.2g} px"
    if size < DOT:
        raise DataError(f"{subject.root}: the head is too small, {pixels} in {count}; {_remedy(views, places)}")
    if size > HUGE:
        raise DataError(f"{subject.root}: the head is too large, {pixels} in {count}; {_remedy(views, places)}")
    if seen < SEEN_AT_ALL:
        raise DataError(f"{subject.root}: the head is outside the image in most {count}; {_remedy(views, places)}")
    _warn_of_doubts(subject, head, views, places)


def _warn_of_doubts(subject: Subject, head: HeadModel, views: list[_View], places: list[_Placement]) -> None:
    size = float(np.nanmedian([place.size for place in places]))
    seen = float(np.median([place.seen for place in places]))
    ratios = [place.size / view.mask_size for view, place in zip(views, places, strict=True) if view.mask_size]
    ratio = float(np.nanmedian(ratios)) if ratios else 1.0
    on_masks = [place.on_mask for place in places if not math.isnan(place.on_mask)]
    on_mask = float(np.median(on_masks)) if on_masks else 1.0
    if not SMALL < size < LARGE or seen < SEEN_WELL:
        text = f"the head covers {size:.2g} of the image's shorter side, and {100 * seen:.0f} % of it is in view"
        log.warning("%s: %s; %s", subject.root, text, _remedy(views, places))
    elif not 1.0 / MASK_RATIO < ratio < MASK_RATIO:
        text = f"the head is {ratio:.2g} times as large as the masks"
        log.warning("%s: %s; %s", subject.root, text, _remedy(views, places))
    elif on_mask < ON_MASK:
        log.warning(
            "%s: only %.0f %% of the posed head (%s) lies on the masks; is it the head model that the capture was "
            "tracked with (--head-model)? If so, %s",
            subject.root,
            100.0 * on_mask,
            head.name,
            _remedy(views, places),
        )
    elif lost := [view for view, place in zip(views, places, strict=True) if place.seen < SEEN_AT_ALL]:
        log.warning(
            "%s: the head is outside the image in %d of %d training images looked at, for example %s; if tracking "
            "failed there, remove these frames",
            subject.root,
            len(lost),
            len(views),
            lost[0].frame.image_path,
        )


def _warn_of_other_topology(subject: Subject, head: HeadModel) -> None:
    """Log a warning if the tracker's vertex offsets are those of another mesh."""
    offset = subject.params.static_offset
    n_verts = len(head.v_template)
    if offset is None or len(offset) == n_verts or {len(offset), n_verts} == {FLAME_VERTS, TEETH_VERTS}:
        return
    kind = {FLAME_VERTS: "FLAME", TEETH_VERTS: "FLAME with VHAP's teeth"}.get(len(offset), "another head")
    log.warning(
        "%s: was tracked with a head model of %d vertices (its static_offset says so): %s; %s has %d and may be posed "
        "wrongly by its parameters; give --head-model with the one that it was tracked with",
        subject.root,
        len(offset),
        kind,
        head.name,
        n_verts,
    )


def _views(subject: Subject, head: HeadModel) -> list[_View]:
    """Pose the head for training images that are spread over the capture."""
    train = subject.frames["train"]
    chosen = [train[i] for i in np.unique(np.linspace(0, len(train) - 1, N_VIEWS).round().astype(int))]
    body = Body(head, subdivisions=0)
    shape = torch.from_numpy(pad_or_truncate(subject.params.shape, head.n_shape))
    neutral = body.shaped(shape)
    joints = body.joints(neutral)
    some = torch.linspace(0, len(neutral) - 1, min(N_VERTS, len(neutral))).round().long()
    views = []
    for frame in chosen:
        pose = subject.params.pose(frame.timestep, n_expr=head.n_expr)
        with torch.no_grad():
            verts = body.posed(neutral, pose, joints=joints)[some].double().numpy()
        mask = read_masks([frame])[0].numpy() > 127 if frame.mask_path is not None else None
        translation = subject.params.translation[frame.timestep].astype(np.float64)
        views.append(_View(frame, verts, translation, frame.camera.viewmat, mask))
    return views


def _place(view: _View) -> _Placement:
    camera = view.frame.camera
    points = view.verts @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    if not points[:, 2].min() > 1e-6:  # true for NaN
        return _Placement(False, math.nan, 0.0, math.nan, 0.0)
    pixels = points[:, :2] / points[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    size = float(np.ptp(pixels, axis=0).max()) / view.short_side
    inside = ((pixels >= 0.0) & (pixels < [camera.width, camera.height])).all(axis=1)
    seen = float(inside.mean())
    on_mask = math.nan
    if view.mask is not None and inside.any():
        columns, rows = pixels[inside].astype(int).T
        on_mask = float(view.mask[rows, columns].mean())
    expected = TYPICAL_SIZE if view.mask_size is None else view.mask_size
    fit = math.exp(-abs(math.log(max(size, 1e-9) / expected)))
    return _Placement(True, size, seen, on_mask, fit * seen * (1.0 if math.isnan(on_mask) else on_mask))


def _remedy(views: list[_View], places: list[_Placement]) -> str:
    """Try the usual mistakes, and return what to do about the one that explains what is seen."""
    general = (
        "transform_matrix must be camera to world in OpenGL's axes (y up, z backwards), in metres, in the world that "
        "the head's translation is in"
    )
    now = _score(places)
    scored = [(_score([_place(view) for view in mistake.views]), mistake) for mistake in _mistakes(views)]
    score, best = max(scored, key=lambda entry: entry[0] * (USUAL if entry[1].is_usual else 1.0))
    return best.text if score > max(0.2, 1.5 * now) else general


def _score(places: Sequence[_Placement]) -> float:
    return float(np.mean([place.score for place in places]))


def _mistakes(views: list[_View]) -> Iterator[_Mistake]:
    """Yield the views with each of the mistakes undone."""
    yield _Mistake(
        "transform_matrix seems to be in OpenCV's axes (y down, z forward): negate its second and third column",
        [replace(view, viewmat=OPENGL_TO_OPENCV @ view.viewmat) for view in views],
    )
    yield _Mistake(
        "transform_matrix seems to be world to camera, in OpenCV's axes: invert it, then negate its second and third "
        "column",
        [replace(view, viewmat=_file_matrix(view)) for view in views],
    )
    yield _Mistake(
        "transform_matrix seems to be world to camera: invert it",
        [replace(view, viewmat=OPENGL_TO_OPENCV @ _file_matrix(view)) for view in views],
    )
    for exponent in np.linspace(-4.0, 4.0, 81):
        yield from _scales(views, float(f"{10.0**exponent:.2g}"))


def _scales(views: list[_View], factor: float) -> Iterator[_Mistake]:
    unit = (
        f"seem to be in {UNITS[factor]}, metres are needed" if factor in UNITS else "are in other units than the head"
    )
    by, usual = f"multiply them by {factor:g}", factor in UNITS
    cameras = [replace(view, viewmat=_scaled(view.viewmat, factor)) for view in views]
    heads = [replace(view, verts=view.verts + (factor - 1.0) * view.translation) for view in views]
    yield _Mistake(f"the camera positions (fourth column of transform_matrix) {unit}: {by}", cameras, usual)
    if any(view.translation.any() for view in views):
        yield _Mistake(f"the head's translations (flame_param) {unit}: {by}", heads, usual)
        both = [replace(head, viewmat=camera.viewmat) for head, camera in zip(heads, cameras, strict=True)]
        yield _Mistake(f"the camera positions and the head's translations {unit}: {by}", both, usual)


def _scaled(viewmat: np.ndarray, factor: float) -> np.ndarray:
    """Multiply the position of a camera: its rotation stays, and so the translation scales alike."""
    scaled = viewmat.copy()
    scaled[:3, 3] *= factor
    return scaled


def _file_matrix(view: _View) -> np.ndarray:
    """Return the matrix as the transforms file has it."""
    return np.linalg.inv(view.viewmat) @ OPENGL_TO_OPENCV
