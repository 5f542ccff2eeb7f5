"""Damaged and hostile motion: a clean load or one line that names the file, whatever the bytes are.

``MGAVATAR_FUZZ`` sets the number of mutations of each kind of file; the suite makes a few, a release thousands.
"""

from __future__ import annotations

import json
import os
import random
import time
from collections.abc import Callable
from pathlib import Path

import motion_files as write
import numpy as np
import pytest
from motion_files import face, performance

from mgavatar.driving.expression_map import map_by_names, read_expression_map, write_expression_map
from mgavatar.driving.read import READERS, read_driving
from mgavatar.errors import DataError
from mgavatar.head.procedural.build import build_head

N_MUTATIONS = int(os.environ.get("MGAVATAR_FUZZ", "15"))

MADE = performance(4)
FACE = face(5)


def vhap(path: Path) -> Path:
    np.savez(path, expr=MADE.expr, rotation=MADE.root, eyes_pose=MADE.eyes, fps=30.0, expr_basis="flame2023")
    return path


KINDS: dict[str, Callable[[Path], Path]] = {
    "vhap.npz": vhap,
    "emoca.npz": lambda path: write.write_emoca(path, MADE),
    "smirk.npz": lambda path: write.write_smirk(path, MADE),
    "cap4d.npz": lambda path: write.write_cap4d(path, MADE),
    "nersemble.npz": lambda path: write.write_nersemble(path, MADE),
    "artalk.pt": lambda path: write.write_artalk(path, MADE),
    "metrical": lambda path: write.write_metrical(path, performance(1)) / "checkpoint/00000.frame",
    "pixel3dmm": lambda path: write.write_pixel3dmm(path, performance(1)) / "00000.frame",
    "tracker": lambda path: write.write_flame_head_tracker(path, performance(1)) / "0.npz",
    "live_link.csv": lambda path: write.write_live_link(path, FACE),
    "lam.json": lambda path: write.write_lam(path, FACE),
    "a2f.csv": lambda path: write.write_audio2face_csv(path, FACE),
    "a2f.json": lambda path: write.write_audio2face_json(path, FACE),
    "mediapipe.json": lambda path: write.write_mediapipe(path, FACE),
    "lines.json": lambda path: write.write_mediapipe(path, FACE, style="lines"),
}

NASTY_TEXT = (
    b"nan", b"-inf", b"1e999", b"=SUM(A1)", b'"', b",", b"\n", b"{", b"]", b"null", b"true", b"\xff\xfe", b"\0",
    b"[[[[", b"99999999999999999999", b"-1", b"0", b"", b"Timecode", b"jawOpen", b"23:59:59:99.9", b"'; DROP", b"1_0",
)  # fmt: skip

NASTY_ARRAYS = (
    np.zeros((0, 3)),
    np.zeros(()),
    np.full((4, 3), np.nan),
    np.full((4, 3), 1e300),
    np.full((4, 3), "a"),
    np.zeros((4, 3), "S4"),
    np.zeros((4, 3), np.int8),
    np.zeros((4, 3), np.complex64),
    np.zeros((1, 1, 1, 1, 3)),
    np.ones((7, 100)),
    np.array([None, {}], object),
    np.zeros(3, "M8[s]"),
    np.zeros(2, [("a", "f4")]),
)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Bytes with a few changes: flipped, cut, doubled, or with something nasty in their middle."""
    for _ in range(rng.randint(1, 4)):
        at, kind = rng.randrange(len(data) + 1), rng.randrange(5)
        if kind == 0 and data:
            data = data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
        elif kind == 1:
            data = data[:at]
        elif kind == 2:
            data = data[:at] + data[rng.randrange(len(data) + 1) :]
        else:
            data = data[:at] + rng.choice(NASTY_TEXT) + data[at + rng.choice((0, 1, 4, 30)) :]
    return data


def with_nasty_array(path: Path, rng: random.Random) -> None:
    """Rewrite an ``.npz`` with one array exchanged."""
    with np.load(path) as file:
        arrays = dict(file)
    arrays[rng.choice(sorted(arrays))] = rng.choice(NASTY_ARRAYS)
    np.savez(path, **arrays)


def with_nasty_value(path: Path, rng: random.Random) -> None:
    """Rewrite a JSON file with one value exchanged, somewhere in the tree."""
    content = json.loads(path.read_text())
    nasty = [None, True, "", "a", [], {}, -1, 10**400, 1e300, float("nan"), [[1]], {"score": 1}]

    def changed(value: object, depth: int) -> object:
        children = (
            list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
        )
        if not children or depth == 0:
            return rng.choice(nasty)
        key = rng.choice(children)
        value[key] = changed(value[key], depth - 1)  # type: ignore[index]
        return value

    path.write_text(json.dumps(changed(content, rng.randint(1, 5))))


def is_clean(path: Path, action: Callable[[], object]) -> None:
    """An action ends at once, with a result or one line that names the file."""
    start = time.perf_counter()
    message = str(path)
    try:
        action()
    except DataError as error:
        message = str(error)
    assert time.perf_counter() - start < 10.0
    assert message.startswith(str(path)), message
    assert "\n" not in message
    assert len(message) < 1500


@pytest.mark.parametrize("kind", KINDS)
def test_mutations_load_or_are_one_line(tmp_path, kind, monkeypatch):
    """Every reader, with the bytes of a good file changed, and with values of the wrong kind in it."""
    monkeypatch.chdir(tmp_path)
    file = KINDS[kind](tmp_path / kind)
    good = file.read_bytes()
    assert len(read_driving(file if file.parent == tmp_path else tmp_path / kind)) >= 1
    for seed in range(N_MUTATIONS):
        rng = random.Random(f"{kind} {seed}")  # noqa: S311
        file.write_bytes(good)
        if file.suffix == ".npz" and seed % 3 == 0:
            with_nasty_array(file, rng)
        elif kind in ("lam.json", "a2f.json", "mediapipe.json") and seed % 3 < 2:
            with_nasty_value(file, rng)
        else:
            file.write_bytes(mutated(good, rng))
        is_clean(tmp_path, lambda: read_driving(file))
        if file.parent != tmp_path:
            is_clean(tmp_path, lambda: read_driving(tmp_path / kind))
    assert {path.name for path in tmp_path.iterdir()} == {kind}, "a file was written"


def test_every_reader_has_a_kind_here(tmp_path):
    """A new format needs a good file of its own above."""
    files = [KINDS[kind](tmp_path / kind) for kind in KINDS]
    for reader in READERS:
        assert any(reader.recognises(file) for file in files), reader.UNDERSTOOD


def test_mutated_expression_maps(tmp_path):
    path = tmp_path / "map.npz"
    write_expression_map(path, map_by_names(build_head()))
    good = path.read_bytes()
    for seed in range(N_MUTATIONS):
        rng = random.Random(seed)  # noqa: S311
        path.write_bytes(good)
        if seed % 2:
            with_nasty_array(path, rng)
        else:
            path.write_bytes(mutated(good, rng))
        is_clean(path, lambda: read_expression_map(path, n_expr=100))
