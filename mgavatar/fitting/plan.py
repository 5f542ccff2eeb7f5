"""The plan: every ``auto`` of a configuration decided by what the capture shows, each with its reason.

The rules are explained in ``docs/presets-and-budgets.md``. A value that the user gave is never touched.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig, ResolvedConfig, resolve
from mgavatar.head.model import HeadModel
from mgavatar.head.params import pad_or_truncate

FINE_ENOUGH = 12_000
"""A head model with so many vertices is not subdivided; the paper's mesh has 20K."""

STILL = 0.1
"""Turn [deg] below which a joint was not tracked, or held."""

SMALL_TURN = 2.0
"""Turn of neck, jaw and eyes [deg] up to which images do not show the errors of skinning: a chin 100 mm from its joint
moves by 3.5 mm, of which skinning gets a tenth wrong."""

HALF_PIXEL, HALF_TURN = 0.5, 0.5
"""Motion [px] and turn of a joint [deg] up to which images do not show them; the turn moves a chin by 0.9 mm."""

ONE_DIRECTION = 2.0
"""Angle [deg] to their mean up to which view directions count as one."""

NARROW_VIEWS = 10.0
"""Angle [deg] up to which shading hardly varies: that of skin by 1 - cos(10 deg) = 1.5 %, four of 255 steps."""

LEVELS, FINEST = 16, 4096
"""Number of levels and finest resolution of the paper's grid, which starts at 16 cells."""

GROWTH = 256.0 ** (1.0 / 15.0)
"""Largest ratio of the resolutions of two levels, that of the paper's grid: 1.45."""

MAP_SIZES = (64, 128, 256)
"""Sizes of OffsetNet's maps to choose from [px]."""


@dataclass(frozen=True)
class Decision:
    """One key that was ``auto``.

    Attributes:
        key: Key of the configuration, with dots.
        value: Value in place of ``auto``.
        reason: The reason in a few words, with its numbers.
    """

    key: str
    value: bool | int | str
    reason: str

    def __str__(self) -> str:
        return f"{self.reason} (--{self.key.replace('_', '-')})"


@dataclass(frozen=True, eq=False)
class CaptureCoverage:
    """Measures of how well the training images of a capture cover the head.

    Attributes:
        head: The head model.
        subject: The capture.
        max_image_size: Longest side of the images in the appearance stage [px].
    """

    head: HeadModel
    subject: Subject
    max_image_size: int

    @cached_property
    def timesteps(self) -> list[int]:
        """List the rows of the parameters that have training images."""
        return sorted({frame.timestep for frame in self.subject.frames["train"]})

    @cached_property
    def directions(self) -> np.ndarray:
        """Return unit vectors from the head to the camera of each training image, in the head's frame, shape [N, 3]."""
        p = self.subject.params
        rows = []
        for frame, center in zip(self.subject.frames["train"], self._centers, strict=True):
            root = Rotation.from_rotvec(p.rotation[frame.timestep])
            neck = Rotation.from_rotvec(p.neck_pose[frame.timestep])
            rows.append((root * neck).apply(_unit(frame.camera.position - center), inverse=True))
        return np.stack(rows)

    @cached_property
    def spread(self) -> float:
        """Return the largest angle of a direction to their mean [deg]; 180 if they cancel."""
        mean = self.directions.mean(0)
        if np.linalg.norm(mean) < 1e-6:
            return 180.0
        return float(np.degrees(np.arccos(np.clip(self.directions @ _unit(mean), -1.0, 1.0))).max())

    @cached_property
    def pixel(self) -> float:
        """Return the width of a pixel on the head [m], the median over the training images."""
        widths = []
        for frame, center in zip(self.subject.frames["train"], self._centers, strict=True):
            camera = frame.camera
            shrink = min(1.0, self.max_image_size / max(camera.width, camera.height))
            depth = float(camera.viewmat[2, :3] @ center + camera.viewmat[2, 3])
            widths.append(max(depth, 1e-6) / (shrink * float(camera.K[0, 0])))
        return float(np.median(widths))

    @cached_property
    def edge(self) -> float:
        """Return the mean edge length of the head model [m]."""
        verts, faces = self.head.v_template, self.head.faces
        return float(np.linalg.norm(verts[faces] - verts[np.roll(faces, -1, axis=1)], axis=2).mean())

    @cached_property
    def extent(self) -> float:
        """Return the longest side of ColorNet's grid [m]: the head's box with a margin of 5 % on either side."""
        return 1.1 * float(np.ptp(self.head.v_template, axis=0).max())

    @cached_property
    def head_pixels(self) -> float:
        """Return the number of pixels of the head in an image, the median over the training images."""
        a, b, c = np.moveaxis(self.head.v_template[self.head.faces].astype(np.float64), 1, 0)
        areas = 0.5 * np.cross(b - a, c - a)
        # Seen from one direction, a closed surface has as much area in front as behind: half of all is in sight.
        return float(np.median(0.5 * np.abs(self.directions @ areas.T).sum(1))) / self.pixel**2

    def turn(self, name: str) -> float:
        """Return the largest turn of a joint away from its mean over the training timesteps [deg].

        Args:
            name: Key of its parameters, for example ``jaw_pose``.
        """
        values = getattr(self.subject.params, name)[self.timesteps]
        away = (values - values.mean(0)).reshape(len(values), -1, 3)
        return float(np.degrees(np.linalg.norm(away, axis=2).max()))

    @cached_property
    def expression(self) -> float:
        """Return the largest motion of a vertex by expressions, away from their mean over training timesteps [m]."""
        head = self.head
        values = pad_or_truncate(self.subject.params.expr[self.timesteps], head.n_expr)
        dirs = head.shapedirs[:, :, head.n_shape :].reshape(3 * len(head.v_template), head.n_expr)
        mean = values.mean(0)
        return max(float(np.linalg.norm((dirs @ (row - mean)).reshape(-1, 3), axis=1).max()) for row in values)

    @cached_property
    def _centers(self) -> np.ndarray:
        """Return the middle of the head in world space for each training image [m], shape [N, 3]."""
        p, verts = self.subject.params, self.head.v_template
        root = self.head.J_regressor[0] @ verts
        out = verts.mean(0) - root
        steps = [frame.timestep for frame in self.subject.frames["train"]]
        return Rotation.from_rotvec(p.rotation[steps]).apply(out) + root + p.translation[steps]


def plan(config: FitConfig, head: HeadModel, subject: Subject) -> tuple[ResolvedConfig, tuple[Decision, ...]]:
    """Decide every ``auto`` for a capture.

    Args:
        config: The user's request.
        head: Head model that the capture was tracked with.
        subject: The capture; no image is read.

    Returns:
        The configuration without any ``auto``, and the decisions that change what the fit does.
    """
    coverage = CaptureCoverage(head, subject, config.appearance.max_image_size)
    decided: dict[str, Any] = {}
    decisions = []
    for key, rule in RULES.items():
        if _value(config, key) != "auto":
            continue
        value, reason = rule(config, coverage)
        # Later rules see earlier decisions: the number of hash levels depends on the finest resolution.
        config = _with(config, key, value)
        decided[key] = value
        if _matters(config, key):
            decisions.append(Decision(key, value, reason))
    if any(decision.key == "appearance.colors" and decision.value == "sh" for decision in decisions):
        decided["appearance.sh.degree"] = 0
    return resolve(config, decided), tuple(decisions)


def _subdivisions(config: FitConfig, coverage: CaptureCoverage) -> tuple[int, str]:
    n_verts, pixels = len(coverage.head.v_template), coverage.edge / coverage.pixel
    if n_verts >= FINE_ENOUGH:
        return 0, f"no subdivision: the head model has {n_verts} vertices"
    if pixels <= config.geometry.fine_edge:
        return 0, f"no subdivision: edges of {pixels:.1f} px are not worth splitting"
    return 1, f"one subdivision: edges of {pixels:.1f} px are longer than {config.geometry.fine_edge:g}"


def _learn_jaw(config: FitConfig, coverage: CaptureCoverage) -> tuple[bool, str]:
    turn = coverage.turn("jaw_pose")
    return (True, f"jaw refined: it turns by {turn:.1f} deg") if turn > STILL else (False, "jaw held: it never turns")


def _learn_eyes(config: FitConfig, coverage: CaptureCoverage) -> tuple[bool, str]:
    turn = coverage.turn("eyes_pose")
    return (
        (True, f"eyes refined: they turn by {turn:.1f} deg") if turn > STILL else (False, "eyes held: they are still")
    )


def _pose_offsets(config: FitConfig, coverage: CaptureCoverage) -> tuple[bool, str]:
    turn = max(coverage.turn(f"{name}_pose") for name in ("neck", "jaw", "eyes"))
    return (
        turn > SMALL_TURN,
        f"{'' if turn > SMALL_TURN else 'no '}pose offsets: neck, jaw and eyes turn by {turn:.1f} deg",
    )


def _offset_net(config: FitConfig, coverage: CaptureCoverage) -> tuple[bool, str]:
    if len(coverage.timesteps) == 1:
        return False, "no OffsetNet: one timestep"
    pixels = coverage.expression / coverage.pixel
    turn = max(coverage.turn(f"{name}_pose") for name in ("neck", "jaw", "eyes"))
    if pixels <= HALF_PIXEL and turn <= HALF_TURN:
        return False, f"no OffsetNet: expressions move {pixels:.1f} px, neck, jaw and eyes turn by {turn:.1f} deg"
    return True, f"OffsetNet: expressions move {pixels:.1f} px, neck, jaw and eyes turn by {turn:.1f} deg"


def _map_size(config: FitConfig, coverage: CaptureCoverage) -> tuple[int, str]:
    side = math.sqrt(coverage.head_pixels)
    size = min(MAP_SIZES, key=lambda size: abs(math.log(size / max(side, 1.0))))
    return size, f"UV maps of {size}: an image has {side:.0f} x {side:.0f} pixels on the head"


def _colors(config: FitConfig, coverage: CaptureCoverage) -> tuple[str, str]:
    if coverage.spread <= ONE_DIRECTION:
        return "sh", f"one colour a Gaussian: views differ by {coverage.spread:.1f} deg from one direction"
    return "color_net", f"ColorNet: views differ by up to {coverage.spread:.1f} deg from their mean"


def _view_frame(config: FitConfig, coverage: CaptureCoverage) -> tuple[str, str]:
    if coverage.spread <= NARROW_VIEWS:
        return "none", f"colours without view direction: views differ by {coverage.spread:.1f} deg at most"
    return (
        "canonical",
        f"colours by view direction in the head's frame: views differ by up to {coverage.spread:.0f} deg",
    )


def _max_resolution(config: FitConfig, coverage: CaptureCoverage) -> tuple[int, str]:
    base = config.appearance.color_net.base_resolution
    cells = max(base, min(FINEST, math.ceil(coverage.extent / coverage.pixel)))
    return cells, f"hash grid up to {cells} cells: {_mm(coverage.extent / cells)}, a pixel {_mm(coverage.pixel)}"


def _levels(config: FitConfig, coverage: CaptureCoverage) -> tuple[int, str]:
    grid = config.appearance.color_net
    steps = math.log(float(grid.max_resolution) / grid.base_resolution) / math.log(GROWTH)
    levels = min(LEVELS, 1 + math.ceil(steps - 1e-3))
    return levels, f"{levels} hash levels: {grid.base_resolution} to {grid.max_resolution} cells"


RULES: dict[str, Callable[[FitConfig, CaptureCoverage], tuple[Any, str]]] = {
    "geometry.subdivisions": _subdivisions,
    "geometry.learn_jaw": _learn_jaw,
    "geometry.learn_eyes": _learn_eyes,
    "geometry.pose_offsets": _pose_offsets,
    "appearance.colors": _colors,
    "appearance.color_net.view_frame": _view_frame,
    "appearance.color_net.max_resolution": _max_resolution,
    "appearance.color_net.levels": _levels,
    "appearance.offset_net.enabled": _offset_net,
    "appearance.offset_net.resolution": _map_size,
}
"""Every key that may be ``auto``, in the order in which they are decided."""


def _matters(config: FitConfig, key: str) -> bool:
    """Return True if the key's component is enabled."""
    if key.startswith("geometry.learn"):
        return config.geometry.enabled or config.appearance.head_tuning.enabled
    if key == "geometry.pose_offsets":
        return config.geometry.enabled
    if key.startswith("appearance.color_net."):
        return config.appearance.colors == "color_net"
    return key != "appearance.offset_net.resolution" or config.appearance.offset_net.enabled is True


def _mm(length: float) -> str:
    return f"{1e3 * length:.2f} mm"


def _value(config: Any, key: str) -> Any:
    for name in key.split("."):
        config = getattr(config, name)
    return config


def _with(config: Any, key: str, value: Any) -> Any:
    """Return a copy of nested dataclasses with another value at a dotted key."""
    name, _, rest = key.partition(".")
    return dataclasses.replace(config, **{name: _with(getattr(config, name), rest, value) if rest else value})


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
