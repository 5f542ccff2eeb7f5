"""Every number of a fit, with its range. Defaults are the paper's; a preset lists only what it changes.

Where the paper is silent, the value is the field's or was measured; ``docs/choices.md`` has the reasons.

There are two types of configuration. :class:`FitConfig` is a request: some of its keys may be ``auto``. A plan
(``fitting/plan.py``) decides those for a capture and returns a :class:`ResolvedConfig`, which everything that computes
takes.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from mgavatar.errors import DataError


@dataclass(frozen=True)
class Range:
    """Smallest and largest value of a number, both allowed."""

    low: float
    high: float


Count = Annotated[int, Range(1, 10_000_000)]
Iteration = Annotated[int, Range(0, 10_000_000)]
Pixels = Annotated[int, Range(16, 65_536)]
Channels = Annotated[int, Range(1, 4096)]
Rate = Annotated[float, Range(0.0, 10.0)]
"""Learning rate of Adam; 0 holds a parameter."""
Factor = Annotated[float, Range(1e-6, 1.0)]
Weight = Annotated[float, Range(0.0, 1e9)]
Subdivisions = Annotated[int, Range(0, 3)]
Levels = Annotated[int, Range(1, 32)]
Cells = Annotated[int, Range(1, 1_048_576)]
MapSize = Annotated[int, Range(16, 1024)]

Background = str
"""``"white"``, ``"black"`` or ``"R,G,B"``: see :func:`background_color`."""
PrincipalPoint = Literal["center", "opencv", "opengl"]


BACKGROUNDS: dict[str, tuple[float, float, float]] = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
"""RGB in 0..1 of the backgrounds that have a name."""


def background_color(text: Background) -> tuple[float, float, float]:
    """Return the RGB in 0..1 of a background.

    Args:
        text: ``"white"``, ``"black"``, or three numbers with commas: 0 to 255, or 0 to 1 if none is above 1.

    Raises:
        ValueError: If it is something else.
    """
    if text in BACKGROUNDS:
        return BACKGROUNDS[text]
    try:
        red, green, blue = (float(number) for number in text.split(","))
    except (ValueError, AttributeError):
        red = green = blue = math.nan
    highest = max(red, green, blue)
    if not (min(red, green, blue) >= 0.0 and highest <= 255.0):  # false for NaN
        raise ValueError(f"must be {', '.join(BACKGROUNDS)} or R,G,B with numbers from 0 to 255")
    scale = 255.0 if highest > 1.0 else 1.0
    return red / scale, green / scale, blue / scale


@dataclass(frozen=True, kw_only=True)
class ImageLossConfig:
    """Photometric loss (Eq. 4)."""

    color: Weight = 0.8
    """Weight of the mean absolute error, lambda_c."""
    ssim: Weight = 0.2
    """Weight of 1 - SSIM, lambda_m."""


@dataclass(frozen=True, kw_only=True)
class GeometryConfig:
    """Geometry stage (Section 3.1): vertex-bound Gaussians move the mesh."""

    enabled: bool = True
    """Fit the mesh; otherwise the appearance is learned on the mesh as tracked."""
    iterations: Count = 100_000
    """Iterations of this stage, one image each."""
    max_image_size: Pixels = 8192
    """Longer side to which training images are reduced [px]; evaluation is always at full size."""
    subdivisions: Subdivisions | Literal["auto"] = "auto"
    """Midpoint subdivisions of the head model; one takes FLAME from 5K to the paper's 20K vertices.
    auto: one, unless the head has that many already or its edges are shorter than fine_edge."""
    fine_edge: Annotated[float, Range(0.0, 1000.0)] = 4.0
    """Length of edges in the images that are not worth splitting [px]."""
    lr_refine: Rate = 1e-3
    """RefineNet's networks, Phi_id and Phi_pose."""
    lr_triplane: Rate = 1e-3
    """RefineNet's triplane. The paper has one rate for triplane and networks.
    In short fits the triplane learns better many times faster: each of its numbers belongs to a few vertices only."""
    lr_shape: Rate = 1e-2
    """Identity coefficients beta."""
    lr_expr: Rate = 1e-3
    """Expression coefficients psi of each timestep."""
    lr_pose: Rate = 1e-5
    """Rotations theta of each timestep."""
    lr_translation: Rate = 1e-6
    """Translation of each timestep."""
    lr_scale: Rate = 5e-3
    """Logarithm of the Gaussians' scales."""
    lr_color: Rate = 2e-2
    """Colours of the vertex-bound Gaussians."""
    lr_final_factor: Factor = 0.1
    """Factor to which all rates fall exponentially."""
    ssim: Annotated[float, Range(0.0, 1.0)] | None = None
    """Weight of 1 - SSIM at the end of this stage, reached steadily from loss.ssim (Eq. 4); the rest is the colour's.
    None keeps the weights of loss. SSIM lets faint texture, such as skin, move the mesh as much as edges do."""
    lambda_offset: Weight = 10.0
    """Weight of Eq. 5, lambda_o; its norms are squared lengths [m^2] averaged over vertices."""
    lambda_laplacian: Weight = 1e5
    """Weight of Eq. 6, lambda_l; norms as in Eq. 5, Laplacian = vertex minus the mean of its neighbours."""
    triplane_resolution: Annotated[int, Range(2, 1024)] = 128
    """Cells along each side of a plane."""
    triplane_channels: Annotated[int, Range(1, 256)] = 16
    """Features per cell of a plane."""
    hidden: Channels = 128
    """Channels of the 4-layer networks."""
    identity_offsets: bool = True
    """Learn Phi_id (Eq. 1)."""
    pose_offsets: bool | Literal["auto"] = True
    """Learn Phi_pose (Eq. 2). auto: where neck, jaw or eyes move."""
    center_pose_offsets: bool = True
    """Subtract Phi_pose's output at the capture's mean pose, so that all that is the same in all poses is identity."""
    learn_jaw: bool | Literal["auto"] = True
    """Refine the jaw's rotations, in appearance.head_tuning too. auto: where the jaw moves."""
    learn_eyes: bool | Literal["auto"] = True
    """Refine the eyes' rotations, in appearance.head_tuning too. auto: where the eyes move."""
    offset_unit: Annotated[float, Range(1e-6, 1.0)] = 0.01
    """Offset for an output of 1 of Phi_id and Phi_pose [m]."""
    surface_shift: Annotated[float, Range(0.0, 10.0)] = 0.0
    """Distance behind the surface at which Gaussians of the outline are drawn, in their sigmas in the image.
    Elsewhere it falls with the sine of the angle between line of sight and normal. Not in the paper:
    opaque Gaussians look larger than the surface that carries them, which pulls the mesh inwards."""
    initial_scale: Annotated[float, Range(0.01, 10.0)] = 0.35
    """Initial sigma of a Gaussian, in mean lengths of the edges at its vertex."""
    scales_follow_mesh: bool = False
    """Multiply the scales by the stretch of the edges at their vertex. Not in the paper:
    Gaussians then cover shoulders that stretch the template to twice its size."""
    start_from_tracked_shape: bool = True
    """Start beta at the capture's shape; otherwise at the neutral template."""
    joints: Literal["refined", "tracked"] = "refined"
    """Regress the joints from the refined head, or from the tracker's own head, for which the rotations were found."""
    tracked_offsets: bool = False
    """Add the capture's static_offset to the head model, where there is one."""


@dataclass(frozen=True, kw_only=True)
class DensityConfig:
    """Adaptive density control of the face-bound Gaussians."""

    start: Iteration = 10_000
    """First iteration with density control."""
    stop: Iteration = 200_000
    """Last iteration with density control."""
    every: Count = 2_000
    """Iterations between rounds."""
    gradient: Weight = 2e-4
    """Mean gradient of the image-space mean above which a Gaussian is refined, per half image size."""
    split_scale: Annotated[float, Range(0.0, 10.0)] = 0.01
    """Size above which a Gaussian is split and not cloned, in diagonals of the mesh's bounding box."""
    min_opacity: Annotated[float, Range(0.0, 0.999)] = 0.005
    """Opacity below which a Gaussian is removed."""
    max_gaussians: Annotated[int, Range(1, 100_000_000)] = 400_000
    """Largest number of Gaussians."""


@dataclass(frozen=True, kw_only=True)
class ColorNetConfig:
    """Grid-based neural colour field (Eq. 9)."""

    levels: Levels | Literal["auto"] = 16
    """Levels of the hash grid. auto: as many as make each level at most 1.45 times finer than the last."""
    base_resolution: Annotated[int, Range(1, 65_536)] = 16
    """Cells per side of the coarsest level."""
    max_resolution: Cells | Literal["auto"] = 4096
    """Cells per side of the finest level. auto: the size of a pixel on the head."""
    log2_table_size: Annotated[int, Range(4, 24)] = 19
    """Base-2 logarithm of the entries per level."""
    hidden: Channels = 64
    """Channels of the 2-layer network."""
    view_frame: Literal["canonical", "world", "none", "auto"] = "canonical"
    """Frame of the view direction: that of the Gaussian's face on the canonical head, the world, or no direction.
    auto: no direction where the views hardly differ."""
    lr: Rate = 1e-2
    """Hash grid and network."""


@dataclass(frozen=True, kw_only=True)
class OffsetNetConfig:
    """Convolutional offset network (Eq. 10)."""

    enabled: bool | Literal["auto"] = True
    """Learn OffsetNet. auto: where something moves."""
    resolution: MapSize | Literal["auto"] = 256
    """Height and width of the UV maps, a multiple of 8. auto: as many texels as the images have pixels on the head."""
    channels: Annotated[int, Range(2, 1024)] = 64
    """Channels of the hidden layers."""
    lr: Rate = 1e-4
    """All layers and the latent map."""
    regularize: Weight = 0.01
    """Weight of the offset maps' squared mean, lambda_a in Eq. 11."""


@dataclass(frozen=True, kw_only=True)
class ShConfig:
    """Spherical harmonics, the usual colours of Gaussians, in place of ColorNet."""

    degree: Annotated[int, Range(0, 3)] = 3
    """Degree, 0 to 3."""
    view_frame: Literal["canonical", "world"] = "world"
    """Frame of the view direction."""
    lr: Rate = 2.5e-3
    """Constant coefficient; the others learn at a twentieth of it."""


@dataclass(frozen=True, kw_only=True)
class HeadTuningConfig:
    """Refinement of the tracked parameters in the appearance stage, as the field does on a fixed mesh."""

    enabled: bool = False
    """Refine the tracked parameters in the appearance stage."""
    lr_expr: Rate = 1e-3
    """Expression coefficients psi of each timestep."""
    lr_pose: Rate = 1e-5
    """Rotations theta of each timestep."""
    lr_translation: Rate = 1e-6
    """Translation of each timestep."""


@dataclass(frozen=True, kw_only=True)
class AppearanceConfig:
    """Appearance stage (Section 3.2): face-bound Gaussians on the frozen mesh."""

    iterations: Count = 240_000
    """Iterations of this stage, one image each."""
    max_image_size: Pixels = 8192
    """Longer side to which training images are reduced [px]."""
    lr_means: Rate = 5e-3
    """Local centres, in units of the face's scale k."""
    lr_scales: Rate = 1.7e-2
    """Logarithms of the local scales."""
    lr_quats: Rate = 1e-3
    """Local rotations."""
    lr_opacities: Rate = 5e-2
    """Logits of the opacities."""
    lr_final_factor: Factor = 0.1
    """Factor to which all rates fall exponentially."""
    initial_scale: Annotated[float, Range(0.01, 10.0)] = 0.5
    """Initial sigma along the face, in units of k."""
    initial_thickness: Annotated[float, Range(0.001, 10.0)] = 0.2
    """Initial sigma across the face, in units of k."""
    initial_opacity: Annotated[float, Range(0.01, 0.999)] = 0.9
    """Initial opacity."""
    lambda_position: Weight = 0.01
    """Weight of the position hinge, lambda_mu in Eq. 11."""
    lambda_scale: Weight = 1.0
    """Weight of the scale hinge, lambda_s in Eq. 11."""
    epsilon_position: Annotated[float, Range(0.0, 1000.0)] = 1.0
    """Free radius of the local position, epsilon_mu, in units of k."""
    epsilon_scale: Annotated[float, Range(0.0, 1000.0)] = 0.6
    """Free size of the local scale, epsilon_s, in units of k."""
    colors: Literal["color_net", "sh", "auto"] = "color_net"
    """ColorNet (Eq. 9) or spherical harmonics. auto: ColorNet, unless all views share one direction."""
    density: DensityConfig = field(default_factory=DensityConfig)
    sh: ShConfig = field(default_factory=ShConfig)
    head_tuning: HeadTuningConfig = field(default_factory=HeadTuningConfig)
    color_net: ColorNetConfig = field(default_factory=ColorNetConfig)
    offset_net: OffsetNetConfig = field(default_factory=OffsetNetConfig)


Accuracy = Literal["exact", "accurate", "balanced", "fast"]

ACCURACY: dict[Accuracy, tuple[float, float]] = {
    "exact": (1e-8, 0.0),  # less than single precision can add; 0 would cost hundreds of times as much
    "accurate": (1.0 / 1024.0, 1e-4),
    "balanced": (1.0 / 255.0, 1e-4),
    "fast": (1.0 / 64.0, 1e-3),
}
"""Alpha threshold and stop of each level; ``docs/quality-and-speed.md`` has what they cost and save."""


@dataclass(frozen=True, kw_only=True)
class RasterConfig:
    """Truncations of the rasterizer."""

    accuracy: Accuracy = "balanced"
    """Accuracy against speed; exact loses nothing that single precision can represent, fast a few percent."""
    alpha_threshold: Annotated[float, Range(0.0, 0.5)] | None = None
    """Alpha below which contributions are skipped; by default as the level of accuracy has it."""
    stop: Annotated[float, Range(0.0, 0.5)] | None = None
    """Transmittance below which a pixel is complete; by default as the level of accuracy has it."""

    def thresholds(self) -> tuple[float, float]:
        """Return the alpha threshold and the stop: those of the level, unless given."""
        alpha_threshold, stop = ACCURACY[self.accuracy]
        return (
            alpha_threshold if self.alpha_threshold is None else self.alpha_threshold,
            stop if self.stop is None else self.stop,
        )


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """A whole fit."""

    background: Background = "white"
    """Colour that the capture's images are composited on: white, black, or R,G,B from 0 to 255."""
    principal_point: PrincipalPoint = "center"
    """Principal point: the image centre, or cx, cy from the file, counted from the top (opencv) or bottom (opengl)."""
    random_background: bool = False
    """Put training images on a new colour at every iteration, where the capture has masks. Not in the paper."""
    log_every: Count = 20
    """Iterations between lines of metrics.jsonl."""
    checkpoint_minutes: Annotated[float, Range(0.0, 1e6)] = 5.0
    """Minutes between checkpoints."""
    loss: ImageLossConfig = field(default_factory=ImageLossConfig)
    geometry: GeometryConfig = field(default_factory=GeometryConfig)
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)


@dataclass(frozen=True, kw_only=True)
class ResolvedGeometryConfig(GeometryConfig):
    """A :class:`GeometryConfig` without ``auto``."""

    subdivisions: Subdivisions = field()
    pose_offsets: bool = field()
    learn_jaw: bool = field()
    learn_eyes: bool = field()


@dataclass(frozen=True, kw_only=True)
class ResolvedColorNetConfig(ColorNetConfig):
    """A :class:`ColorNetConfig` without ``auto``."""

    levels: Levels = field()
    max_resolution: Cells = field()
    view_frame: Literal["canonical", "world", "none"] = field()


@dataclass(frozen=True, kw_only=True)
class ResolvedOffsetNetConfig(OffsetNetConfig):
    """An :class:`OffsetNetConfig` without ``auto``."""

    enabled: bool = field()
    resolution: MapSize = field()


@dataclass(frozen=True, kw_only=True)
class ResolvedAppearanceConfig(AppearanceConfig):
    """An :class:`AppearanceConfig` without ``auto``."""

    colors: Literal["color_net", "sh"] = field()
    color_net: ResolvedColorNetConfig = field()
    offset_net: ResolvedOffsetNetConfig = field()


@dataclass(frozen=True, kw_only=True)
class ResolvedConfig(FitConfig):
    """A :class:`FitConfig` in which every ``auto`` has been decided: what a fit does, and what an avatar remembers."""

    geometry: ResolvedGeometryConfig = field()
    appearance: ResolvedAppearanceConfig = field()


Config = TypeVar("Config")


def resolve(config: FitConfig, decided: Mapping[str, Any] | None = None) -> ResolvedConfig:
    """Return a configuration with every ``auto`` replaced.

    Args:
        config: The request.
        decided: Values of keys that are ``auto``, by their dotted names.

    Raises:
        ValueError: If a key is still ``auto``, or a decided value is out of range.
    """
    table = dataclasses.asdict(config)
    for key, value in (decided or {}).items():
        *sections, name = key.split(".")
        section = table
        for part in sections:
            section = section[part]
        section[name] = value
    return from_dict(table, ResolvedConfig)


def from_dict(table: Mapping[str, Any], kind: type[Config]) -> Config:
    """Return a configuration from nested tables, the inverse of ``dataclasses.asdict``; missing keys are defaults.

    Args:
        table: Values by their names, one table per section.
        kind: :class:`FitConfig` or :class:`ResolvedConfig`.

    Raises:
        ValueError: If a key is unknown, or a value has another type or is out of range; the message names the flag.
    """
    config: Config = _built(table, kind, "")
    _check_pairs(config)
    return config


def check(config: FitConfig) -> None:
    """Refuse values that cannot work.

    Raises:
        DataError: If a value has another type or is out of range; the message names the flag.
    """
    try:
        from_dict(dataclasses.asdict(config), type(config))
    except ValueError as error:
        raise DataError(str(error)) from error


def flag_of(key: str) -> str:
    """Return the command line's name of a dotted key."""
    return f"--{key.replace('_', '-')}"


def keys(kind: type = FitConfig, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the type of every key of a configuration, without its sections."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if dataclasses.is_dataclass(hint):
            yield from keys(typing.cast(type, hint), f"{prefix}{name}.")
        else:
            yield prefix + name, hint


def _built(table: Mapping[str, Any], kind: type, prefix: str) -> Any:
    hints = get_type_hints(kind, include_extras=True)
    for name in table:
        if name not in hints:
            near = difflib.get_close_matches(name, hints, n=1)
            meant = f"; did you mean {flag_of(prefix + near[0])}?" if near else ""
            raise ValueError(f"unknown key {prefix}{name}{meant}")
    values = {}
    for name, value in table.items():
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            if not isinstance(value, Mapping):
                raise ValueError(f"{prefix}{name} is {value!r}, a table of keys is needed")
            values[name] = _built(value, typing.cast(type, hint), f"{prefix}{name}.")
        elif (fitting := _fitting(value, hint)) is None:
            raise ValueError(f"{flag_of(prefix + name)} {_shown(value)}: must be {_wanted(hint)}")
        else:
            values[name] = fitting[0]
    try:
        return kind(**values)
    except TypeError as error:  # a resolved key has no default
        raise ValueError(f"{prefix.rstrip('.') or 'configuration'}: {error}") from error


def _fitting(value: Any, hint: Any) -> tuple[Any] | None:
    """Return a value as its type wants it, in a tuple because it may be None, or None if it does not fit."""
    for option in _options(hint):
        bounds, base = _range_of(option), _base_of(option)
        if get_origin(base) is Literal:
            if value in get_args(base) and not isinstance(value, bool):
                return (value,)
        elif base is float and isinstance(value, int | float) and not isinstance(value, bool):
            if bounds is None or bounds.low <= value <= bounds.high:  # false for NaN
                return (float(value),)
        elif type(value) is base and (bounds is None or bounds.low <= value <= bounds.high):
            return (value,)
    return None


def _options(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself."""
    return get_args(hint) if get_origin(hint) in (typing.Union, types.UnionType) else (hint,)


def _base_of(hint: Any) -> Any:
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _range_of(hint: Any) -> Range | None:
    found = [extra for extra in getattr(hint, "__metadata__", ()) if isinstance(extra, Range)]
    return found[0] if found else None


def _wanted(hint: Any) -> str:
    """Describe the values that a type allows."""
    words = []
    for option in _options(hint):
        bounds, base = _range_of(option), _base_of(option)
        if get_origin(base) is Literal:
            words += [str(word) for word in get_args(base)]
        elif base is str:
            words.append("text")
        elif base is bool:
            words += ["true", "false"]
        elif bounds is not None:
            number = "a whole number" if base is int else "a number"
            words.append(f"{number} between {bounds.low:g} and {bounds.high:g}")
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"


def _shown(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)[:60]


def _check_pairs(config: Any) -> None:
    """Check what one key's range cannot say."""
    if not isinstance(config, FitConfig):
        return
    try:
        background_color(config.background)
    except ValueError as error:
        raise ValueError(f"--background {_shown(config.background)}: {error}") from error
    grid, maps = config.appearance.color_net, config.appearance.offset_net
    if grid.max_resolution != "auto" and grid.max_resolution < grid.base_resolution:
        raise ValueError(
            f"--appearance.color-net.max-resolution {grid.max_resolution}: must be at least "
            f"--appearance.color-net.base-resolution {grid.base_resolution}"
        )
    if maps.resolution != "auto" and maps.resolution % 8:
        raise ValueError(f"--appearance.offset-net.resolution {maps.resolution}: must be a multiple of 8")
