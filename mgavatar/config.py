"""Every number of a fit. Defaults are the paper's where it gives one; ``configs/*.toml`` lists what a preset changes.

Where the paper is silent the value is the field's or was measured; ``docs/choices.md`` has the reasons.
"""

from __future__ import annotations

import dataclasses
import tomllib
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_type_hints

from mgavatar.errors import DataError


@dataclass(frozen=True, kw_only=True)
class ImageLossConfig:
    """Photometric loss (Eq. 4)."""

    color: float = 0.8
    """Weight of the mean absolute error, lambda_c."""
    ssim: float = 0.2
    """Weight of 1 - SSIM, lambda_m."""


@dataclass(frozen=True, kw_only=True)
class GeometryConfig:
    """Geometry stage (Section 3.1): vertex-bound Gaussians move the mesh."""

    enabled: bool = True
    """Without it the appearance is learned on the mesh as tracked."""
    iterations: int = 100_000
    max_image_size: int = 8192
    """Larger images are reduced until their longer side has this many pixels; evaluation is always at full size."""
    subdivisions: int | Literal["auto"] = "auto"
    """Midpoint subdivisions of the head model; the paper goes from 5K to 20K vertices with one, and ``auto`` takes one
    unless the head has that many already, or its edges are shorter than ``fine_edge``."""
    fine_edge: float = 4.0
    """Edges of so few pixels [px] in the images are not worth splitting."""
    lr_refine: float = 1e-3
    """RefineNet's networks, Phi_id and Phi_pose."""
    lr_triplane: float = 1e-3
    """RefineNet's triplane. The paper has one rate for both; in short fits the triplane, each number of which belongs
    to a few vertices only, learns better many times faster than the networks, which all vertices share."""
    lr_shape: float = 1e-2
    """Identity coefficients beta."""
    lr_expr: float = 1e-3
    """Expression coefficients psi of each timestep."""
    lr_pose: float = 1e-5
    """Rotations theta of each timestep."""
    lr_translation: float = 1e-6
    lr_scale: float = 5e-3
    """Logarithm of the Gaussians' scales."""
    lr_color: float = 2e-2
    lr_final_factor: float = 0.1
    """All rates fall exponentially to this share of themselves."""
    ssim: float | None = None
    """Weight of 1 - SSIM at the end of this stage, to which it moves steadily from that of ``loss`` (Eq. 4), with the
    rest as the colour's; None keeps both as they are. SSIM measures contrast against the contrast that is there: faint
    texture, as of skin, then moves the mesh as much as edges do, but outlines have to be in place by then."""
    lambda_offset: float = 10.0
    """Weight of Eq. 5, lambda_o; its norms are squared lengths [m^2] averaged over vertices."""
    lambda_laplacian: float = 1e5
    """Weight of Eq. 6, lambda_l; norms as in Eq. 5, Laplacian = vertex minus mean of its neighbours."""
    triplane_resolution: int = 128
    triplane_channels: int = 16
    hidden: int = 128
    """Channels of the 4-layer networks."""
    identity_offsets: bool = True
    """Learn Phi_id (Eq. 1)."""
    pose_offsets: bool | Literal["auto"] = True
    """Learn Phi_pose (Eq. 2); ``auto`` does so where neck, jaw or eyes move."""
    learn_jaw: bool | Literal["auto"] = True
    """Refine the jaw's rotations, also by ``appearance.head_tuning``; ``auto`` does so where the jaw moves."""
    learn_eyes: bool | Literal["auto"] = True
    """Refine the eyes' rotations, also by ``appearance.head_tuning``; ``auto`` does so where the eyes move."""
    offset_unit: float = 0.01
    """What an output of 1 of Phi_id and Phi_pose means [m]."""
    surface_shift: float = 0.0
    """At the outline Gaussians are drawn this many sigmas, as the camera sees them, behind the surface, elsewhere less,
    with the sine of the angle between line of sight and normal: opaque Gaussians look larger than the surface that
    carries them, and photometry alone pulls the mesh inwards. The paper has none."""
    initial_scale: float = 0.35
    """Sigma of a Gaussian at the start, in mean lengths of the edges at its vertex."""
    scales_follow_mesh: bool = False
    """Scales grow and shrink with the edges at their vertex, on top of what they learn: where the mesh is stretched to
    twice its size, as at shoulders that the template lacks, its Gaussians still cover it. Not in the paper."""
    start_from_tracked_shape: bool = True
    """Start beta at the capture's ``shape``; otherwise at the neutral template."""
    joints: Literal["refined", "tracked"] = "refined"
    """Where the head turns about: joints regressed from the refined head, or from the tracker's own, about which the
    tracked rotations were found."""
    tracked_offsets: bool = False
    """Add the capture's ``static_offset`` to the head model, where there is one."""


@dataclass(frozen=True, kw_only=True)
class DensityConfig:
    """Adaptive density control of the face-bound Gaussians."""

    start: int = 10_000
    stop: int = 200_000
    every: int = 2_000
    gradient: float = 2e-4
    """Mean norm of the gradient of the image-space mean, in half image sizes, above which a Gaussian is refined."""
    split_scale: float = 0.01
    """Larger Gaussians are split, smaller ones cloned; in diagonals of the mesh's bounding box."""
    min_opacity: float = 0.005
    max_gaussians: int = 400_000


@dataclass(frozen=True, kw_only=True)
class ColorNetConfig:
    """Grid-based neural colour field (Eq. 9)."""

    levels: int | Literal["auto"] = 16
    base_resolution: int = 16
    max_resolution: int | Literal["auto"] = 4096
    """``auto`` (of both): cells down to the size of a pixel on the head, levels at most 1.45 times finer each."""
    log2_table_size: int = 19
    hidden: int = 64
    """Channels of the 2-layer network."""
    view_frame: Literal["canonical", "world", "none", "auto"] = "canonical"
    """The view direction is carried into the canonical frame of the Gaussian's face, stays in the world, or is left
    out; ``auto`` leaves it out where the views hardly differ in direction."""
    lr: float = 1e-2


@dataclass(frozen=True, kw_only=True)
class OffsetNetConfig:
    """Convolutional offset network (Eq. 10)."""

    enabled: bool | Literal["auto"] = True
    """``auto`` leaves it out where nothing moves."""
    resolution: int | Literal["auto"] = 256
    """Height and width of the UV maps; ``auto``: as many texels as the images have pixels on the head."""
    channels: int = 64
    lr: float = 1e-4
    regularize: float = 0.01
    """Weight of the offset maps' squared mean, lambda_a in Eq. 11."""


@dataclass(frozen=True, kw_only=True)
class ShConfig:
    """Spherical harmonics, the usual colours of Gaussians, in the place of ColorNet."""

    degree: int = 3
    view_frame: Literal["canonical", "world"] = "world"
    lr: float = 2.5e-3
    """Of the constant; the others have a twentieth."""


@dataclass(frozen=True, kw_only=True)
class HeadTuningConfig:
    """Fine-tuning of the tracked parameters in the appearance stage, as the field does on a fixed mesh."""

    enabled: bool = False
    lr_expr: float = 1e-3
    lr_pose: float = 1e-5
    lr_translation: float = 1e-6


@dataclass(frozen=True, kw_only=True)
class AppearanceConfig:
    """Appearance stage (Section 3.2): face-bound Gaussians on the frozen mesh."""

    iterations: int = 240_000
    max_image_size: int = 8192
    """As in the geometry stage."""
    lr_means: float = 5e-3
    """Local centres, in units of the face's scale k."""
    lr_scales: float = 1.7e-2
    lr_quats: float = 1e-3
    lr_opacities: float = 5e-2
    lr_final_factor: float = 0.1
    """All rates fall exponentially to this share of themselves."""
    initial_scale: float = 0.5
    """Sigma along the face at the start, in units of k."""
    initial_thickness: float = 0.2
    """Sigma across the face at the start, in units of k."""
    initial_opacity: float = 0.9
    lambda_position: float = 0.01
    """lambda_mu in Eq. 11."""
    lambda_scale: float = 1.0
    """lambda_s in Eq. 11."""
    epsilon_position: float = 1.0
    """Free radius of the local position, epsilon_mu, in units of k."""
    epsilon_scale: float = 0.6
    """Free size of the local scale, epsilon_s, in units of k."""
    colors: Literal["color_net", "sh", "auto"] = "color_net"
    """ColorNet (Eq. 9), or spherical harmonics; ``auto``: ColorNet unless there is only one direction to see from."""
    density: DensityConfig = field(default_factory=DensityConfig)
    sh: ShConfig = field(default_factory=ShConfig)
    head_tuning: HeadTuningConfig = field(default_factory=HeadTuningConfig)
    color_net: ColorNetConfig = field(default_factory=ColorNetConfig)
    offset_net: OffsetNetConfig = field(default_factory=OffsetNetConfig)


Accuracy = Literal["exact", "accurate", "balanced", "fast"]

ACCURACY: dict[Accuracy, tuple[float, float]] = {
    "exact": (1e-8, 0.0),  # what is below is lost to single precision anyway; 0 would cost hundreds of times as much
    "accurate": (1.0 / 1024.0, 1e-4),
    "balanced": (1.0 / 255.0, 1e-4),
    "fast": (1.0 / 64.0, 1e-3),
}
"""Alpha threshold and stop of each level; ``docs/quality-and-speed.md`` has what they cost and save."""


@dataclass(frozen=True, kw_only=True)
class RasterConfig:
    """What the rasterizer may leave out (``kernels/rasterize.py``)."""

    accuracy: Accuracy = "balanced"
    """Level of :data:`ACCURACY`: how much is left out, from nothing that single precision can see to a few percent."""
    alpha_threshold: float | None = None
    """Contributions below this alpha are skipped; by default as the level says."""
    stop: float | None = None
    """A pixel ends once its transmittance is below this; by default as the level says."""

    def thresholds(self) -> tuple[float, float]:
        """Alpha threshold and stop: the level's, unless given."""
        alpha_threshold, stop = ACCURACY[self.accuracy]
        return (
            alpha_threshold if self.alpha_threshold is None else self.alpha_threshold,
            stop if self.stop is None else self.stop,
        )


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """A whole fit."""

    principal_point: Literal["center", "opencv", "opengl"] = "center"
    """Where the capture's principal point is: the centre (as GaussianAvatars assumes), or cx, cy counted from the
    top (opencv) or from the bottom (opengl)."""
    random_background: bool = False
    """Put training images on a new colour at every iteration, where the capture has masks: a white shirt on a white
    background is no edge otherwise. Not in the paper."""
    log_every: int = 20
    """Iterations between lines of ``metrics.jsonl``."""
    checkpoint_minutes: float = 5.0
    loss: ImageLossConfig = field(default_factory=ImageLossConfig)
    geometry: GeometryConfig = field(default_factory=GeometryConfig)
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)


def settled(value: int | Literal["auto"]) -> int:
    """A number that ``auto`` may have stood for.

    Raises:
        ValueError: If it still does; ``plan.py`` settles it.
    """
    if value == "auto":
        raise ValueError("auto: plan() settles such keys before anything is built")
    return int(value)


def preset_names() -> list[str]:
    """Presets that are installed with the program."""
    files = resources.files("mgavatar.configs").iterdir()
    return sorted(Path(file.name).stem for file in files if file.name.endswith(".toml"))


def read_preset(preset: str) -> dict[str, Any]:
    """The table of a preset, by name or by the path of a ``.toml`` file; of several, ``quick,baseline``, merged.

    Raises:
        DataError: If there is no such preset, or the file is not TOML.
    """
    table: dict[str, Any] = {}
    for name in preset.split(","):
        _merge(table, _read_one(name.strip()))
    return table


def _merge(table: dict[str, Any], more: dict[str, Any]) -> None:
    """Put ``more`` into ``table``; where both have a value, ``more`` wins."""
    for key, value in more.items():
        if isinstance(value, dict) and isinstance(table.get(key), dict):
            _merge(table[key], value)
        else:
            table[key] = value


def _read_one(preset: str) -> dict[str, Any]:
    if preset.endswith(".toml"):
        source: Any = Path(preset)
        if not source.is_file():
            raise DataError(f"{preset}: no such file; give a preset ({', '.join(preset_names())}) or a .toml file")
    elif preset in preset_names():
        source = resources.files("mgavatar.configs") / f"{preset}.toml"
    else:
        raise DataError(f"no preset '{preset}'; there are {', '.join(preset_names())}, or a path ending in .toml")
    try:
        return tomllib.loads(source.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{preset}: not a TOML file ({error})") from error


def preset_flags(table: dict[str, Any], prefix: str = "", *, kind: type = FitConfig) -> list[str]:
    """A preset as command line flags, so that one parser checks both (and suggests the nearest key).

    A key of ``kind`` that is on or off becomes ``--key`` or ``--no-key``; one that may be "auto" too takes a word.
    """
    flags: list[str] = []
    types = get_type_hints(kind)
    for key, value in table.items():
        name = f"{prefix}{key}".replace("_", "-")
        if isinstance(value, dict):
            flags += preset_flags(value, f"{prefix}{key}.", kind=types.get(key, dict))
        elif isinstance(value, bool) and types.get(key, bool) is bool:
            head, _, tail = name.rpartition(".")
            flags.append(f"--{name}" if value else f"--{head}.no-{tail}" if head else f"--no-{tail}")
        else:
            flags.append(f"--{name}={str(value).lower() if isinstance(value, bool) else value}")
    return flags


def to_toml(config: Any, prefix: str = "") -> str:
    """A config as TOML that :func:`read_preset` reads back."""
    plain, nested = [], []
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        if value is None:  # TOML has no word for it; left out, it is the default
            continue
        if dataclasses.is_dataclass(value):
            nested.append(f"\n[{prefix}{entry.name}]\n{to_toml(value, f'{prefix}{entry.name}.')}")
        else:
            text = (
                f'"{value}"'
                if isinstance(value, str)
                else str(value).lower()
                if isinstance(value, bool)
                else repr(value)
            )
            plain.append(f"{entry.name} = {text}\n")
    return "".join(plain + nested)


def from_dict(table: dict[str, Any], kind: type = FitConfig) -> Any:
    """The inverse of ``dataclasses.asdict``, for configs stored in an avatar.

    Raises:
        ValueError: If the table has a key that the config lacks.
    """
    fields = {entry.name: entry for entry in dataclasses.fields(kind)}
    unknown = sorted(set(table) - set(fields))
    if unknown:
        raise ValueError(f"unknown key {unknown[0]}")
    values = {}
    for name, value in table.items():
        default = fields[name].default_factory
        nested = default() if default is not dataclasses.MISSING else None
        values[name] = from_dict(value, type(nested)) if dataclasses.is_dataclass(nested) else value
    return kind(**values)


def check(config: FitConfig) -> None:
    """Refuse numbers that cannot work.

    Raises:
        DataError: Naming the key and its range.
    """
    g, a = config.geometry, config.appearance
    if config.raster.accuracy not in ACCURACY:
        raise DataError(f"--raster.accuracy {config.raster.accuracy}: must be one of {', '.join(ACCURACY)}")
    alpha_threshold, stop = config.raster.thresholds()
    bounds: tuple[tuple[str, Any, float, float], ...] = (
        ("geometry.iterations", g.iterations, 1, 10_000_000),
        ("geometry.max-image-size", g.max_image_size, 16, 65_536),
        ("appearance.max-image-size", a.max_image_size, 16, 65_536),
        ("geometry.subdivisions", g.subdivisions, 0, 3),
        ("geometry.triplane-resolution", g.triplane_resolution, 2, 1024),
        ("geometry.hidden", g.hidden, 1, 4096),
        ("geometry.lr-final-factor", g.lr_final_factor, 1e-6, 1.0),
        ("geometry.ssim", 0.0 if g.ssim is None else g.ssim, 0.0, 1.0),
        ("geometry.initial-scale", g.initial_scale, 0.01, 10.0),
        ("appearance.iterations", a.iterations, 1, 10_000_000),
        ("appearance.lr-final-factor", a.lr_final_factor, 1e-6, 1.0),
        ("appearance.initial-opacity", a.initial_opacity, 0.01, 0.999),
        ("appearance.color-net.levels", a.color_net.levels, 1, 32),
        ("appearance.color-net.max-resolution", a.color_net.max_resolution, a.color_net.base_resolution, 1_048_576),
        ("appearance.color-net.log2-table-size", a.color_net.log2_table_size, 4, 24),
        ("appearance.offset-net.resolution", a.offset_net.resolution, 16, 1024),
        ("appearance.density.every", a.density.every, 1, 10_000_000),
        ("appearance.sh.degree", a.sh.degree, 0, 3),
        ("raster.alpha-threshold", alpha_threshold, 0.0, 0.5),
        ("raster.stop", stop, 0.0, 0.5),
        ("log-every", config.log_every, 1, 10_000_000),
    )
    for name, value, low, high in bounds:
        if value != "auto" and not low <= value <= high:
            raise DataError(f"--{name} {value}: must lie between {low:g} and {high:g}")
    if a.offset_net.resolution != "auto" and a.offset_net.resolution % 8:
        raise DataError(f"--appearance.offset-net.resolution {a.offset_net.resolution}: must be a multiple of 8")
