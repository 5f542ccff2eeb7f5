"""Comparisons that the tests of all kernels share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from mgavatar.kernels.bridge import num_threads, set_num_threads

OUTPUT_TOLERANCE = 1e-6
"""Largest error of a float32 output, over the largest absolute value of the twin's."""

GRADIENT_TOLERANCE = 5e-6
"""Relative L2 error of a float32 gradient."""


def _outputs(op: Callable[..., Any], inputs: Sequence[Any]) -> tuple[Tensor, ...]:
    out = op(*inputs)
    return (out,) if isinstance(out, Tensor) else tuple(out)


def _copies(inputs: Sequence[Any], dtype: torch.dtype, device: torch.device | str) -> list[Any]:
    """Leaves of the given dtype; what wants a gradient keeps wanting it, integers and plain values stay."""
    copies = []
    for value in inputs:
        if isinstance(value, Tensor) and value.is_floating_point():
            value = value.detach().to(device, dtype).clone().requires_grad_(value.requires_grad)
        elif hasattr(value, "to"):
            value = value.to(device)
        copies.append(value)
    return copies


def _run(
    op: Callable[..., Any], inputs: Sequence[Any], cotangents: Sequence[Tensor]
) -> tuple[list[Tensor], list[Tensor]]:
    outputs = _outputs(op, inputs)
    leaves = [x for x in inputs if isinstance(x, Tensor) and x.requires_grad]
    if leaves:
        total = sum((o * c.to(o.device, o.dtype)).sum() for o, c in zip(outputs, cotangents, strict=True))
        total.backward()
    return [o.detach().cpu().double() for o in outputs], [x.grad.detach().cpu().double() for x in leaves]


def assert_matches_twin(
    op: Callable[..., Any],
    twin: Callable[..., Any],
    inputs: Sequence[Any],
    *,
    device: torch.device | str = "cpu",
    output_tolerance: float = OUTPUT_TOLERANCE,
    gradient_tolerance: float = GRADIENT_TOLERANCE,
) -> None:
    """Check a kernel in float32 against its twin in float64: every output, every gradient that an input wants.

    The twin gets exactly the numbers that the kernel gets. Outputs must agree in largest absolute error over their
    scale, gradients in relative L2 error and, ten times more loosely, in largest absolute error over their scale.
    """
    single = _copies(inputs, torch.float32, device)
    double = _copies(single, torch.float64, "cpu")
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        shapes = [o.shape for o in _outputs(twin, double)]
    cotangents = [torch.randn(shape, generator=generator).double() for shape in shapes]
    got, got_grads = _run(op, single, cotangents)
    want, want_grads = _run(twin, double, cotangents)
    assert [o.shape for o in got] == [o.shape for o in want]
    for i, (a, b) in enumerate(zip(got, want, strict=True)):
        scale = b.abs().max().clamp(min=1e-30) if b.numel() else 1.0
        error = float((a - b).abs().max() / scale) if b.numel() else 0.0
        assert error <= output_tolerance, f"output {i}: largest error {error:.2e} of its scale {float(scale):.3g}"
    for i, (a, b) in enumerate(zip(got_grads, want_grads, strict=True)):
        norm, largest = b.norm().clamp(min=1e-30), b.abs().max().clamp(min=1e-30)
        error = float((a - b).norm() / norm)
        assert error <= gradient_tolerance, f"gradient {i}: relative L2 error {error:.2e}"
        error = float((a - b).abs().max() / largest)
        assert error <= 10 * gradient_tolerance, f"gradient {i}: largest error {error:.2e} of its scale"


def assert_gradcheck(op: Callable[..., Any], *inputs: Tensor) -> None:
    """Check the float64 build against finite differences."""
    leaves = [x.detach().double().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(op, leaves, eps=1e-6, atol=1e-6, rtol=1e-5)


@contextmanager
def threads(n: int) -> Iterator[None]:
    """Let kernels use ``n`` CPU threads inside."""
    before = num_threads()
    set_num_threads(n)
    try:
        yield
    finally:
        set_num_threads(before)


def assert_same_bits(op: Callable[..., Any], inputs: Sequence[Any], *, device: torch.device | str = "cpu") -> None:
    """Check that outputs and gradients are the same bits twice over, and for 1, 2 and 3 threads."""
    shapes = [o.shape for o in _outputs(op, _copies(inputs, torch.float32, device))]
    generator = torch.Generator().manual_seed(3)
    cotangents = [torch.randn(shape, generator=generator) for shape in shapes]
    results = []
    for n in (1, 2, 2, 3):
        with threads(n):
            outputs, grads = _run(op, _copies(inputs, torch.float32, device), cotangents)
        results.append([*outputs, *grads])
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)
