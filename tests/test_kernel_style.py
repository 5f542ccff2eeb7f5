"""Warp kernels keep the form that makes a tape correct, and the lint that says so finds each fault of bad kernels."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
from kernel_style import generated_adjoints, kernel_names, lint

import mgavatar.kernels

FILES = sorted(p for p in Path(mgavatar.kernels.__file__).parent.glob("*.py") if p.stem != "__init__")

GOOD = """
@wp.kernel
def _add_kernel(
    # In:
    n: int,
    x: wp.array[wp.vec3],  # [N]
    # Out:
    y: wp.array[wp.vec3],  # [N]
):
    y[wp.tid()] = x[wp.tid()]
"""

NATIVE = """
@wp.func_native(_TEXT.replace("REAL", "float"))
def store(x: wp.array[float], y: wp.array[float]): ...


@wp.kernel
def _store_kernel(
    # In:
    x: wp.array[float],  # [N]
    # Out:
    y: wp.array[float],  # [N]
):
    store(x, y)
"""


def snippets_of(module) -> dict[str, str]:
    """The texts of a module that its native functions may be made of."""
    return {name: value for name, value in vars(module).items() if isinstance(value, str)}


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_kernels_keep_the_style(path):
    """No fault in any file."""
    module = importlib.import_module(f"mgavatar.kernels.{path.stem}")
    assert lint(path.read_text(), snippets_of(module)) == []


def test_kernels_are_found():
    """The test above reads something."""
    assert sum(len(kernel_names(path.read_text())) for path in FILES) >= 30


def test_only_face_frames_leave_their_adjoint_to_warp():
    """CONTRIBUTING.md says so, and why."""
    assert [name for path in FILES for name in generated_adjoints(path.read_text())] == ["face_frames_kernel"]
    assert generated_adjoints(GOOD) == ["_add_kernel"]
    assert generated_adjoints(GOOD.replace("@wp.kernel", "@wp.kernel(enable_backward=False)")) == []


def test_a_good_kernel_has_no_fault():
    """In Python and in C++."""
    assert lint(GOOD, {}) == []
    assert lint(NATIVE, {"_TEXT": "const REAL* p = x.data; y.data[0] = p[0];"}) == []


@pytest.mark.parametrize(
    ("good", "bad", "fault"),
    [
        ("wp.array[wp.vec3],  # [N]\n    # Out", "wp.array(dtype=wp.vec3),  # [N]\n    # Out", "not as wp.array"),
        ("_add_kernel", "_add", "does not end in _kernel"),
        ("_add_kernel", "add_kernel", "is public"),
        ("    # In:\n    n: int,\n", "    n: int,\n    # In:\n", "n stands above"),
        ("# In:", "# Inputs:", "its groups are"),
        ("    # Out:\n", "", "its groups are"),
        ("# In:", "# Out:", "its groups are"),
        ("x: wp.array[wp.vec3],  # [N]", "x: wp.array[wp.vec3],", "x has no shape"),
        ("x: wp.array[wp.vec3],  # [N]", "x: wp.array[wp.vec3],  # points", "x has no shape"),
        ("y[wp.tid()] = x[wp.tid()]", "y[wp.tid()] = x[0]\n    x[0] = y[0]", "x stands under # In: but is written"),
        ("y[wp.tid()] = x[wp.tid()]", "y[0] = x[0]\n    x[0, 1] += y[0]", "x stands under # In: but is written"),
        ("y[wp.tid()] = x[wp.tid()]", "y[0], x[0] = x[0], y[0]", "x stands under # In: but is written"),
        ("y[wp.tid()] = x[wp.tid()]", "y[0] = x[0]\n    wp.atomic_add(x, 0, y[0])", "x stands under # In: but is"),
        ("y[wp.tid()] = x[wp.tid()]", "z = x[0]", "y stands under # Out: but is not written"),
        ("    # Out:\n", "    # Out:\n    m: int,\n", "m stands under # Out: but is not an array"),
    ],
)
def test_each_fault_of_a_kernel_is_found(good, bad, fault):
    """One change to the good kernel, one fault."""
    assert good in GOOD
    found = lint(GOOD.replace(good, bad, 1), {})
    assert len(found) == 1
    assert fault in found[0]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("x.data[3 * i] = y.data[i];", "x stands under # In: but is written"),
        ("y.data[0] = 0; x.data[i] += 1;", "x stands under # In: but is written"),
        ("y.data[0] = 0; float* p = x.data + 3;", "x stands under # In: but is written"),
        ("y.data[0] = 0; float* __restrict__ p = &x.data[3];", "x stands under # In: but is written"),
        ("y.data[0] = 0; __builtin_memcpy(&x.data[o], row, 4);", "x stands under # In: but is written"),
        ("y.data[0] = 0; atomicAdd((unsigned*)&x.data[o], 1u);", "x stands under # In: but is written"),
        ("const float* p = y.data; float z = x.data[0];", "y stands under # Out: but is not written"),
        ("if (y.data[0] == x.data[0]) return;", "y stands under # Out: but is not written"),
    ],
)
def test_each_fault_of_a_native_snippet_is_found(text, fault):
    """Stores through pointers, and calls that store."""
    assert any(fault in found for found in lint(NATIVE, {"_TEXT": text}))


def test_writes_are_followed_through_device_functions():
    """An input that a function writes is a fault of the kernel that passes it."""
    helper = "@wp.func\ndef put(a: wp.array[wp.vec3], b: wp.array[wp.vec3]):\n    b[0] = a[0]\n"
    body = "y[wp.tid()] = x[wp.tid()]"
    assert lint(helper + GOOD.replace(body, "put(x, y)"), {}) == []
    assert len(lint(helper + GOOD.replace(body, "put(y, x)"), {})) == 2
