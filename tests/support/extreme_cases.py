"""The table of extremes: each kernel's extreme inputs, and the result that is expected.

``tests/test_extremes.py`` checks every row, ``tools/numerics.py`` prints it with the measured errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

Kind = Literal["equal", "culled", "refused"]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One row of the table.

    Attributes:
        kernel: What is tried.
        name: The extreme.
        inputs: Makes the differentiable inputs, in float64, from a seeded generator.
        op: The kernel on such inputs, of the build's dtype.
        twin: The same in plain torch float64; for ``culled``, what remains without the bad element.
        expect: ``equal`` to the twin within the bounds, ``culled`` (the same bits as without the bad element, whose
            gradient is zero), or ``refused`` with ``message``.
        forward: Largest error of the float32 output over the output's scale.
        gradient: Largest relative L2 error of a float32 gradient.
        double: The same two for float64.
        floor: Size under which outputs and gradients are compared in absolute terms.
        mask: Which outputs count, from the inputs: those that rounding cannot switch.
    """

    kernel: str
    name: str
    inputs: Callable[[torch.Generator], tuple[Tensor, ...]]
    op: Callable[..., Any]
    twin: Callable[..., Any] | None = None
    expect: Kind = "equal"
    message: str = ""
    forward: float = 1e-6
    gradient: float = 5e-6
    double: tuple[float, float] = (1e-12, 1e-9)
    floor: float = 1e-40
    mask: Callable[..., Tensor] | None = None

    @property
    def id(self) -> str:
        """Name in the test report."""
        return f"{self.kernel}: {self.name}"


@dataclass(frozen=True)
class Measured:
    """Errors of one row in one build: of the output over its scale, and the worst gradient's relative L2."""

    forward: float
    gradient: float


def _run(op: Callable[..., Any], inputs: Sequence[Tensor], mask: Tensor | None) -> tuple[list[Tensor], list[Tensor]]:
    leaves = [tensor.detach().clone().requires_grad_() for tensor in inputs]
    outputs = op(*leaves)
    outputs = [outputs] if isinstance(outputs, Tensor) else list(outputs)
    g = torch.Generator().manual_seed(3)
    weights = [torch.randn(o.shape, generator=g, dtype=torch.float64) for o in outputs]
    if mask is not None:
        weights = [w * mask for w in weights]
    total = sum((o * w.to(o)).sum() for o, w in zip(outputs, weights, strict=True))
    grads = torch.autograd.grad(total, leaves, allow_unused=True) if total.requires_grad else [None] * len(leaves)
    filled = [torch.zeros_like(x) if grad is None else grad for x, grad in zip(leaves, grads, strict=True)]
    values = [o.detach().cpu().double() for o in outputs]
    kept = values if mask is None else [value * mask for value in values]
    return kept, [grad.cpu().double() for grad in filled]


def _mask(case: Case, inputs: Sequence[Tensor]) -> Tensor | None:
    return case.mask(*(tensor.double() for tensor in inputs)).double() if case.mask else None


def _relative(got: Tensor, want: Tensor, norm: Callable[[Tensor], Tensor], floor: float) -> float:
    if not got.numel():
        return 0.0
    error = float(norm(got - want) / norm(want).clamp(min=floor))
    return error if bool(got.isfinite().all()) else float("inf")


def measure(case: Case, dtype: torch.dtype, *, device: torch.device | str = "cpu", **build: Any) -> Measured:
    """Run one row that is not refused; what is not finite has an infinite error. The twin runs on the CPU."""
    inputs = [tensor.to(dtype) for tensor in case.inputs(torch.Generator().manual_seed(11))]
    placed = [tensor.to(device) for tensor in inputs]
    got, got_grads = _run(lambda *t: case.op(*t, **build), placed, mask := _mask(case, inputs))
    if case.expect == "culled":
        want, want_grads = _run(lambda *t: case.twin(*t, **build), placed, mask)  # type: ignore[misc]
    else:
        want, want_grads = _run(case.twin, [tensor.double() for tensor in inputs], mask)  # type: ignore[arg-type]
    pairs, grad_pairs = zip(got, want, strict=True), zip(got_grads, want_grads, strict=True)
    return Measured(
        forward=max((_relative(a, b, lambda x: x.abs().max(), case.floor) for a, b in pairs), default=0.0),
        gradient=max((_relative(a, b, torch.linalg.vector_norm, case.floor) for a, b in grad_pairs), default=0.0),
    )


def bounds(case: Case, dtype: torch.dtype) -> Measured:
    """What the errors of a row may be; what is culled leaves no trace, but the camera's gradient is a sum over N."""
    if case.expect == "culled":
        return Measured(0.0, 1e-7)
    return Measured(case.forward, case.gradient) if dtype == torch.float32 else Measured(*case.double)
