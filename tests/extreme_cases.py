"""The table of extremes: what each kernel is given, and what is expected of it.

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
    kept = [o.detach().double() if mask is None else o.detach().double() * mask for o in outputs]
    return kept, [grad.double() for grad in filled]


def _relative(got: Tensor, want: Tensor, norm: Callable[[Tensor], Tensor]) -> float:
    if not got.numel():
        return 0.0
    error = float(norm(got - want) / norm(want).clamp(min=1e-30))
    return error if bool(got.isfinite().all()) else float("inf")


def measure(case: Case, dtype: torch.dtype, **build: Any) -> Measured:
    """Run one row that is expected to be ``equal``; what is not finite has an infinite error."""
    inputs = [tensor.to(dtype) for tensor in case.inputs(torch.Generator().manual_seed(11))]
    exact = [tensor.double() for tensor in inputs]
    mask = case.mask(*exact).double() if case.mask else None
    got, got_grads = _run(lambda *t: case.op(*t, **build), inputs, mask)
    want, want_grads = _run(case.twin, exact, mask)  # type: ignore[arg-type]
    pairs, grad_pairs = zip(got, want, strict=True), zip(got_grads, want_grads, strict=True)
    return Measured(
        forward=max((_relative(a, b, lambda x: x.abs().max()) for a, b in pairs), default=0.0),
        gradient=max((_relative(a, b, torch.linalg.vector_norm) for a, b in grad_pairs), default=0.0),
    )


def bounds(case: Case, dtype: torch.dtype) -> Measured:
    """What the errors of a row may be."""
    return Measured(case.forward, case.gradient) if dtype == torch.float32 else Measured(*case.double)


def without_bad(case: Case, dtype: torch.dtype, **build: Any) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """For a ``culled`` row, outputs and gradients with the bad element, then the outputs without it."""
    inputs = [tensor.to(dtype) for tensor in case.inputs(torch.Generator().manual_seed(11))]
    got, grads = _run(lambda *t: case.op(*t, **build), inputs, None)
    want, want_grads = _run(lambda *t: case.twin(*t, **build), inputs, None)  # type: ignore[misc]
    return [*got, *grads], [*want, *want_grads], grads
