"""Writing files: whole or absent, and one line that names the path where the system refuses."""

from __future__ import annotations

import ast
import contextlib
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from ball_head import ball_head
from PIL import Image
from tiny import tiny_resolved
from tiny_avatar import tiny_avatar

import mgavatar
from mgavatar import files
from mgavatar.avatar import Avatar
from mgavatar.capture.read import read_capture
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig
from mgavatar.demo import run_demo
from mgavatar.driving.writers import frame_writer, kind_of
from mgavatar.errors import DataError
from mgavatar.files import (
    append_line,
    atomic_write,
    check_writable,
    existing_file,
    existing_folder,
    make_folder,
    read_json,
    require_new_folder,
    write_json,
    write_text,
    writing,
)
from mgavatar.fitting.run import open_checkpoint, open_run
from mgavatar.fitting.summary import Summary
from mgavatar.head.load import save_head_model
from mgavatar.progress import MetricsLog
from mgavatar.reporting.page import write_report
from mgavatar.scoring.evaluate import write_metrics
from mgavatar.synthetic.capture import make_synthetic_capture

resource = pytest.importorskip("resource", reason="Windows has no limit on the size of files")

PACKAGE = Path(mgavatar.__file__).parent
NOISE = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)


@contextlib.contextmanager
def full_disk(room: int = 20) -> Iterator[None]:
    """Let no file grow beyond ``room`` bytes, as under a quota: writes fail in the middle."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Avatar, Subject]:
    """An avatar and its capture. Only to be read."""
    return tiny_avatar(tmp_path_factory.mktemp("fitted"))


def everything_below(folder: Path) -> dict[str, bytes | None]:
    """Return all paths below a folder with the contents of the files."""
    return {str(path): path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


def refusal(action: Callable[[], object], *parts: object) -> None:
    """``action`` raises a ``DataError`` of one line that has all the parts."""
    with pytest.raises(DataError) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert str(part) in message, message


def save_tensors(path: Path) -> None:
    """torch's zip writer reports a full disk as RuntimeError once it has begun."""
    with atomic_write(path) as file:
        torch.save({"a": torch.zeros(4000), "b": torch.zeros(4000)}, file)


def save_arrays(path: Path) -> None:
    with atomic_write(path) as file:
        np.savez(file, a=NOISE)


def save_picture(path: Path) -> None:
    with atomic_write(path) as file:
        Image.fromarray(NOISE).save(file, format="PNG")


def write_frames(path: Path, kind: str, fitted: tuple[Avatar, Subject]) -> None:
    avatar, subject = fitted
    camera = avatar.capture.mean_camera().scaled(64, 64)
    rendering = avatar.render(subject.params.pose(0, n_expr=avatar.head_model.n_expr), camera)
    with frame_writer(path, kind, fps=25.0) as add:
        for _ in range(3):
            add(rendering, camera)


def start_run(folder: Path) -> None:
    open_checkpoint(open_run(folder, resume=False), tiny_resolved(), 0, None, resume=False)


WRITERS: dict[str, Callable[[Path, tuple[Avatar, Subject]], object]] = {
    "text": lambda path, _: write_text(path, "many words " * 100),
    "json": lambda path, _: write_json(path, {"a": [1.5] * 100}),
    "line": lambda path, _: append_line(path, "many words " * 100),
    "metrics log": lambda path, _: MetricsLog(path).write(loss=0.5, stage="geometry", iteration=20),
    "torch.save": lambda path, _: save_tensors(path),
    "numpy.savez": lambda path, _: save_arrays(path),
    "picture": lambda path, _: save_picture(path),
    "head model": lambda path, _: save_head_model(path, ball_head()),
    "avatar": lambda path, fitted: fitted[0].save(path),
    "metrics": lambda path, _: write_metrics(path, {"splits": {"val": 30.0}, "geometry": None}),
    "summary": lambda path, _: Summary().write(path, seed=0),
    "mp4": lambda path, fitted: write_frames(path, "mp4", fitted),
    "gif": lambda path, fitted: write_frames(path, "gif", fitted),
}
"""Every public function that writes a file."""

FOLDER_WRITERS: dict[str, Callable[[Path, tuple[Avatar, Subject]], object]] = {
    "png": lambda path, fitted: write_frames(path, "png", fitted),
    "exr": lambda path, fitted: write_frames(path, "exr", fitted),
    "capture": lambda path, _: make_synthetic_capture(path, cameras=2, timesteps=2, size=(16, 16), head=ball_head()),
    "run": lambda path, _: start_run(path),
    "demo": lambda path, _: run_demo(path, FitConfig(), device="cpu", seed=0),
    "report": lambda path, fitted: write_report(path, *fitted, None, history=Path("none")),
    "folder": lambda path, _: make_folder(path),
}
"""Every public function that makes a folder."""


@pytest.mark.parametrize("name", WRITERS | FOLDER_WRITERS)
def test_below_a_file(tmp_path, fitted, name):
    """Where a parent is a file: one line with the path, and nothing changes on the disk."""
    (tmp_path / "file").write_text("mine")
    before = everything_below(tmp_path)
    target = tmp_path / "file/result"
    refusal(lambda: (WRITERS | FOLDER_WRITERS)[name](target, fitted), target, "file")
    assert everything_below(tmp_path) == before


@pytest.mark.parametrize("name", [*WRITERS, "png", "exr"])
def test_full_disk(tmp_path, fitted, name):
    """Where a write fails in the middle: one line with the path, no half file, nothing temporary."""
    target = tmp_path / "result"

    def write() -> None:
        with full_disk():
            (WRITERS | FOLDER_WRITERS)[name](target, fitted)

    refusal(write, target, "cannot be written", "File too large")
    assert [path for path, content in everything_below(tmp_path).items() if content != b""] == []


@pytest.mark.parametrize("name", ["capture", "run", "demo", "report"])
def test_full_disk_in_a_folder(tmp_path, fitted, name):
    """Folders of several files: one line; what was whole before stays, what failed is not there."""
    target = tmp_path / "result"

    def write() -> None:
        with full_disk():
            FOLDER_WRITERS[name](target, fitted)

    refusal(write, target, "cannot be written", "File too large")
    assert [path for path, content in everything_below(tmp_path).items() if content is not None] == []


def test_a_whole_file_survives_a_failed_write(tmp_path):
    """The file that is replaced stays until its successor is whole; a log keeps its lines."""
    path = tmp_path / "result"
    for write in (lambda: write_text(path, "x" * 100), lambda: append_line(path, "x" * 100)):
        path.write_text("a line\n")
        with full_disk():
            refusal(write, path, "File too large")
        assert everything_below(tmp_path) == {str(path): b"a line\n"}


def test_a_mistake_of_the_program_is_no_refusal_of_the_disk(tmp_path):
    """Any other exception inside the block keeps its type, and leaves nothing behind."""

    def divide() -> None:
        with atomic_write(tmp_path / "result") as file:
            file.write(b"half")
            _ = 1 / 0

    with pytest.raises(ZeroDivisionError):
        divide()
    with pytest.raises(RuntimeError, match="no such attribute"), writing(tmp_path):
        raise RuntimeError("no such attribute")
    assert everything_below(tmp_path) == {}


@pytest.mark.skipif(not os.path.exists("/dev/null"), reason="no devices in the file system")
@pytest.mark.parametrize("write", [write_text, save_tensors, check_writable], ids=lambda f: f.__name__)
def test_a_device_is_never_replaced(tmp_path, write):
    """A file would take the place of ``/dev/null`` where the user may do so; a named pipe is safe to try it on."""
    os.mkfifo(tmp_path / "pipe")
    arguments = ("text",) if write is write_text else ()
    refusal(lambda: write(tmp_path / "pipe", *arguments), "pipe: is not a regular file")
    assert (tmp_path / "pipe").is_fifo()


def test_written_text_is_what_was_given(tmp_path):
    """UTF-8, with the line ends of the text, on every system."""
    write_text(tmp_path / "text", "Größe\n\r\n")
    assert (tmp_path / "text").read_bytes() == "Größe\n\r\n".encode()
    write_json(tmp_path / "json", {"b": [1, None]})
    assert json.loads((tmp_path / "json").read_text()) == {"b": [1, None]}
    for line in ("one", "zwölf"):
        append_line(tmp_path / "lines", line)
    assert (tmp_path / "lines").read_bytes() == "one\nzwölf\n".encode()


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_place_that_can_be_written_to(tmp_path, kind):
    """A probe leaves nothing; what is there already may be replaced."""
    (tmp_path / "there").write_text("old") if kind == "file" else (tmp_path / "there").mkdir()
    before = everything_below(tmp_path)
    for name in ("new", "there"):
        check_writable(tmp_path / name, kind=kind)
    check_writable(Path(os.path.relpath(tmp_path / "new")), kind=kind)
    if kind == "folder":
        check_writable(tmp_path / "several/new/ones", kind="folder")
    assert everything_below(tmp_path) == before


@pytest.mark.parametrize(
    ("path", "kind", "words"),
    [
        ("file/x", "file", "is a file, but a folder is needed there"),
        ("file/x", "folder", "is a file, but a folder is needed there"),
        ("file", "folder", "is a file, but a folder is needed there"),
        ("folder", "file", "is a folder, the name of a file is needed"),
        ("missing/x", "file", "the folder {}/missing does not exist; make it first"),
        ("n" * 300, "file", "give a shorter path"),
        ("n" * 300 + "/x", "folder", "give a shorter path"),
    ],
)
def test_a_place_that_cannot_be_written_to(tmp_path, path, kind, words):
    """Each kind of obstacle is named with what to do about it."""
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    before = everything_below(tmp_path)
    refusal(lambda: check_writable(tmp_path / path, kind=kind), tmp_path / path, words.format(tmp_path))
    assert everything_below(tmp_path) == before


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_place_without_room_or_permission(tmp_path, kind, monkeypatch):
    """A full disk is found by writing to it, and so is a folder that is not the user's."""
    with full_disk():
        refusal(lambda: check_writable(tmp_path / "new", kind=kind), tmp_path / "new", "free some space")

    def refused(**_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files.tempfile, "TemporaryFile", refused)
    refusal(lambda: check_writable(tmp_path / "new", kind=kind), "Permission denied; give a path that you may write to")


def test_a_new_folder(tmp_path):
    """New or empty; anything else is kept, with one wording and the flag that helps."""
    require_new_folder(tmp_path / "new")
    require_new_folder(tmp_path)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    words = "already exists and is not an empty folder; give --to another name, or --resume"
    for path in (tmp_path, tmp_path / "file", tmp_path / "link"):
        refusal(lambda path=path: require_new_folder(path, flag="--to", or_else=", or --resume"), f"{path}: {words}")


@pytest.mark.parametrize("name", ["capture", "run", "demo", "png", "exr"])
def test_every_new_folder_has_the_same_wording(tmp_path, fitted, name):
    """Whatever makes a folder refuses one with something in it in the same words, and leaves it alone."""
    (tmp_path / "result").mkdir()
    (tmp_path / "result/mine").write_text("mine")
    before = everything_below(tmp_path)
    action = {"png": lambda: kind_of(tmp_path / "result", "png"), "exr": lambda: kind_of(tmp_path / "result", "exr")}
    words = "already exists and is not an empty folder; give --out another name"
    refusal(action.get(name, lambda: FOLDER_WRITERS[name](tmp_path / "result", fitted)), f"result: {words}")
    assert everything_below(tmp_path) == before


def test_a_path_that_the_system_refuses_to_look_at(tmp_path):
    """A name that is too long, or below a file, is one line like a file that is missing."""
    (tmp_path / "file").write_text("x")
    for name, words in (
        ("n" * 300, "cannot be read: File name too long"),
        ("file/x", "no such"),
        ("none", "no such"),
    ):
        for read in (existing_file, existing_folder, read_capture, read_json):
            refusal(lambda read=read, name=name: read(tmp_path / name), tmp_path / name, words)
    refusal(lambda: existing_file(tmp_path), f"{tmp_path}: is a folder, a file is needed")
    refusal(lambda: existing_folder(tmp_path / "file"), "file: is a file, a folder is needed")


RAW_WRITES = {
    "write_text",
    "write_bytes",
    "mkdir",
    "makedirs",
    "touch",
    "rename",
    "savez",
    "savez_compressed",
    "savetxt",
}
GUARDED = {"files.py", "synthetic/capture.py", "driving/writers.py"}
"""The modules that call the system; the last two write inside one ``writing`` block, which the tests above fill."""


def test_nothing_is_written_unguarded():
    """Outside :mod:`mgavatar.files`, files are opened for writing only through its functions."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        module = path.relative_to(PACKAGE).as_posix()
        if module not in GUARDED:
            found += [f"{module}:{line}" for line in _raw_writes(ast.parse(path.read_text("utf-8")))]
    assert found == []


def test_the_search_for_unguarded_writes_finds_them():
    """One of each kind, and none where a file of ``atomic_write`` is filled."""
    lines = [
        'path.write_text("x")', "path.mkdir()", 'open(path, "w")', 'path.open("ab")', 'path.open(mode="x")',
        "np.savez(path, a=a)", "image.save(path)", "torch.save(a, path)", "os.replace(a, b)", "json.dump(a, path)",
    ]  # fmt: skip
    assert list(_raw_writes(ast.parse("\n".join(lines)))) == list(range(1, len(lines) + 1))
    allowed = "\n".join(
        ["np.savez(file, a=a)", "torch.save(a, file)", "image.save(buffer, format='PNG')", "write_text(path, 'x')",
         "path.open()", "path.open('rb')", "avatar.save(run.avatar)", "text.replace('a', 'b')"]
    )  # fmt: skip
    assert list(_raw_writes(ast.parse(allowed))) == []


def _raw_writes(tree: ast.AST) -> Iterator[int]:
    """Yield the lines of calls that write to a path of their own."""
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        function = call.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        owner = ast.unparse(function.value) if isinstance(function, ast.Attribute) else ""
        into = [ast.unparse(argument) for argument in call.args]
        to_file = any(argument in ("file", "buffer", "text") for argument in into)
        modes = [*call.args, *(keyword.value for keyword in call.keywords if keyword.arg == "mode")]
        opens = name == "open" and any(
            isinstance(mode, ast.Constant) and isinstance(mode.value, str) and set(mode.value) & set("wax+")
            for mode in modes
            if len(ast.unparse(mode)) <= 5
        )
        saves = name in ("save", "dump") and owner not in ("avatar",) and not to_file
        by_method = name in RAW_WRITES and owner and not to_file
        if opens or saves or by_method or (owner == "os" and name in ("replace", "remove", "unlink")):
            yield call.lineno
