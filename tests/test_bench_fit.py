"""``tools/bench_fit.py``: parts are timed where they run, in both directions, and add up; the table holds them."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace

import bench_fit
import pytest
import torch
from step_profile import APPEARANCE, GEOMETRY, REST, Profile
from step_work import sizes

from mgavatar.errors import DataError

CPU = torch.device("cpu")
PAUSE = 0.02


class _Slow(torch.autograd.Function):
    """Takes its time in both directions."""

    @staticmethod
    def forward(ctx, x):
        time.sleep(PAUSE)
        return 2 * x

    @staticmethod
    def backward(ctx, grad):
        time.sleep(2 * PAUSE)
        return 2 * grad


def inner(x):
    return _Slow.apply(x)


def outer(x):
    time.sleep(PAUSE)
    return inner(x) + 1


PARTS = ((__name__, "inner", "inside"), (__name__, "outer", "around"))


def test_parts_are_timed_in_both_directions_and_count_once(monkeypatch):
    """What a part inside another one takes is its own, forward and backward; the sum is the step."""
    monkeypatch.setitem(sys.modules, __name__, sys.modules.get(__name__, sys.modules[outer.__module__]))
    module = sys.modules[__name__]
    x = torch.ones(3, requires_grad=True)
    profile = Profile(CPU)
    for _ in range(2):  # the leaf's node is there again in the second step
        start = time.perf_counter()
        with profile.wrapped(PARTS), profile.step():
            module.outer(x).sum().backward()
            time.sleep(PAUSE)
        total = time.perf_counter() - start
    assert profile.seconds["inside"] >= 3 * PAUSE
    assert PAUSE <= profile.seconds["around"] < 3 * PAUSE
    assert profile.seconds[REST] >= PAUSE
    assert sum(profile.seconds.values()) == pytest.approx(total, rel=0.1)
    assert module.outer is outer
    outer(x).sum().backward()  # no hook is left that would time this


@pytest.mark.parametrize("parts", [GEOMETRY, APPEARANCE], ids=["geometry", "appearance"])
def test_parts_are_there(parts):
    """What is renamed in the program would no longer be timed."""
    with Profile(CPU).wrapped(parts):
        pass


def test_both_stages_in_parts(monkeypatch, tmp_path):
    """A small size, from the command's own function to its table and JSON."""
    quick = replace(next(iter(sizes())), image=(48, 40), gaussians=11_000)
    monkeypatch.setattr(bench_fit, "sizes", lambda: [quick])
    monkeypatch.setattr("step_work.WARM_UP", 1)
    text = bench_fit.bench_fit(threads=1, json=tmp_path / "fit.json", names=("quick",), steps=2)
    geometry, appearance = json.loads((tmp_path / "fit.json").read_text())["rows"]
    for row, parts in ((geometry, GEOMETRY), (appearance, APPEARANCE)):
        assert set(row["parts_ms"]) == {name for *_, name in parts} | {REST}
        assert all(value > 0 for value in row["parts_ms"].values())
        assert sum(row["parts_ms"].values()) < 3 * row["step_ms"]
        assert all(f"| {name} " in text for name in row["parts_ms"])
    assert appearance["work"] == "48 x 40, 11K Gaussians"
    assert appearance["refine_ms"] > 0


@pytest.mark.parametrize("flag", ["threads", "steps"])
def test_a_number_that_cannot_be_is_refused(flag):
    """Before a capture is made; the message names the flag."""
    with pytest.raises(DataError, match=f"--{flag} 0: must be at least 1"):
        bench_fit.bench_fit(**{flag: 0})
