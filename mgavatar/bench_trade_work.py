"""What ``mgavatar bench trade`` measures of the rasterizer: each knob alone, against the exact image and gradient.

Exact is the plain form in float64 without a stop, and with contributions down to an alpha of 1e-12; that a lower
threshold changes nothing is measured as well.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.camera import Camera
from mgavatar.capture.images import read_images
from mgavatar.capture.subject import Subject
from mgavatar.config import ACCURACY
from mgavatar.errors import DataError
from mgavatar.evaluate import evaluation_pose
from mgavatar.kernels.rasterize import RasterSettings, Work, blend, blend_backward, project, project_backward

GRADIENTS = ("means", "quats", "scales", "opacities", "colors")
"""What a step differentiates, in the rasterizer's order."""

EXACT = RasterSettings(alpha_threshold=1e-12, stop=0.0, form="plain")
"""Run in float64."""

NEARLY_EXACT = RasterSettings(alpha_threshold=1e-8, stop=0.0)
"""In single precision: what is left out is below its rounding. The other knobs stand here while one is scored."""

BALANCED = RasterSettings()
"""The other knobs stand here while one is timed."""

PSNR_LIMIT = 300.0
"""Of equal images [dB]."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table; what does not apply is None.

    Attributes:
        knob: What was changed.
        value: To what.
        default: Whether the program does so when nobody says otherwise.
        ms: Median time of a forward and a backward pass.
        ratio: Median of its time over the default's in the same round.
        psnr: To the exact image [dB].
        worst: Largest error of a pixel's channel.
        gradient: Relative L2 error of the gradient by what it belongs to.
        note: What else one must know.
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
        gaussians: In the rasterizer's order, float32.
        camera: Where from.
        target: The captured image in 0..1, shape [3, H, W].
        background: RGB, shape [3].
    """

    gaussians: tuple[Tensor, ...]
    camera: Camera
    target: Tensor
    background: Tensor


@dataclass(frozen=True, eq=False)
class Step:
    """A forward and a backward pass of the mean squared error against the capture.

    Attributes:
        image: Shape [3, H, W].
        gradients: By ``GRADIENTS``.
        seconds: Both passes.
    """

    image: Tensor
    gradients: tuple[Tensor, ...]
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One value of one knob of the rasterizer.

    Attributes:
        knob: Name of the knob.
        value: As the table shows it.
        timed: Settings of the timing: everything else is balanced.
        scored: Settings of the comparison: everything else is nearly exact.
        dtype: Of all arrays.
        edit: Changes the splats between projection and blending, for what the kernels do not offer.
        image_scale: Of both sides of the image.
        default: Whether it is the program's.
        slow: Run once, on the first view only.
        has_time: Whether the time means anything.
        note: For the table.
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
    """Evenly spaced training views, reduced until their longer side has at most ``max_image_size`` pixels.

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


def run_step(scene: Scene, settings: RasterSettings, setting: Setting | None = None) -> Step:
    """Draw a scene and differentiate it, with what ``setting`` says about types, splats and size."""
    dtype = torch.float64 if setting is None else setting.dtype
    scale = 1.0 if setting is None else setting.image_scale
    size = (max(1, round(scene.camera.width * scale)), max(1, round(scene.camera.height * scale)))
    camera = scene.camera.scaled(*size)
    target = scene.target.to(dtype)
    if target.shape[1:] != size[::-1]:
        target = torch.nn.functional.interpolate(target[None], size=size[::-1], mode="area")[0]
    placed = (torch.tensor(camera.viewmat, dtype=dtype), torch.tensor(camera.K, dtype=dtype))
    tensors = (*(tensor.to(dtype) for tensor in (*scene.gaussians, *placed, scene.background)),)
    start = time.perf_counter()
    work = project(settings, size, tensors)
    if setting is not None and setting.edit is not None:
        setting.edit(work.splats)
    image, coverage, depth, final_T, last = blend(settings, work, tensors[-1])
    v_image = (image - target) * (2.0 / image.numel())
    planes = [v_image, torch.zeros_like(coverage), torch.zeros_like(depth)]
    partials = blend_backward(settings, work, tensors[-1], final_T, last, planes)
    gradients = _to_gaussians(settings, work, tensors, partials)
    return Step(image, gradients, time.perf_counter() - start)


def _to_gaussians(
    settings: RasterSettings, work: Work, tensors: tuple[Tensor, ...], partials: Tensor
) -> tuple[Tensor, ...]:
    means2d = tensors[0].new_zeros(len(tensors[0]), 2)
    no_camera = torch.zeros(0, 12, dtype=torch.float64)
    return tuple(project_backward(settings, work, tensors, partials, means2d, no_camera))


def psnr(image: Tensor, exact: Tensor) -> float:
    """Peak 1 [dB], at most ``PSNR_LIMIT``."""
    error = float((image.double() - exact.double()).square().mean())
    return min(PSNR_LIMIT, -10.0 * math.log10(max(error, 1e-300)))


def _like(image: Tensor, exact: Tensor) -> Tensor:
    """A reduced image at the exact one's size."""
    if image.shape == exact.shape:
        return image
    size = tuple(exact.shape[1:])
    return torch.nn.functional.interpolate(image[None], size=size, mode="bilinear", align_corners=False)[0]


def _three_sigma(splats: Tensor) -> None:
    drawn = splats[:, 6] > 0
    splats[:, 12] = torch.where(drawn, 9.0, splats[:, 12])
    splats[:, 13] = torch.where(drawn, 3.0 * splats[:, 6].rsqrt() + 0.01, splats[:, 13])


def _half_precision(splats: Tensor) -> None:
    """Round what is blended; the bounds of an ellipse (reach, half height, radius) stay as they are."""
    splats[:, :12] = splats[:, :12].half().float()


def _level(name: str, thresholds: tuple[float, float]) -> Setting:
    settings = replace(BALANCED, alpha_threshold=thresholds[0], stop=thresholds[1])
    return Setting(
        knob="raster.accuracy",
        value=name,
        timed=settings,
        scored=settings,
        default=settings == BALANCED,
        slow=thresholds[0] == 0.0,
        note=f"alpha {fraction(thresholds[0])}, stop {fraction(thresholds[1])}",
    )


def fraction(value: float) -> str:
    """1/255 instead of 0.00392157, 1e-4 instead of 1/10000."""
    if value <= 0.0 or value > 1.0 / 16.0:
        return f"{value:g}"
    power = round(math.log10(value))
    if abs(value / 10.0**power - 1.0) < 1e-9:
        return f"1e{power}"
    return f"1/{1.0 / value:g}"


def _settings_knob(knob: str, name: str, values: Sequence[float]) -> list[Setting]:
    return [
        Setting(
            knob=knob,
            value=fraction(value),
            timed=replace(BALANCED, **{name: value}),
            scored=replace(NEARLY_EXACT, **{name: value}),
            default=value == getattr(BALANCED, name),
            slow=name == "alpha_threshold" and value == 0.0,
        )
        for value in values
    ]


def raster_knobs() -> list[list[Setting]]:
    """Every knob of the rasterizer with its values; each has one default, which its times are compared with."""
    same = {"timed": BALANCED, "scored": NEARLY_EXACT}
    exact_exp = {"timed": replace(BALANCED, exp="exact"), "scored": replace(NEARLY_EXACT, exp="exact")}
    plain = {"timed": replace(BALANCED, form="plain"), "scored": replace(NEARLY_EXACT, form="plain")}
    rounded = "splats rounded between projection and blending; the kernels have no such form, so no time"
    return [
        [_level(name, thresholds) for name, thresholds in ACCURACY.items()],
        _settings_knob("alpha threshold", "alpha_threshold", (0.0, 1e-6, 1 / 1024, 1 / 255, 1 / 64)),
        _settings_knob("stop", "stop", (0.0, 1e-4, 1e-3, 1e-2)),
        _settings_knob("low-pass", "low_pass", (0.0, 0.1, 0.3)),
        [
            Setting(knob="extent", value="ellipse", default=True, **same),
            Setting(
                knob="extent", value="3 sigma", edit=_three_sigma, note="bounds set after the projection", **same
            ),
        ],
        [
            Setting(knob="exp", value="polynomial", default=True, **same),
            Setting(knob="exp", value="exact", **exact_exp),
        ],
        [
            Setting(knob="storage", value="float64, plain form", dtype=torch.float64, **plain),
            Setting(knob="storage", value="float32, plain form", **plain),
            Setting(knob="storage", value="float32", default=True, **same),
            Setting(knob="storage", value="float16", edit=_half_precision, has_time=False, note=rounded, **same),
        ],
        [
            Setting(knob="image scale", value="1", default=True, **same),
            Setting(
                knob="image scale",
                value="1/2",
                image_scale=0.5,
                note="image enlarged again; gradient of the reduced image's error",
                **same,
            ),
        ],
    ]


class Reference:
    """Exact steps of the scenes, made when they are asked for and kept."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self.scenes = scenes
        self._steps: dict[tuple[int, float], Step] = {}

    def step(self, view: int, low_pass: float) -> Step:
        """The exact image and gradient of a view."""
        key = (view, low_pass)
        if key not in self._steps:
            self._steps[key] = run_step(self.scenes[view], replace(EXACT, low_pass=low_pass))
        return self._steps[key]

    def remainder(self, side: int = 24) -> float:
        """Largest change of a pixel without any threshold, in the middle of the first view, which is slow."""
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
    """Median milliseconds and median ratio to the default, round by round: a slow moment meets all values."""
    quick = [setting for setting in knob if not setting.slow and setting.has_time]
    base = next(setting for setting in knob if setting.default)
    seconds: dict[str, list[float]] = {setting.value: [] for setting in knob}
    ratios: dict[str, list[float]] = {setting.value: [] for setting in knob}

    def measure(scene: Scene, settings: Sequence[Setting]) -> None:
        now = {setting.value: run_step(scene, setting.timed, setting).seconds for setting in settings}
        for value, taken in now.items():
            seconds[value].append(taken)
            ratios[value].append(taken / now[base.value])

    for setting in quick:
        run_step(scenes[0], setting.timed, setting)  # compiles and warms up
    for _ in range(rounds):
        for scene in scenes:
            measure(scene, quick)
    for setting in knob:
        if setting.slow:
            measure(scenes[0], [base, setting])
    return {value: (1e3 * median(taken), median(ratios[value])) for value, taken in seconds.items() if taken}


def measure_knob(knob: Sequence[Setting], reference: Reference, *, rounds: int) -> list[Row]:
    """Rows of one knob: times with everything else balanced, errors with everything else nearly exact."""
    times = _times(knob, reference.scenes, rounds)
    rows = []
    for setting in knob:
        low_pass = setting.scored.low_pass
        few = setting.slow or low_pass != BALANCED.low_pass  # each costs an exact image of its own
        views = range(1 if few else len(reference.scenes))
        steps = [run_step(reference.scenes[view], setting.scored, setting) for view in views]
        score = _score(steps, [reference.step(view, low_pass) for view in views])
        note = setting.note
        if low_pass != BALANCED.low_pass:
            other = psnr(reference.step(0, low_pass).image, reference.step(0, BALANCED.low_pass).image)
            note = f"another picture: {other:.1f} dB from that of {BALANCED.low_pass:g}"
        ms, ratio = times.get(setting.value, (None, None))
        rows.append(
            Row(
                knob=setting.knob,
                value=setting.value,
                default=setting.default,
                ms=ms,
                ratio=ratio,
                psnr=score.psnr,
                worst=score.worst,
                gradient=score.gradient,
                note=note,
            )
        )
    return rows
