"""The command line: what it says, what it exits with, and that it writes nothing when the data is wrong."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tiny import tiny_config, tiny_head, write_tiny_capture

from mgavatar import __version__, cli
from mgavatar.avatar import Avatar
from mgavatar.capture.read import read_capture
from mgavatar.config import keys
from mgavatar.geometry.stage import GeometryStage
from mgavatar.head.load import save_head_model
from mgavatar.pipeline import fit
from mgavatar.presets import preset as preset_of
from mgavatar.presets import preset_names, to_toml

CHILD_ENV = {**os.environ, "GOMP_SPINCOUNT": "0", "OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """A capture, the head it was tracked with, a preset that takes a second, and a driving sequence."""
    root = tmp_path_factory.mktemp("inputs")
    write_tiny_capture(root / "capture")
    save_head_model(root / "head.npz", tiny_head())
    (root / "tiny.toml").write_text(to_toml(tiny_config()))
    np.savez(root / "driving.npz", neck_pose=np.linspace([0.0, -0.2, 0.0], [0.0, 0.2, 0.0], 3, dtype=np.float32))
    return root


@pytest.fixture
def work(inputs, tmp_path) -> Path:
    """A copy of the inputs to spoil."""
    return Path(shutil.copytree(inputs, tmp_path / "work"))


class Result:
    """What a command left."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


@pytest.fixture(scope="module")
def fitted(inputs) -> Path:
    """The avatar of a fit to the inputs."""
    preset, head, subject = preset_of(str(inputs / "tiny.toml")), tiny_head(), read_capture(inputs / "capture")
    return fit(subject, head, preset, out=inputs / "fitted").path


@pytest.fixture
def mgavatar(monkeypatch, capfd) -> Callable[..., Result]:
    """Run a command in this process."""

    def run(*argv: object) -> Result:
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["mgavatar", *map(str, argv)])
        code = 0
        try:
            cli.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        said = capfd.readouterr()
        return Result(code, said.out, said.err)

    return run


def fit_args(work: Path, *more: object) -> list[object]:
    """``fit`` on the inputs."""
    preset = ["--preset", work / "tiny.toml", "--head-model", work / "head.npz", "--device", "cpu"]
    return ["fit", "--data", work / "capture", "--out", work / "run", *preset, *more]


def tree(root: Path) -> dict[str, bytes]:
    """All files with their content, and all folders."""
    return {str(path): path.read_bytes() if path.is_file() else b"" for path in sorted(root.rglob("*"))}


def assert_one_line(result: Result, *words: str) -> None:
    """Exit 1 and a single line on stderr that holds the words; nothing on stdout."""
    assert result.code == 1
    assert result.out == ""
    assert result.err.startswith("mgavatar: ")
    assert result.err.endswith("\n")
    assert result.err.count("\n") == 1, result.err
    for word in words:
        assert word in result.err


def edit_json(path: Path, change: Callable[[dict[str, Any]], None], *, frame: int = 0) -> None:
    """Change one frame of a transforms file."""
    meta = json.loads(path.read_text())
    change(meta["frames"][frame])
    path.write_text(json.dumps(meta))


def edit_npz(path: Path, **changes: np.ndarray | None) -> None:
    """Replace arrays of a .npz, or remove those that are None."""
    arrays = {**np.load(path), **changes}
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})


def no_folder(work: Path) -> None:
    shutil.rmtree(work / "capture")


def no_transforms(work: Path) -> None:
    (work / "capture/transforms_train.json").unlink()


def truncated_png(work: Path) -> None:
    path = work / "capture/images/00001_01.png"
    path.write_bytes(path.read_bytes()[:-60])


def another_size(work: Path) -> None:
    path = work / "capture/images/00000_01.png"
    Image.new("RGB", (20, 30)).save(path)


def frame_without_parameters(work: Path) -> None:
    edit_json(work / "capture/transforms_train.json", lambda frame: frame.pop("flame_param_path"), frame=2)


def parameter_file_is_gone(work: Path) -> None:
    (work / "capture/flame_param/00002.npz").unlink()


def nan_in_a_camera(work: Path) -> None:
    def change(frame: dict[str, Any]) -> None:
        frame["transform_matrix"][1][3] = float("nan")

    edit_json(work / "capture/transforms_train.json", change, frame=1)


def nan_in_a_focal_length(work: Path) -> None:
    edit_json(work / "capture/transforms_val.json", lambda frame: frame.update(fl_x=float("nan")))


def expression_of_another_length(work: Path) -> None:
    edit_npz(work / "capture/flame_param/00001.npz", expr=np.zeros((1, 7), np.float32))


def head_without_uvs(work: Path) -> None:
    edit_npz(work / "head.npz", vt=None, ft=None)


def full_folder(work: Path) -> None:
    (work / "run").mkdir()
    (work / "run/notes.txt").write_text("mine")


SPOILED: dict[Callable[[Path], None], tuple[str, ...]] = {
    no_folder: ("capture", "no such folder"),
    no_transforms: ("capture", "transforms_train.json", "VHAP"),
    truncated_png: ("00001_01.png", "not a readable image"),
    another_size: ("00000_01.png", "20x30", "40x40", "scale the images"),
    frame_without_parameters: ("transforms_train.json", "00001_00.png", "flame_param_path", "export"),
    parameter_file_is_gone: ("transforms_train.json", "00002.npz", "does not exist"),
    nan_in_a_camera: ("transforms_train.json", "00000_01.png", "NaN", "remove the frame"),
    nan_in_a_focal_length: ("transforms_val.json", "fl_x", "finite"),
    expression_of_another_length: ("00001.npz", "expr", "7", "3"),
    head_without_uvs: ("head.npz", "vt"),
    full_folder: ("run", "not an empty folder", "--resume"),
}


@pytest.mark.parametrize("spoil", SPOILED, ids=lambda spoil: spoil.__name__)
def test_wrong_data_gives_one_line_and_writes_nothing(spoil, work, mgavatar):
    """The line names the file and what to do; the exit code is 1."""
    spoil(work)
    before = tree(work)
    assert_one_line(mgavatar(*fit_args(work)), *SPOILED[spoil])
    assert tree(work) == before


def test_cuda_without_a_device(work, mgavatar, monkeypatch):
    """Said before any work."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    before = tree(work)
    assert_one_line(mgavatar(*fit_args(work), "--device", "cuda"), "--device cuda", "--device cpu")
    assert tree(work) == before


@pytest.mark.parametrize("content", [b"", b"no avatar", b"PK\x03\x04 neither"])
@pytest.mark.parametrize("command", ["render", "evaluate"])
def test_an_avatar_that_is_not_one(command, content, work, mgavatar):
    """Both commands that take one."""
    (work / "avatar.pt").write_bytes(content)
    more = {
        "render": ["--driving", work / "driving.npz", "--out", work / "frames"],
        "evaluate": ["--data", work / "capture", "--json", work / "metrics.json"],
    }
    before = tree(work)
    result = mgavatar(command, "--avatar", work / "avatar.pt", "--device", "cpu", *more[command])
    assert_one_line(result, str(work / "avatar.pt"), "not an MGAvatar avatar", "mgavatar fit")
    assert tree(work) == before


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--preset", "nothing"], ("nothing", "quick", "paper")),
        (["--geometry.subdivisions", "9"], ("--geometry.subdivisions 9", "between 0 and 3")),
        (["--device", "tpu"], ("--device tpu", "auto, cpu, cuda")),
        (["--resume"], ("checkpoint.pt", "nothing to resume")),
        (["--head-model", "absent.npz"], ("absent.npz", "no such file")),
        (["--head-model", "head.obj"], ("head.obj", ".npz")),
    ],
)
def test_wrong_options_that_only_the_program_can_know(argv, words, work, mgavatar):
    """A number out of range or a name that is not there is one line as well."""
    before = tree(work)
    assert_one_line(mgavatar(*fit_args(work), *argv), *words)
    assert tree(work) == before


@pytest.mark.parametrize(
    ("command", "flag"),
    [
        ("fit", "--out"),
        ("render", "--out"),
        ("evaluate", "--json"),
        ("synth", "--out"),
        ("demo", "--out"),
        ("bench", "--json"),
    ],
)
def test_a_place_that_cannot_be_written_to_is_named_before_any_work(command, flag, work, mgavatar):
    """What the command would read is missing, and yet the first thing said is that its results have no place."""
    (work / "file").write_text("mine")
    shutil.rmtree(work / "capture")
    inputs = {
        "fit": ["--data", work / "capture"],
        "render": ["--driving", work / "none.npz", "--avatar", work / "none.pt"],
        "evaluate": ["--data", work / "capture", "--avatar", work / "none.pt"],
        "bench": ["kernels"],
    }
    before = tree(work)
    result = mgavatar(command, *inputs.get(command, []), flag, work / "file/result")
    assert_one_line(result, str(work / "file/result"), "file")
    assert tree(work) == before


def test_a_demo_overwrites_nothing(work, mgavatar):
    """Its folder is a new one."""
    full_folder(work)
    before = tree(work)
    assert_one_line(mgavatar("demo", "--out", work / "run", "--device", "cpu"), "run", "give --out another name")
    assert tree(work) == before


@pytest.mark.parametrize("size", ["x", "20", "0x40", "20x-3", "99999x99999", "20xx20"])
def test_a_size_that_is_none(size, work, mgavatar):
    """WIDTHxHEIGHT, nothing else."""
    result = mgavatar("synth", "--out", work / "new", "--size", size)
    assert_one_line(result, f"--size {size}", "WIDTHxHEIGHT")
    assert not (work / "new").exists()


@pytest.mark.parametrize(
    "argv",
    [
        ["fit", "--data", "x", "--out", "y", "--geomtry.iterations", "3"],
        ["fit"],
        ["fit", "--data", "x", "--out", "y", "--geometry.iterations", "many"],
        ["fitt"],
        [],
    ],
    ids=["unknown flag", "missing flag", "word for a number", "unknown command", "no command"],
)
def test_a_wrong_command_line_exits_with_2(argv, mgavatar):
    """The parser's own business."""
    result = mgavatar(*argv)
    assert result.code == 2
    assert result.err


def test_a_misspelt_flag_gets_a_suggestion(mgavatar):
    """The nearest flag is named."""
    result = mgavatar("fit", "--data", "x", "--out", "y", "--geometry.iteration", "3")
    assert result.code == 2
    assert "--geometry.iterations" in result.err


def test_help_imports_neither_torch_nor_warp():
    """So that it is quick; for the program and for its largest command."""
    code = """
        import sys
        from mgavatar import __version__, cli
        for argv in (["--help"], ["fit", "--help"], ["fit", "--help-all"]):
            sys.argv = ["mgavatar", *argv]
            try:
                cli.main()
            except SystemExit as stop:
                assert stop.code == 0, stop.code
        heavy = {"torch", "warp", "kornia", "trimesh", "scipy", "PIL"} & set(sys.modules)
        assert not heavy, heavy
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, env=CHILD_ENV)
    assert done.returncode == 0, done.stderr
    for word in ("demo", "synth", "render", "evaluate", "--geometry.lambda-laplacian", "--resume"):
        assert word in done.stdout


def test_output_that_a_code_page_lacks_letters_for():
    """Help and paths come through on a console or into a file that cannot show all of Unicode, as on Windows."""
    for argv, code in ((["--help"], 0), (["fit", "--data", "тест•"], 1)):
        command = [sys.executable, "-c", "from mgavatar.cli import main; main()", *argv]
        done = subprocess.run(command, capture_output=True, env={**CHILD_ENV, "PYTHONIOENCODING": "cp850"})
        assert done.returncode == code, done.stderr.decode("cp850")
        assert b"?" in done.stdout + done.stderr


def test_a_process_of_its_own_says_one_line_too(work):
    """Nothing else on stderr: no banner of Warp's, no warning, no traceback."""
    truncated_png(work)
    command = [sys.executable, "-c", "from mgavatar.cli import main; main()", *map(str, fit_args(work))]
    done = subprocess.run(command, capture_output=True, text=True, env=CHILD_ENV)
    assert_one_line(Result(done.returncode, done.stdout, done.stderr), "00001_01.png")
    assert not (work / "run").exists()


def test_ctrl_c_exits_with_130_and_says_how_to_go_on(work, mgavatar, monkeypatch):
    """The avatar is there, `--resume` finishes it, and the end is a report."""
    step = GeometryStage.step
    steps = []

    def stepped(self: GeometryStage, *args: Any) -> Any:
        steps.append(1)
        if len(steps) == 5:
            signal.raise_signal(signal.SIGINT)
        return step(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(GeometryStage, "step", stepped)
        result = mgavatar(*fit_args(work))
    assert result.code == 130
    last = result.err.splitlines()[-1]
    assert last.startswith("mgavatar: stopped in geometry at 5/12")
    assert "--resume" in last
    assert Avatar.load(work / "run/avatar.pt").appearance is None
    result = mgavatar(*fit_args(work, "--resume"))
    assert result.code == 0, result.err
    assert Avatar.load(work / "run/avatar.pt").appearance is not None
    assert (work / "run/report.html").is_file()


def test_ctrl_c_before_the_fit_exits_with_130(work, mgavatar, monkeypatch):
    """Also while the capture is being read; nothing is written and no traceback shown."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mgavatar.capture.read.read_capture", interrupted)
    result = mgavatar(*fit_args(work))
    assert result.code == 130
    assert "Traceback" not in result.err
    assert not (work / "run").exists()


def test_the_whole_way(work, mgavatar):
    """Fit, evaluate and render, each with what it promises on stdout and on disk."""
    result = mgavatar(*fit_args(work, "--seed", "3"))
    assert result.code == 0, result.err
    assert result.out.split() == [str(work / "run/avatar.pt"), str(work / "run/report.html")]
    assert all(Path(path).stat().st_size > 1000 for path in result.out.split())
    assert "PSNR" in result.err

    result = mgavatar("evaluate", "--avatar", work / "run", "--data", work / "capture", "--device", "cpu",
                      "--json", work / "metrics.json")  # fmt: skip
    assert result.code == 0, result.err
    assert result.out == ""
    metrics = json.loads((work / "metrics.json").read_text())
    assert metrics["splits"].keys() == {"val", "test"}
    assert metrics["splits"]["val"]["frames"] == 3
    assert metrics["splits"]["val"]["psnr"] > 10.0

    result = mgavatar("evaluate", "--avatar", work / "run/avatar.pt", "--data", work / "capture", "--split", "test")
    assert result.code == 0, result.err
    assert json.loads(result.out)["splits"].keys() == {"test"}

    result = mgavatar("render", "--avatar", work / "run", "--driving", work / "driving.npz", "--out", work / "frames",
                      "--size", "24x32")  # fmt: skip
    assert result.code == 0, result.err
    assert result.out.strip() == str(work / "frames")
    frames = sorted((work / "frames").glob("*.png"))
    assert len(frames) == 3
    with Image.open(frames[0]) as image:
        assert image.size == (24, 32)
    assert frames[0].read_bytes() != frames[2].read_bytes()


def test_a_capture_with_more_coefficients_than_the_head_is_said(work, mgavatar):
    """What is cut is not cut in silence."""
    for path in (work / "capture/flame_param").glob("*.npz"):
        edit_npz(path, expr=np.full((1, 5), 0.1, np.float32))
    result = mgavatar(*fit_args(work))
    assert result.code == 0, result.err
    assert "expr has 5 columns" in result.err
    assert "takes 3" in result.err


def test_the_two_commands_of_the_readme(work, mgavatar, monkeypatch):
    """``fit --data`` and ``render --avatar --driving`` alone write into the working folder and say where."""
    shutil.copy(work / "head.npz", work / "capture/head_model.npz")
    (work / "here").mkdir()
    monkeypatch.chdir(work / "here")
    result = mgavatar("fit", "--data", "../capture", "--preset", "../tiny.toml")
    assert result.code == 0, result.err
    assert result.out.split() == ["out.pt", "out/report.html"]
    result = mgavatar("render", "--avatar", "out.pt", "--driving", "../driving.npz")
    assert result.code == 0, result.err
    assert result.out.split() == ["driving.mp4"]
    assert {path.name for path in Path.cwd().iterdir()} == {"out.pt", "out", "driving.mp4"}
    assert Path("driving.mp4").read_bytes()[4:8] == b"ftyp"

    # Nothing that is there is lost by giving the same commands again.
    before = tree(work)
    assert_one_line(mgavatar("fit", "--data", "../capture", "--preset", "../tiny.toml"), "out", "--out", "--resume")
    assert_one_line(
        mgavatar("render", "--avatar", "out.pt", "--driving", "../driving.npz"), "driving.mp4", "--overwrite"
    )
    assert tree(work) == before
    result = mgavatar("render", "--avatar", "out.pt", "--driving", "../driving.npz", "--overwrite", "--frames", "0:1")
    assert result.code == 0, result.err


def test_a_rendering_without_pyav_is_a_gif(work, fitted, mgavatar, monkeypatch):
    """The default name goes by what can be written; asking for a video says what to install."""
    monkeypatch.chdir(work)
    monkeypatch.setattr("mgavatar.driving.writers.importlib.util.find_spec", lambda name: None)
    result = mgavatar("render", "--avatar", fitted, "--driving", "driving.npz")
    assert (result.code, result.out.strip()) == (0, "driving.gif"), result.err
    assert_one_line(
        mgavatar("render", "--avatar", fitted, "--driving", "driving.npz", "--format", "mp4"), "pip install", "PyAV"
    )


def test_the_head_model_of_a_bare_fit_is_found_or_asked_for(work, mgavatar, monkeypatch):
    """Beside the transforms, else in the environment, else one line; never the built-in head in silence."""
    monkeypatch.delenv("MGAVATAR_HEAD_MODEL", raising=False)
    bare = ["fit", "--data", work / "capture", "--out", work / "run", "--preset", work / "tiny.toml"]
    assert_one_line(mgavatar(*bare), "capture", "--head-model", "MGAVATAR_HEAD_MODEL", "builtin")
    assert not (work / "run").exists()
    monkeypatch.setenv("MGAVATAR_HEAD_MODEL", str(work / "head.npz"))
    result = mgavatar(*bare)
    assert result.code == 0, result.err
    assert Avatar.load(work / "run").head_model.n_expr == tiny_head().n_expr


@pytest.mark.parametrize(("frames", "n"), [("0:2", 2), ("1:", 2), (":1", 1), ("0:3:2", 2), ("::2", 2), ("0:99", 3)])
def test_frames_of_a_motion(frames, n, work, fitted, mgavatar):
    """A slice, as in Python; beyond the end it ends."""
    result = mgavatar("render", "--avatar", fitted, "--driving", work / "driving.npz", "--frames", frames,
                      "--out", work / "frames")  # fmt: skip
    assert result.code == 0, result.err
    assert len(list((work / "frames").glob("*.png"))) == n


@pytest.mark.parametrize("frames", ["3", "a:b", "1:2:0", "-1:2", "1:2:3:4", "1.5:2"])
def test_frames_that_are_none(frames, work, mgavatar):
    """One line with an example, before anything is read."""
    result = mgavatar("render", "--avatar", work / "absent", "--driving", work / "driving.npz", f"--frames={frames}")
    assert_one_line(result, f"--frames {frames}", "START:STOP")


@pytest.mark.parametrize("fps", ["0", "-5", "nan", "100000"])
def test_frame_rates_that_are_none(fps, work, mgavatar):
    """One line."""
    result = mgavatar("render", "--avatar", work / "x", "--driving", work / "driving.npz", f"--fps={fps}")
    assert_one_line(result, "--fps", "between 0 and 1000")


def test_a_capture_on_black_can_be_said(work, mgavatar):
    """``--background`` reaches the reader and the avatar; without it a warning names it."""
    for path in (work / "capture/images").glob("*.png"):
        pixels = np.asarray(Image.open(path)).copy()
        pixels[np.asarray(Image.open(work / "capture/fg_masks" / path.name)) == 0] = 0
        Image.fromarray(pixels).save(path)
    result = mgavatar(*fit_args(work, "--background", "black"))
    assert result.code == 0, result.err
    assert "not on the stated background" not in result.err
    assert Avatar.load(work / "run").capture.background.tolist() == [0.0, 0.0, 0.0]
    result = mgavatar("evaluate", "--avatar", work / "run", "--data", work / "capture", "--json", work / "m.json")
    assert "not on the stated background" not in result.err
    shutil.rmtree(work / "run")
    assert "--background black" in mgavatar(*fit_args(work)).err


def test_the_version_and_the_module():
    """``--version`` is one line; ``python -m mgavatar`` is the same program."""
    command = [sys.executable, "-m", "mgavatar", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, env=CHILD_ENV)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"mgavatar {__version__}\n", "")


@pytest.mark.parametrize("argv", ["fit --help-all", "fit --help", "--help", "--version"])
def test_a_reader_who_leaves_is_no_error(argv):
    """``mgavatar fit --help | head -1`` ends without a traceback, however much was still to be written."""
    code = "import sys; from mgavatar.cli import main; main()"
    command = f"{sys.executable} -c '{code}' {argv} | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=CHILD_ENV)
    assert done.stderr == ""


def test_help_shows_what_will_run(mgavatar):
    """Defaults are those of the preset that is named; the paper's are shown for the paper's."""
    for preset_name, iterations in (("quick", 700), ("paper", 100_000)):
        said = mgavatar("fit", "--help-all", "--preset", preset_name).out
        entry = said[said.index("--geometry.iterations") :].split("--geometry.max-image-size")[0]
        assert f"(default: {iterations})" in " ".join(entry.replace("│", " ").split())


def test_help_fits_a_screen_and_help_all_has_the_rest(mgavatar):
    """What people set, with the presets, in 50 lines of plain text; every key of the configuration in the other."""
    short, whole = mgavatar("fit", "--help").out, mgavatar("fit", "--help-all").out
    assert len(short.splitlines()) <= 50
    assert "--geometry" not in short
    assert all(name in short for name in preset_names())
    assert "--help-all" in short
    for key, _ in keys():
        *sections, name = key.replace("_", "-").split(".")
        flags = (".".join([*sections, name]), ".".join([*sections, f"no-{name}"]))
        assert any(f"--{flag}" in whole for flag in flags), key
    for text in (
        short,
        whole,
        *(mgavatar(command, "--help").out for command in ("render", "evaluate", "synth", "demo")),
    ):
        assert "``" not in text
        assert ":class:" not in text
        assert "[bold" not in text
