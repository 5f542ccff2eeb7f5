"""Measurements of the rasterizer for ``tools/bench_trade.py``: each knob alone, against the exact image and gradient.

Exact is the plain form in float64 without a stop and with contributions down to an alpha of 1e-12. ``Reference``
measures that a lower threshold changes nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.camera import Camera
from mgavatar.capture.images import read_images
from mgavatar.capture.subject import Subject
from mgavatar.config import ACCURACY
from mgavatar.errors import DataError
from mgavatar.kernels import rasterize as raster
from mgavatar.kernels.rasterize import RasterSettings, Work, rasterize
from mgavatar.scoring.evaluate import evaluation_pose

GRADIENTS = ("means", "quats", "scales", "opacities", "colors")
"""Inputs that a step differentiates, in the rasterizer's order."""

EXACT = RasterSettings(alpha_threshold=1e-12, stop=0.0, form="plain")
"""Settings of the exact image; run in float64."""

NEARLY_EXACT = RasterSettings(alpha_threshold=1e-8, stop=0.0)
"""Settings whose omissions are below the rounding of single precision. Other knobs have them while one is scored."""

BALANCED = RasterSettings()
"""The program's defaults. Other knobs have them while one is timed."""

SLOW_SIZE = 64
"""Longer side of the image for values that would otherwise take minutes [px]."""

PSNR_LIMIT = 300.0
"""PSNR of equal images [dB]."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the table; a value that does not apply is None.

    Attributes:
        knob: Name of the changed knob.
        value: Its value, as the table shows it.
        default: True if this is the program's default.
        ms: Median time of a forward and a backward pass [ms].
        ratio: Median of its time over the default's in the same round.
        psnr: PSNR against the exact image [dB].
        worst: Largest error of a channel of a pixel.
        gradient: Relative L2 error of the gradient, per input.
        note: Remarks.
    """

    knob: str
    value: str
    default: bool = False
    ms: float | None = None
    ratio: float | None = None
    psnr: float | None = None
    worst: float | None = None
    gradient: dict[str, float]
    note: str = ""


@dataclass(frozen=True, eq=False)
class Scene:
    """A training view of the avatar.

    Attributes:
        gaussians: Tensors in the rasterizer's order, float32.
        camera: Camera of the view.
        target: Captured image in 0..1, shape [3, H, W].
        background: RGB in 0..1, shape [3].
    """

    gaussians: tuple[Tensor, ...]
    camera: Camera
    target: Tensor
    background: Tensor


@dataclass(frozen=True, eq=False)
class Step:
    """A forward and a backward pass of the mean squared error against the capture.

    Attributes:
        image: Drawn image, shape [3, H, W].
        gradients: Gradients in the order of ``GRADIENTS``.
        seconds: Time of both passes [s].
    """

    image: Tensor
    gradients: tuple[Tensor, ...]
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One value of one knob of the rasterizer.

    Attributes:
        knob: Name of the knob.
        value: Its value, as the table shows it.
        timed: Settings for the timing: all other knobs are balanced.
        scored: Settings for the comparison: all other knobs are nearly exact.
        dtype: Type of all arrays.
        edit: Change of the splats between projection and blending, for values that the kernels do not offer.
        image_scale: Factor on both sides of the image.
        default: True if this is the program's default.
        slow: True to run it once, on the first view reduced to ``SLOW_SIZE``.
        has_time: False if the time is meaningless, because the value is only emulated.
        note: Remark for the table.
    """

    knob: str
    value: str
    timed: RasterSettings
    scored: RasterSettings
    dtype: torch.dtype = torch.float32
    edit: Callable[[Tensor], None] | None = None
    image_scale: float = 1.0
    default: bool = False
    slow: bool = False
    has_time: bool = True
    note: str = ""


def scenes_of(avatar: Avatar, subject: Subject, *, views: int, max_image_size: int) -> list[Scene]:
    """Return evenly spaced training views, reduced until their longer side has at most ``max_image_size`` pixels.

    Raises:
        DataError: If the capture lacks training views, or images cannot be read.
    """
    train = subject.frames["train"]
    if not train:
        raise DataError(f"{subject.root}: has no training frames; give the capture that the avatar was fitted to")
    frames = [train[int(i)] for i in np.linspace(0, len(train) - 1, min(views, len(train)) + 2)[1:-1].round()]
    first = frames[0].camera
    shrink = min(1.0, max_image_size / max(first.width, first.height))
    size = (max(1, round(first.width * shrink)), max(1, round(first.height * shrink)))
    images = read_images(frames, size=size).float() / 255.0
    scenes = []
    for frame, image in zip(frames, images, strict=True):
        camera = frame.camera.scaled(*size)
        g = avatar.gaussians(evaluation_pose(avatar, subject, frame.timestep), camera)
        gaussians = tuple(getattr(g, name).detach().contiguous() for name in GRADIENTS)
        scenes.append(Scene(gaussians, camera, image, torch.tensor(subject.background)))
    return scenes


def reduced(scene: Scene, max_image_size: int) -> Scene:
    """Return a scene reduced until its longer side has at most ``max_image_size`` pixels."""
    camera = scene.camera
    shrink = min(1.0, max_image_size / max(camera.width, camera.height))
    width, height = max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink))
    target = torch.nn.functional.interpolate(scene.target[None], size=(height, width), mode="area")[0]
    return replace(scene, camera=camera.scaled(width, height), target=target)


def run_step(scene: Scene, settings: RasterSettings, setting: Setting | None = None) -> Step:
    """Draw a scene and differentiate it, with the type, splats and size of ``setting``."""
    dtype = torch.float64 if setting is None else setting.dtype
    scale = 1.0 if setting is None else setting.image_scale
    size = (max(1, round(scene.camera.width * scale)), max(1, round(scene.camera.height * scale)))
    camera = scene.camera.scaled(*size)
    target = scene.target.to(dtype)
    if target.shape[1:] != size[::-1]:
        target = torch.nn.functional.interpolate(target[None], size=size[::-1], mode="area")[0]
    leaves = [tensor.to(dtype, copy=True).requires_grad_() for tensor in scene.gaussians]
    # Cameras are rounded to float32 like the Gaussians: otherwise float64 would sort by the depths of another camera.
    viewmat, K = (torch.tensor(matrix, dtype=torch.float32).to(dtype) for matrix in (camera.viewmat, camera.K))
    background = scene.background.to(dtype)
    with _edited_splats(setting.edit if setting is not None else None):
        start = time.perf_counter()
        drawn = rasterize(*leaves, viewmat=viewmat, K=K, size=size, background=background, settings=settings)
        (drawn.image - target).square().mean().backward()
        seconds = time.perf_counter() - start
    return Step(drawn.image.detach(), tuple(_gradient(leaf) for leaf in leaves), seconds)


def _gradient(leaf: Tensor) -> Tensor:
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad


@contextmanager
def _edited_splats(edit: Callable[[Tensor], None] | None) -> Iterator[None]:
    """Apply ``edit`` to the splats between projection and blending, for values that no setting of the op offers."""
    project = raster.project

    def edited(
        settings: RasterSettings,
        size: tuple[int, int],
        tensors: tuple[Tensor, ...],
        view_ids: Tensor | None = None,
    ) -> Work:
        work = project(settings, size, tensors, view_ids)
        if edit is not None:
            edit(work.splats)
        return work

    raster.project = edited
    try:
        yield
    finally:
        raster.project = project


def psnr(image: Tensor, exact: Tensor) -> float:
    """Return the PSNR for a peak of 1 [dB], at most ``PSNR_LIMIT``."""
    error = float((image.double() - exact.double()).square().mean())
    return min(PSNR_LIMIT, -10.0 * math.log10(max(error, 1e-300)))


def _like(image: Tensor, exact: Tensor) -> Tensor:
    """Resize a reduced image to the size of the exact one."""
    if image.shape == exact.shape:
        return image
    size = tuple(exact.shape[1:])
    return torch.nn.functional.interpolate(image[None], size=size, mode="bilinear", align_corners=False)[0]


def _three_sigma(splats: Tensor) -> None:
    """Cut each ellipse at 3 sigma: column 12 is its squared reach, column 13 half its height in pixels."""
    drawn = splats[:, 6] > 0
    splats[:, 12] = torch.where(drawn, 9.0, splats[:, 12])
    splats[:, 13] = torch.where(drawn, 3.0 * splats[:, 6].rsqrt() + 0.01, splats[:, 13])


def _half_precision(splats: Tensor) -> None:
    """Round the columns that are blended, but not the bounds of an ellipse (reach, half height, radius)."""
    splats[:, :12] = splats[:, :12].half().float()


def _level(name: str, thresholds: tuple[float, float]) -> Setting:
    settings = replace(BALANCED, alpha_threshold=thresholds[0], stop=thresholds[1])
    return Setting(
        knob="raster.accuracy",
        value=name,
        timed=settings,
        scored=settings,
        default=settings == BALANCED,
        note=f"alpha {fraction(thresholds[0])}, stop {fraction(thresholds[1])}",
    )


def fraction(value: float) -> str:
    """Write a threshold as the table does: 1/255 instead of 0.00392157, 1e-4 instead of 1/10000."""
    if value <= 0.0 or value > 1.0 / 16.0:
        return f"{value:g}"
    power = round(math.log10(value))
    if abs(value / 10.0**power - 1.0) < 1e-9:
        return f"1e{power}"
    return f"1/{1.0 / value:g}"


def _changed(knob: str, value: str, **changes: Any) -> Setting:
    timed, scored = replace(BALANCED, **changes), replace(NEARLY_EXACT, **changes)
    return Setting(knob=knob, value=value, timed=timed, scored=scored, default=timed == BALANCED)


def _numbers(knob: str, name: str, values: Sequence[float]) -> list[Setting]:
    return [_changed(knob, fraction(value), **{name: value}) for value in values]


def _no_threshold() -> Setting:
    none = replace(BALANCED, alpha_threshold=0.0, stop=0.0)
    return Setting(knob="alpha threshold", value="0", timed=none, scored=none, slow=True, note="and no stop")


def _emulated(knob: str, value: str, note: str, **changes: Any) -> Setting:
    return replace(_changed(knob, value), default=False, note=note, **changes)


def raster_knobs() -> list[list[Setting]]:
    """List every knob of the rasterizer with its values; times are compared with the one default of each knob."""
    rounded = "splats rounded between projection and blending; the kernels have no such form, so no time"
    reduced_note = "image enlarged again; gradient of the reduced image's error"
    return [
        [_level(name, thresholds) for name, thresholds in ACCURACY.items()],
        [_no_threshold(), *_numbers("alpha threshold", "alpha_threshold", (1e-8, 1e-6, 1 / 1024, 1 / 255, 1 / 64))],
        _numbers("stop", "stop", (0.0, 1e-4, 1e-3, 1e-2)),
        _numbers("low-pass", "low_pass", (0.0, 0.1, 0.3)),
        [
            _changed("extent", "ellipse"),
            _emulated("extent", "3 sigma", "bounds set after the projection", edit=_three_sigma),
        ],
        [_changed("exp", "polynomial"), _changed("exp", "exact", exp="exact")],
        [
            replace(_changed("storage", "float64, plain form", form="plain"), dtype=torch.float64),
            _changed("storage", "float32, plain form", form="plain"),
            _changed("storage", "float32"),
            _emulated("storage", "float16", rounded, edit=_half_precision, has_time=False),
        ],
        [_changed("image scale", "1"), _emulated("image scale", "1/2", reduced_note, image_scale=0.5)],
    ]


class Reference:
    """Exact steps of the scenes, computed on demand and kept."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self.scenes = scenes
        self._steps: dict[tuple[int, float], Step] = {}

    def step(self, view: int, low_pass: float) -> Step:
        """Return the exact image and gradient of a view."""
        key = (view, low_pass)
        if key not in self._steps:
            self._steps[key] = run_step(self.scenes[view], replace(EXACT, low_pass=low_pass))
        return self._steps[key]

    def remainder(self, side: int = 16) -> float:
        """Measure the largest change of a pixel without any threshold.

        It is slow, so it looks at the ``side`` x ``side`` pixels in the middle of the first view.
        """
        scene = self.scenes[0]
        camera = scene.camera
        width, height = min(side, camera.width), min(side, camera.height)
        x, y = (camera.width - width) // 2, (camera.height - height) // 2
        K = camera.K - np.array([[0.0, 0.0, x], [0.0, 0.0, y], [0.0, 0.0, 0.0]])
        part = replace(
            scene,
            camera=Camera(camera.viewmat, K, width, height),
            target=scene.target[:, y : y + height, x : x + width],
        )
        without = run_step(part, replace(EXACT, alpha_threshold=0.0)).image
        return float((run_step(part, EXACT).image - without).abs().max())


def _relative(gradients: Sequence[Tensor], exact: Sequence[Tensor]) -> float:
    error = sum(float((g.double() - e).square().sum()) for g, e in zip(gradients, exact, strict=True))
    size = sum(float(e.square().sum()) for e in exact)
    return math.sqrt(error / max(size, 1e-300))


@dataclass(frozen=True)
class _Score:
    psnr: float
    worst: float
    gradient: dict[str, float]


def _score(steps: Sequence[Step], exact: Sequence[Step]) -> _Score:
    images = [_like(step.image.double(), reference.image) for step, reference in zip(steps, exact, strict=True)]
    errors = torch.cat([(image - reference.image).flatten() for image, reference in zip(images, exact, strict=True)])
    gradient = {
        name: _relative([s.gradients[i] for s in steps], [e.gradients[i] for e in exact])
        for i, name in enumerate(GRADIENTS)
    }
    return _Score(psnr(errors, torch.zeros_like(errors)), float(errors.abs().max()), gradient)


def _times(knob: Sequence[Setting], scenes: Sequence[Scene], rounds: int) -> dict[str, tuple[float, float]]:
    """Return the median time [ms] and the median ratio to the default of each value.

    The values take turns, so that a slow moment of the machine slows all of them.
    """
    quick = [setting for setting in knob if not setting.slow and setting.has_time]
    base = next(setting for setting in knob if setting.default)
    seconds: dict[str, list[float]] = {setting.value: [] for setting in quick}
    ratios: dict[str, list[float]] = {setting.value: [] for setting in quick}
    for setting in quick:
        run_step(scenes[0], setting.timed, setting)  # compiles and warms up
    for _ in range(rounds):
        for scene in scenes:
            now = {setting.value: run_step(scene, setting.timed, setting).seconds for setting in quick}
            for value, taken in now.items():
                seconds[value].append(taken)
                ratios[value].append(taken / now[base.value])
    return {value: (1e3 * median(taken), median(ratios[value])) for value, taken in seconds.items()}


def _row(
    setting: Setting, score: _Score, *, ms: float | None = None, ratio: float | None = None, note: str = ""
) -> Row:
    return Row(
        knob=setting.knob,
        value=setting.value,
        default=setting.default,
        ms=ms,
        ratio=ratio,
        psnr=score.psnr,
        worst=score.worst,
        gradient=score.gradient,
        note="; ".join(filter(None, (setting.note, note))),
    )


def _slow_row(setting: Setting, base: Setting, scene: Scene) -> Row:
    small = reduced(scene, SLOW_SIZE)
    usual = median(run_step(small, base.timed, base).seconds for _ in range(5))
    step = run_step(small, setting.timed, setting)
    score = _score([step], [run_step(small, replace(EXACT, low_pass=setting.scored.low_pass))])
    size = f"{small.camera.width} x {small.camera.height}"
    return _row(setting, score, ratio=step.seconds / usual, note=f"on one view at {size}")


def measure_knob(knob: Sequence[Setting], reference: Reference, *, rounds: int) -> list[Row]:
    """Measure one knob: times with all others balanced, errors with all others nearly exact."""
    times = _times(knob, reference.scenes, rounds)
    base = next(setting for setting in knob if setting.default)
    rows = []
    for setting in knob:
        if setting.slow:
            rows.append(_slow_row(setting, base, reference.scenes[0]))
            continue
        low_pass, usual = setting.scored.low_pass, BALANCED.low_pass
        # Each low-pass has its own exact image, which is slow: other values than the default use one view.
        views = range(len(reference.scenes) if low_pass == usual else 1)
        steps = [run_step(reference.scenes[view], setting.scored, setting) for view in views]
        score = _score(steps, [reference.step(view, low_pass) for view in views])
        note = ""
        if low_pass != usual:
            other = psnr(reference.step(0, low_pass).image, reference.step(0, usual).image)
            note = f"another image: {other:.1f} dB from that of {usual:g}"
        ms, ratio = times.get(setting.value, (None, None))
        rows.append(_row(setting, score, ms=ms, ratio=ratio, note=note))
    return rows
