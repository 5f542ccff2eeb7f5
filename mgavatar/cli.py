"""The command line: typed functions, and one line for everything that the user can mend.

Exit codes: 0 done, 1 the data is wrong, 2 the command line is wrong, 130 interrupted. Heavy imports happen inside the
commands, so that ``--help`` is quick.
"""

from __future__ import annotations

import dataclasses
import inspect
import io
import json
import logging
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import tyro

from mgavatar import __version__
from mgavatar import config as configs
from mgavatar.config import Background, FitConfig, PrincipalPoint
from mgavatar.errors import DataError
from mgavatar.presets import preset, preset_names, preset_summary

DEFAULT_PRESET = "quick"

# The configuration's keys are flags of their own: --geometry.iterations, not --config.geometry.iterations.
Config = Annotated[FitConfig, tyro.conf.arg(name="")]


def demo(
    *,
    out: Path = Path("demo_out"),
    device: str = "auto",
    seed: int = 0,
    preset: str = DEFAULT_PRESET,
    config: Config = FitConfig(),  # noqa: B008  frozen
) -> None:
    """Make a synthetic capture, fit an avatar to it, drive it, score it and write a report.

    Args:
        out: New folder for everything.
        device: auto, cpu, cuda or cuda:N.
        seed: Seed of the person and of the fit.
        preset: As in fit.
        config: As in fit.
    """
    from mgavatar.demo import run_demo

    scores = run_demo(out, config, device=device, seed=seed)
    _say_all(_score_lines(scores))
    print(out / "run" / "report.html")


def synth(
    *,
    out: Path,
    cameras: int = 16,
    timesteps: int = 12,
    size: str = "256x256",
    seed: int = 0,
    monocular: bool = False,
    head_model: str = "builtin",
) -> None:
    """Ray-trace a synthetic capture with its ground truth.

    Args:
        out: New folder of the capture.
        cameras: Number of cameras.
        timesteps: Number of timesteps.
        size: Image size, WIDTHxHEIGHT.
        seed: Seed of the person and of the motion.
        monocular: One camera and a turning head, with two cameras at its sides to score novel views only.
        head_model: Head model to start from: a FLAME .pkl, a head .npz, or builtin.
    """
    from mgavatar.head.find import load_head_model
    from mgavatar.pipeline import check_seed
    from mgavatar.progress import Reporter
    from mgavatar.synthetic.capture import make_synthetic_capture

    check_seed(seed)
    pixels = _size(size)
    head = load_head_model(head_model)
    with Reporter("synth", timesteps * (1 if monocular else cameras)) as reporter:
        make_synthetic_capture(
            out,
            cameras=cameras,
            timesteps=timesteps,
            size=pixels,
            seed=seed,
            monocular=monocular,
            head=head,
            progress=lambda done, total: reporter.update(done, total=total),
        )


def fit(
    *,
    data: Path,
    out: Path = Path("out.pt"),
    head_model: str | None = None,
    preset: str = DEFAULT_PRESET,
    device: str = "auto",
    seed: int = 0,
    resume: bool = False,
    budget: str | None = None,
    skip_bad: bool = False,
    follow_links: bool = False,
    config: Config = FitConfig(),  # noqa: B008  frozen
) -> None:
    """Fit an avatar to a tracked capture.

    Args:
        data: Folder of the capture, in the layout of VHAP and GaussianAvatars.
        out: The avatar, ending in .pt, with its report in the folder of that name; or a folder for everything.
        head_model: FLAME .pkl or head .npz that the capture was tracked with, or builtin; by default as it names.
        preset: Preset or .toml file; several are combined with commas, later ones override earlier ones.
        device: auto, cpu, cuda or cuda:N.
        seed: Seed of all random draws; a fit repeats bit for bit on one machine.
        resume: Continue the fit in --out.
        budget: Time after which the avatar is written, such as 90s, 5m or 1h, counted from now.
        skip_bad: Leave out frames with NaN or bad files.
        follow_links: Follow links of single files too.
        config: Every number of the method.
    """
    # The clock starts before the heavy imports.
    from mgavatar.fitting.budget import Budget, parse_budget

    limit = Budget(parse_budget(budget)) if budget is not None else None
    from mgavatar.capture.read import read_capture
    from mgavatar.fitting.run import open_run
    from mgavatar.head.find import resolve_head_model
    from mgavatar.pipeline import check_seed
    from mgavatar.pipeline import fit as run_fit
    from mgavatar.progress import FitReporter

    check_seed(seed)
    configs.check(config)
    open_run(out, resume=resume)  # what is wrong with --out is said before the capture is read
    subject = read_capture(
        data,
        background=config.background,
        principal_point=config.principal_point,
        skip_bad=skip_bad,
        follow_links=follow_links,
    )
    head = resolve_head_model(head_model, data)
    with FitReporter() as reporter:
        result = run_fit(
            subject, head, config, out=out, device=device, seed=seed, resume=resume, budget=limit, progress=reporter
        )
    if not result.finished:
        _say(f"{result.stopped_at}; {result.path} is usable, `--resume` continues the fit")
        raise SystemExit(130)
    if result.scores is not None:
        _say_all(_score_lines(result.scores))
    print(result.path)
    if result.report is not None:
        print(result.report)


def render(
    *,
    avatar: Path,
    driving: Path,
    out: Path | None = None,
    camera: str = "mean",
    head_motion: Literal["full", "neck", "none"] = "full",
    expression: Literal["auto", "use", "ignore"] = "auto",
    expression_map: Path | None = None,
    smooth: bool = False,
    format: Literal["auto", "png", "exr", "mp4"] = "auto",
    size: str | None = None,
    frames: str | None = None,
    background: str | None = None,
    fps: float | None = None,
    overwrite: bool = False,
    device: str = "auto",
) -> None:
    """Drive an avatar with a sequence of FLAME parameters or of ARKit's blendshapes.

    Args:
        avatar: The avatar, or the folder of its fit.
        driving: Motion of a tracker, a phone or a browser, as a file or a folder; docs/driving.md lists the formats.
        out: FILE.mp4, FILE.gif, or a folder for single frames; by default a video named after the motion.
        camera: mean, train:ID, orbit, or a .json with the keys of a transforms frame.
        head_motion: Take the root's motion as driven (full), put it into the neck (neck), or take none.
        expression: Use the expression columns if their basis is the head's (auto), always (use), or ignore them.
        expression_map: Map from ARKit's blendshapes to the avatar's head; by default by names, else computed.
        smooth: Smooth jittery motion, without delay.
        format: Format of single frames, or mp4; by default as --out says.
        size: Image size, WIDTHxHEIGHT; the camera's own by default.
        frames: Frames to draw, START:STOP or START:STOP:STEP, counted from 0.
        background: white, black, R,G,B, or transparent for PNG with alpha; the capture's own by default.
        fps: Frames per second of the video; by default as the motion says, else 25.
        overwrite: Replace a video that is there already.
        device: auto, cpu, cuda or cuda:N.
    """
    from mgavatar.avatar import Avatar
    from mgavatar.device import find_device
    from mgavatar.driving.map_expressions import map_for
    from mgavatar.driving.read import read_driving
    from mgavatar.driving.render import backdrop
    from mgavatar.driving.render import render as run_render
    from mgavatar.driving.smooth import smoothed
    from mgavatar.driving.writers import default_name, kind_of
    from mgavatar.progress import Reporter

    pixels = _size(size) if size else None
    chosen = _slice(frames) if frames else None
    target = out if out is not None else default_name(driving, format)
    backdrop(target, kind_of(target, format, overwrite=overwrite), background)
    motion = read_driving(driving)
    if fps is not None:
        if not 0.0 < fps <= 1000.0:
            raise DataError(f"--fps {fps:g}: must lie between 0 and 1000")
        motion = dataclasses.replace(motion, fps=fps)
    if smooth:
        motion, jitter = smoothed(motion)
        _say(jitter)
    loaded = Avatar.load(avatar, device=find_device(device))
    mapped, note = map_for(motion, loaded.head_model, given=expression_map, avatar=avatar)
    _say_all([note] if note else [])
    with Reporter("render", len(motion)) as reporter:
        notes = run_render(
            loaded,
            motion,
            out=target,
            camera=camera,
            head_motion=head_motion,
            expression=expression,
            expression_map=mapped,
            format=format,
            size=pixels,
            frames=chosen,
            background=background,
            overwrite=overwrite,
            progress=lambda done, total: reporter.update(done, total=total),
        )
    _say_all(notes)
    print(target)


def export(
    *,
    avatar: Path,
    out: Path,
    to: Literal["auto", "splats", "mesh", "rig"] = "auto",
    pose: str = "neutral",
    driving: Path | None = None,
    expression_map: Path | None = None,
    degree: Literal[0, 1, 2, 3] = 3,
    morphs: int = 50,
    up: Literal["y", "-y"] = "y",
    overwrite: bool = False,
    device: str = "auto",
) -> None:
    """Write an avatar for other programs: splats or a coloured mesh in one pose, or a rig that can be posed.

    Args:
        avatar: The avatar, or the folder of its fit.
        out: FILE.ply (splats, or a mesh), FILE.glb (a mesh, splats, or a rig), FILE.obj or FILE.stl (a mesh).
        to: What the file has, splats, mesh or rig; by default as --out says.
        pose: neutral, mean, or a frame counted from 0: of --driving, or of the capture.
        driving: Motion that the frame is of, or the animation of a rig; files as in render.
        expression_map: As in render.
        degree: Degree of the splats' spherical harmonics.
        morphs: Largest number of a rig's expressions.
        up: Axis that points up in a .ply of splats; -y for viewers that turn such files.
        overwrite: Replace a file that is there already.
        device: auto, cpu, cuda or cuda:N.
    """
    from mgavatar.avatar import Avatar
    from mgavatar.device import find_device
    from mgavatar.driving.map_expressions import map_for
    from mgavatar.driving.read import read_driving
    from mgavatar.export.export import content_of
    from mgavatar.export.export import export as run_export

    content = content_of(out, None if to == "auto" else to, up=up, overwrite=overwrite)
    motion = read_driving(driving) if driving is not None else None
    loaded = Avatar.load(avatar, device=find_device(device))
    mapped = None
    if motion is not None:
        mapped, note = map_for(motion, loaded.head_model, given=expression_map, avatar=avatar)
        _say_all([note] if note else [])
    notes = run_export(
        loaded,
        out,
        to=content,
        pose=pose,
        driving=motion,
        expression_map=mapped,
        degree=degree,
        morphs=morphs,
        up=up,
        overwrite=overwrite,
    )
    _say_all(notes)
    print(out)


def map_expressions(*, head_model: str, out: Path) -> None:
    """Compute a map from ARKit's blendshapes to a head's own expression directions, jaw and eyes.

    Args:
        head_model: FLAME .pkl or head .npz, or builtin.
        out: The map, ending in .npz, for `render --expression-map`.
    """
    from mgavatar.driving.expression_map import write_expression_map
    from mgavatar.driving.map_expressions import map_expressions as compute
    from mgavatar.files import check_writable
    from mgavatar.head.find import load_head_model
    from mgavatar.progress import Reporter

    if out.suffix.lower() != ".npz":
        raise DataError(f"{out}: the name of a map must end in .npz")
    check_writable(out)
    head = load_head_model(head_model)
    with Reporter("map-expressions", 52) as reporter:
        mapped = compute(head, progress=lambda done, total: reporter.update(done, total=total))
    write_expression_map(out, mapped)
    print("mean distance from the built-in head's motion:")
    for name, residual in zip(mapped.names, mapped.residual_mm, strict=True):
        found = "nothing of it" if name in mapped.unmapped else f"{residual:.2f} mm" if residual >= 0.0 else "eyes"
        print(f"{name:20} {found}")
    print(out)


def evaluate(
    *,
    avatar: Path,
    data: Path,
    split: Literal["val", "test", "all"] = "all",
    json: Path | None = None,
    lpips_weights: Path | None = None,
    background: Background | None = None,
    principal_point: PrincipalPoint | None = None,
    skip_bad: bool = False,
    follow_links: bool = False,
    device: str = "auto",
) -> None:
    """Score an avatar on the held-out frames of a capture, at full size.

    Args:
        avatar: The avatar, or the folder of its fit.
        data: Folder of the capture.
        split: Novel views (val), self-reenactment (test), or all.
        json: Write the scores to this file instead of printing them.
        lpips_weights: State dict of LPIPS-VGG; nothing is ever downloaded.
        background: As in fit; the avatar's own by default.
        principal_point: As in fit; the avatar's own by default.
        skip_bad: As in fit.
        follow_links: As in fit.
        device: auto, cpu, cuda or cuda:N.
    """
    from mgavatar.avatar import Avatar
    from mgavatar.capture.images import check_images
    from mgavatar.capture.placement import check_placement
    from mgavatar.capture.read import read_capture
    from mgavatar.device import find_device
    from mgavatar.files import check_writable
    from mgavatar.progress import Reporter
    from mgavatar.scoring.evaluate import evaluate as run_evaluate
    from mgavatar.scoring.evaluate import write_metrics

    if json is not None:
        check_writable(json)
    loaded = Avatar.load(avatar, device=find_device(device))
    own = loaded.config
    subject = read_capture(
        data,
        background=background or own.background,
        principal_point=principal_point or own.principal_point,
        skip_bad=skip_bad,
        follow_links=follow_links,
    )
    check_images(subject)
    check_placement(subject, loaded.head_model)
    splits: tuple[Literal["val", "test"], ...] = ("val", "test") if split == "all" else (split,)
    with Reporter("evaluate", sum(len(subject.frames[name]) for name in splits)) as reporter:
        metrics = run_evaluate(
            loaded,
            subject,
            avatar_path=avatar,
            splits=splits,
            lpips_weights=lpips_weights,
            progress=lambda done, total: reporter.update(done, total=total),
        )
    _say_all(_score_lines(metrics))
    if json is not None:
        write_metrics(json, metrics)
    else:
        print(_as_json(metrics))


def bench_kernels(
    *,
    threads: int | None = None,
    json: Path | None = None,
    device: str = "cpu",
    avatar: Path | None = None,
) -> None:
    """Time every kernel against its plain form and against this machine's lower bound.

    Args:
        threads: CPU threads of the kernels, all cores by default.
        json: Also write the rows to this file.
        device: auto, cpu, cuda or cuda:N.
        avatar: An avatar, or the folder of its fit, to time beside the synthetic scenes.
    """
    from mgavatar.benchmarks.kernels import bench_kernels as run_benchmark
    from mgavatar.device import find_device

    chosen = avatar / "avatar.pt" if avatar is not None and avatar.is_dir() else avatar
    print(run_benchmark(threads=threads, json_path=json, device=find_device(device).type, avatar=chosen))


# Each benchmark is a sub-command with flags of its own. tyro runs it while it builds the argument of `bench`.
Kernels = Annotated[None, tyro.conf.subcommand(name="kernels", prefix_name=False, constructor=bench_kernels)]


def bench(benchmark: Annotated[Kernels | Annotated[None, tyro.conf.Suppress], tyro.conf.arg(name="")]) -> None:
    """Benchmark this machine."""


_COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "synth": synth,
    "fit": fit,
    "render": render,
    "export": export,
    "map-expressions": map_expressions,
    "evaluate": evaluate,
    "bench": bench,
}


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and 16 <= int(width) <= 8192 and 16 <= int(height) <= 8192):
        raise DataError(f"--size {text}: give WIDTHxHEIGHT between 16 and 8192, for example 256x256")
    return int(width), int(height)


def _slice(text: str) -> slice:
    """Return the slice that ``START:STOP`` or ``START:STOP:STEP`` means; each number may be left out."""
    parts = text.split(":")
    numbers = [int(part) if part.isdigit() else None for part in parts]
    if len(parts) not in (2, 3) or any(part and not part.isdigit() for part in parts) or 0 in numbers[2:]:
        raise DataError(f"--frames {text}: give START:STOP or START:STOP:STEP, for example 0:100 or 0:100:5")
    return slice(*numbers)


def _as_json(metrics: dict[str, Any]) -> str:
    return json.dumps(metrics, indent=2)


def _score_lines(metrics: dict[str, Any]) -> list[str]:
    lines = []
    for split, score in metrics["splits"].items():
        naive = max(score["naive"].values()) if score.get("naive") else None
        beside = f" (best naive baseline {naive:.2f})" if naive is not None else ""
        lines.append(f"{split} ({score['task']}): PSNR {score['psnr']:.2f} dB{beside}, SSIM {score['ssim']:.4f}")
    if metrics["geometry"]:
        lines.append(f"geometry: mean {metrics['geometry']['mean_mm']:.2f} mm from the ground truth")
    return lines


def _say(text: str) -> None:
    print(f"mgavatar: {text}", file=sys.stderr, flush=True)


def _say_all(lines: Sequence[str]) -> None:
    for line in lines:
        _say(line)


# ---- parsing ----

_FLAGS = tyro.constructors.ConstructorRegistry()


@_FLAGS.primitive_rule
def _switch_or_auto(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """Parse ``--key true``, ``false`` or ``auto``: the words that a TOML file uses."""
    if info.type != bool | Literal["auto"]:
        return None
    words: dict[str, Any] = {"true": True, "false": False, "auto": "auto"}
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="{true,false,auto}",
        instance_from_str=lambda given: words[given[0]],
        is_instance=lambda value: isinstance(value, bool) or value == "auto",
        str_from_instance=lambda value: [str(value).lower()],
        choices=tuple(words),
    )


def _preset_of(argv: Sequence[str]) -> str:
    """Return the value of the last ``--preset``."""
    chosen = DEFAULT_PRESET
    for index, word in enumerate(argv):
        if word == "--preset" and index + 1 < len(argv):
            chosen = argv[index + 1]
        elif word.startswith("--preset="):
            chosen = word.partition("=")[2]
    return chosen


def _with_default(command: Callable[..., None], config: FitConfig, *, short_help: bool) -> Callable[..., None]:
    """Return a command whose configuration starts from a preset, so that the parser and its help show what will run.

    Args:
        command: A command with a parameter ``config``.
        config: Default of that parameter.
        short_help: Leave the sections of the configuration out of the help.
    """

    def run(**arguments: Any) -> None:
        command(**arguments)

    hints = get_type_hints(command, include_extras=True)
    if short_help:
        config = _without_sections(config)
        hints["config"] = Annotated[type(config), tyro.conf.arg(name="")]
    signature = inspect.signature(command)
    parameters = [
        parameter.replace(
            annotation=hints[parameter.name], default=config if parameter.name == "config" else parameter.default
        )
        for parameter in signature.parameters.values()
    ]
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = hints
    run.__name__ = command.__name__
    run.__doc__ = command.__doc__
    return run


def _without_sections(config: FitConfig) -> FitConfig:
    """Return the configuration as a type whose nested sections are hidden from the help."""
    hints = get_type_hints(FitConfig, include_extras=True)
    sections = [
        (entry.name, Annotated[hints[entry.name], tyro.conf.Suppress], dataclasses.field())
        for entry in dataclasses.fields(FitConfig)
        if dataclasses.is_dataclass(hints[entry.name])
    ]
    kind = dataclasses.make_dataclass("FitConfig", sections, bases=(FitConfig,), frozen=True, kw_only=True)
    kind.__doc__ = FitConfig.__doc__
    return kind(**{entry.name: getattr(config, entry.name) for entry in dataclasses.fields(config)})


def _presets_listed() -> str:
    """Return the presets, one per line, for the end of a help text."""
    names = [name for name in preset_names() if not name.startswith("no-")]
    ablations = [name for name in preset_names() if name.startswith("no-")]
    width = max(map(len, names)) + 2
    lines = [f"  {name:{width}}{preset_summary(name)}" for name in names]
    lines.append(f"  {'no-...':{width}}Ablations: {', '.join(ablations)}.")
    return "\n".join(["presets:", *lines])


def _run(argv: list[str]) -> None:
    if argv == ["--version"]:
        print(f"mgavatar {__version__}")
        return
    commands = dict(_COMMANDS)
    takes_presets = argv[:1] in (["fit"], ["demo"])
    wants_help = bool({"-h", "--help", "--help-all"} & set(argv))
    if takes_presets:
        short_help = wants_help and "--help-all" not in argv
        commands[argv[0]] = _with_default(commands[argv[0]], preset(_preset_of(argv)), short_help=short_help)
        argv = ["--help" if word == "--help-all" else word for word in argv]
    try:
        with _FLAGS:
            tyro.extras.subcommand_cli_from_dict(
                commands,
                prog="mgavatar",
                args=argv,
                description="Drivable Gaussian head avatars.",
                config=(tyro.conf.DisallowNone,),
            )
    except SystemExit as stop:
        if takes_presets and wants_help and stop.code == 0:
            print(_presets_listed())
            print("Every number of the method is a flag too: --help-all lists them.")
        raise


def main() -> None:
    """Run ``mgavatar`` with the arguments of the process."""
    # Threads that wait without spinning: on a busy machine spinning makes small parallel loops many times slower.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
    # Many code pages of Windows lack the help's bullets and letters of people's paths: a question mark will do.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("mgavatar: %(message)s"))
    logger = logging.getLogger("mgavatar")
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        _run(sys.argv[1:])
        if sys.stdout is not None:  # there is none under pythonw
            sys.stdout.flush()
    except DataError as error:
        _say(str(error))
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except BrokenPipeError:
        # Whoever read our output has left, as `head` does. Python flushes once more at exit: into nothing.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    finally:
        logger.removeHandler(handler)
