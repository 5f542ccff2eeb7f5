"""The command line: typed functions, one line for what the user can mend.

Exit codes: 0 done, 1 the data is wrong, 2 the command line is wrong, 130 interrupted. Heavy imports happen inside the
commands, so that ``--help`` is quick.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mgavatar import config as configs
from mgavatar.config import FitConfig
from mgavatar.errors import DataError

if TYPE_CHECKING:
    import torch

    from mgavatar.capture.subject import Subject

Device = Literal["auto", "cpu", "cuda"]


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _device(name: Device) -> torch.device:
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        raise DataError("--device cuda: this machine has no CUDA device that torch can use; give --device cpu")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")


def _check_seed(seed: int) -> None:
    if not 0 <= seed < 2**31:
        raise DataError(f"--seed {seed}: must lie between 0 and {2**31 - 1}")


def _checked_capture(data: Path, principal_point: Literal["center", "opencv", "opengl"]) -> Subject:
    """Read a capture and decode every image once: what is wrong with it is said before any work."""
    from mgavatar.capture.images import check_images
    from mgavatar.capture.read import read_capture

    subject = read_capture(data, principal_point=principal_point)
    check_images(subject)
    return subject


def demo(
    *,
    out: Path = Path("demo_out"),
    device: Device = "auto",
    seed: int = 0,
    preset: str = "quick",
    config: Annotated[FitConfig, tyro.conf.arg(name="")] = FitConfig(),  # noqa: B008  frozen
) -> None:
    """Make a synthetic capture, fit an avatar to it, drive it, score it and write a report.

    Args:
        out: New folder for everything.
        device: Where to compute.
        seed: Of the person and of the fit.
        preset: As in fit.
        config: As in fit.
    """
    from mgavatar.demo import run_demo

    _check_seed(seed)
    configs.check(config)
    _say_notes(_score_lines(run_demo(out, config, device=_device(device), seed=seed)))
    print(out / "run" / "report.html")


def synth(
    *,
    out: Path,
    cameras: int = 16,
    timesteps: int = 12,
    size: str = "256x256",
    seed: int = 0,
    monocular: bool = False,
    head_model: Path | None = None,
) -> None:
    """Ray-trace a synthetic capture with its ground truth.

    Args:
        out: New folder of the capture.
        cameras: Number of cameras.
        timesteps: Number of timesteps.
        size: Image size, WIDTHxHEIGHT.
        seed: Of the person and of the motion.
        monocular: One camera and a turning head, with two cameras at its sides to score novel views only.
        head_model: Head model to start from, the built-in one by default.
    """
    from mgavatar.progress import Reporter
    from mgavatar.synthetic.capture import make_synthetic_capture

    _check_seed(seed)

    with Reporter("synth", timesteps * (1 if monocular else cameras)) as reporter:
        make_synthetic_capture(
            out,
            cameras=cameras,
            timesteps=timesteps,
            size=_size(size),
            seed=seed,
            monocular=monocular,
            head=_head(head_model) if head_model else None,
            progress=lambda done, total: reporter.update(done, total=total),
        )


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and 16 <= int(width) <= 8192 and 16 <= int(height) <= 8192):
        raise DataError(f"--size {text}: give WIDTHxHEIGHT between 16 and 8192, for example 256x256")
    return int(width), int(height)


def _head(path: Path | None) -> Any:
    if path is None:
        from mgavatar.head.procedural.build import build_head

        return build_head()
    from mgavatar.head.load import load_head_model

    return load_head_model(path)


def fit(
    *,
    data: Path,
    out: Path,
    head_model: Path | None = None,
    preset: str = "quick",
    device: Device = "auto",
    seed: int = 0,
    resume: bool = False,
    budget: str | None = None,
    config: Annotated[FitConfig, tyro.conf.arg(name="")] = FitConfig(),  # noqa: B008  frozen
) -> None:
    """Fit an avatar to a tracked capture.

    Args:
        data: Capture in the layout of VHAP and GaussianAvatars, a folder with transforms_train.json.
        out: New folder for the avatar, its report and checkpoints; or the path of the avatar, ending in .pt.
        head_model: FLAME-schema .npz or FLAME .pkl that the capture was tracked with; the built-in head by default.
        preset: Name of a preset, or a .toml file; flags after it win.
        device: Where to compute.
        seed: Repeats a run bit for bit on one machine.
        resume: Go on with the fit in --out.
        budget: Time after which the avatar is written, counted from now, for example 90s, 5m or 1h; iterations, rates
            and density control are scaled to it. The score of a sample and the report come after.
        config: Every other number.
    """
    from mgavatar.fitting.budget import Budget, parse_budget

    limit = Budget(parse_budget(budget)) if budget is not None else None
    from mgavatar.fitting.fit import fit as run_fit
    from mgavatar.fitting.loop import Interrupted
    from mgavatar.fitting.run import open_run

    _check_seed(seed)
    configs.check(config)
    run = open_run(out, resume=resume)
    chosen = _device(device)
    head = _head(head_model)
    subject = _checked_capture(data, config.principal_point)
    _say_notes(_capture_notes(subject, head))
    try:
        avatar = run_fit(subject, head, config, run, device=chosen, seed=seed, resume=resume, budget=limit)
    except Interrupted as stop:
        _say(f"mgavatar: {stop}; {run.avatar} is usable, `--resume` goes on")
        raise SystemExit(130) from None
    from mgavatar.reporting.page import write_report
    from mgavatar.scoring.evaluate import evaluate_sample

    metrics = evaluate_sample(avatar, subject, avatar_path=run.avatar)
    report = write_report(run.folder, avatar, subject, metrics, history=run.metrics)
    _say_notes(_score_lines(metrics))
    print(run.avatar)
    print(report)


def _capture_notes(subject: Any, head: Any) -> list[str]:
    """What of the capture's parameters the head model cannot take."""
    import numpy as np

    notes = []
    for name, values, n in (("shape", subject.params.shape, head.n_shape), ("expr", subject.params.expr, head.n_expr)):
        if np.any(values[..., n:]):
            notes.append(
                f"{subject.root}: {name} has {values.shape[-1]} columns, {head.name} takes {n}: the rest is cut"
            )
    return notes


def _say_notes(notes: list[str]) -> None:
    for note in notes:
        _say(f"mgavatar: {note}")


def _score_lines(metrics: dict[str, Any]) -> list[str]:
    lines = []
    for split, score in metrics["splits"].items():
        naive = max(score["naive"].values()) if score.get("naive") else None
        beside = f" (best naive baseline {naive:.2f})" if naive is not None else ""
        lines.append(f"{split} ({score['task']}): PSNR {score['psnr']:.2f} dB{beside}, SSIM {score['ssim']:.4f}")
    if metrics["geometry"]:
        lines.append(f"geometry: mean {metrics['geometry']['mean_mm']:.2f} mm from the ground truth")
    return lines


def render(
    *,
    avatar: Path,
    driving: Path,
    out: Path,
    camera: str = "mean",
    head_motion: Literal["full", "neck", "none"] = "full",
    expression: Literal["auto", "use", "ignore"] = "auto",
    format: Literal["auto", "png", "exr", "mp4"] = "auto",
    size: str | None = None,
    device: Device = "auto",
) -> None:
    """Drive an avatar with a sequence of FLAME parameters.

    Args:
        avatar: avatar.pt, or the folder of its fit.
        driving: .npz with VHAP's keys, or a folder of one .npz a frame; missing keys are zero.
        out: FILE.mp4, FILE.gif, or a folder for single frames.
        camera: mean, train:ID, orbit, or a .json with the keys of a transforms frame.
        head_motion: The root's motion as driven (full), put into the neck (neck), or none.
        expression: Whether the driving file's expression fits this head: decide by its basis, use it or ignore it.
        format: Of single frames, or mp4; by default what --out says.
        size: Image size, WIDTHxHEIGHT, the camera's own by default.
        device: Where to compute.
    """
    from mgavatar.avatar import Avatar
    from mgavatar.driving.motion import read_driving
    from mgavatar.driving.render import render_driving
    from mgavatar.progress import Reporter

    motion = read_driving(driving)
    loaded = Avatar.load(_avatar_path(avatar), device=_device(device))
    with Reporter("render", len(motion.expr)) as reporter:
        notes = render_driving(
            loaded,
            motion,
            out=out,
            camera=camera,
            head_motion=head_motion,
            expression=expression,
            format=format,
            size=_size(size) if size else None,
            progress=lambda done, total: reporter.update(done),
        )
    _say_notes(notes)
    print(out)


def _avatar_path(path: Path) -> Path:
    return path / "avatar.pt" if path.is_dir() else path


def evaluate(
    *,
    avatar: Path,
    data: Path,
    split: Literal["val", "test", "all"] = "all",
    json: Path | None = None,
    lpips_weights: Path | None = None,
    principal_point: Literal["center", "opencv", "opengl"] | None = None,
    device: Device = "auto",
) -> None:
    """Score an avatar on the held-out frames of a capture, at full size.

    Args:
        avatar: avatar.pt, or the folder of its fit.
        data: The capture.
        split: Novel view (val), self-reenactment (test), or all.
        json: Also write the scores here.
        lpips_weights: State dict of LPIPS-VGG; nothing is ever downloaded.
        principal_point: As in fit, the avatar's own by default.
        device: Where to compute.
    """
    from mgavatar.avatar import Avatar
    from mgavatar.progress import Reporter
    from mgavatar.scoring.evaluate import evaluate as run_evaluate
    from mgavatar.scoring.evaluate import write_metrics

    path = _avatar_path(avatar)
    loaded = Avatar.load(path, device=_device(device))
    subject = _checked_capture(data, principal_point or loaded.config.principal_point)
    splits: tuple[Literal["val", "test"], ...] = ("val", "test") if split == "all" else (split,)
    with Reporter("evaluate", sum(len(subject.frames[name]) for name in splits)) as reporter:
        metrics = run_evaluate(
            loaded,
            subject,
            avatar_path=path,
            splits=splits,
            lpips_weights=lpips_weights,
            progress=lambda done, total: reporter.update(done),
        )
    _say_notes(_score_lines(metrics))
    if json is not None:
        write_metrics(json, metrics)
    else:
        print(_as_json(metrics))


def _as_json(metrics: dict[str, Any]) -> str:
    return json.dumps(metrics, indent=2)


def bench_kernels(
    *,
    threads: int | None = None,
    json: Path | None = None,
    device: Device = "cpu",
    avatar: Path | None = None,
) -> None:
    """Time every kernel against its plain form and against this machine's lower bound.

    Args:
        threads: CPU threads of the kernels, all cores by default.
        json: Also write the rows to this file.
        device: Where to compute.
        avatar: avatar.pt, or the folder of its fit, to time beside the synthetic scenes.
    """
    from mgavatar.benchmarks.kernels import bench_kernels as run_benchmark

    chosen = _avatar_path(avatar) if avatar else None
    print(run_benchmark(threads=threads, json_path=json, device=_device(device).type, avatar=chosen))


# Each benchmark is a sub-command with flags of its own. tyro runs it while it builds the argument of `bench`.
Kernels = Annotated[None, tyro.conf.subcommand(name="kernels", prefix_name=False, constructor=bench_kernels)]


def bench(benchmark: Annotated[Kernels | Annotated[None, tyro.conf.Suppress], tyro.conf.arg(name="")]) -> None:
    """Benchmark this machine."""


_COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "synth": synth,
    "fit": fit,
    "render": render,
    "evaluate": evaluate,
    "bench": bench,
}


_FLAGS = tyro.constructors.ConstructorRegistry()


@_FLAGS.primitive_rule
def _switch_or_auto(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """``--key true``, ``false`` or ``auto``: the words that a TOML file uses."""
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


def _with_preset(argv: list[str]) -> list[str]:
    """Put a preset's values before the user's flags: one parser checks both, and the user's win."""
    if argv[:1] not in (["fit"], ["demo"]) or "--help" in argv or "-h" in argv:
        return argv
    preset = "quick"
    for index, word in enumerate(argv):
        if word == "--preset" and index + 1 < len(argv):
            preset = argv[index + 1]
        elif word.startswith("--preset="):
            preset = word.partition("=")[2]
    return [argv[0], *configs.preset_flags(configs.read_preset(preset)), *argv[1:]]


def main() -> None:
    """Entry point of ``mgavatar``."""
    # Threads that wait without spinning: on a busy machine spinning makes small parallel loops many times slower.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
    logging.basicConfig(format="mgavatar: %(message)s")
    logging.getLogger("mgavatar").setLevel(logging.INFO)
    try:
        with _FLAGS:
            tyro.extras.subcommand_cli_from_dict(
                _COMMANDS,
                prog="mgavatar",
                args=_with_preset(sys.argv[1:]),
                description="Drivable Gaussian head avatars.",
            )
    except DataError as error:
        _say(f"mgavatar: {error}")
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
