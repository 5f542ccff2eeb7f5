"""The only place where Warp meets torch: launches, tapes, gradient buffers, streams and CPU threads.

Kernels with straight-line mathematics go through :func:`taped`: Warp records the launch and replays its adjoint.
Kernels with a hand-written adjoint are ``torch.autograd.Function`` classes beside their kernels; they call
:func:`launch` and :func:`launch_ranges` in both directions.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

_n_threads = max(1, min(32, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1))


def set_num_threads(n: int) -> None:
    """Let CPU kernels that split into disjoint ranges use ``n`` threads; results do not depend on it.

    Raises:
        ValueError: If ``n`` is not positive.
    """
    global _n_threads
    if n < 1:
        raise ValueError(f"number of threads must be at least 1, got {n}")
    _n_threads = n


def num_threads() -> int:
    """Return the number of threads that :func:`launch_ranges` uses on a CPU."""
    return _n_threads


@lru_cache(maxsize=4)
def _pool(n: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(n, thread_name_prefix="mgavatar-kernels")


def torch_stream(device: torch.device) -> AbstractContextManager[Any]:
    """Make Warp launch on torch's current stream inside; nothing to do on a CPU."""
    if device.type != "cuda":
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)))


def to_warp(tensor: Tensor, dtype: Any, *, requires_grad: bool = False) -> wp.array:
    """Wrap ``tensor`` as a Warp array of ``dtype`` without a copy; a gradient buffer, if any, is Warp's own."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=requires_grad)


def _argument(value: Any, declared: Any, *, requires_grad: bool = False) -> Any:
    if not isinstance(value, Tensor):
        return value
    return to_warp(value.contiguous(), declared.dtype, requires_grad=requires_grad)


def _arguments(kernel: wp.Kernel, values: Sequence[Any], first: int = 0) -> list[Any]:
    declared = kernel.adj.args[first : first + len(values)]
    return [_argument(value, arg.type) for value, arg in zip(values, declared, strict=True)]


def _device(values: Sequence[Any]) -> torch.device:
    return next(value.device for value in values if isinstance(value, Tensor))


def launch(
    kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: Sequence[Any], outputs: Sequence[Tensor] = ()
) -> None:
    """Run ``kernel`` on torch's stream; torch tensors become arrays of the types that the kernel declares.

    Outputs must be contiguous and are written in place.
    """
    device = _device([*outputs, *inputs])
    arguments = _arguments(kernel, [*inputs, *outputs])
    with torch_stream(device):
        wp.launch(kernel, dim, inputs=arguments, device=str(device))


def launch_ranges(
    kernel: wp.Kernel,
    n_items: int,
    inputs: Sequence[Any],
    outputs: Sequence[Tensor] = (),
    *,
    ranges_per_thread: int = 8,
) -> None:
    """Run ``kernel`` over ``n_items`` independent items; on a CPU, several threads take disjoint ranges of them.

    The kernel's first argument is the index of its range's first item. Items must write disjoint memory: the result
    is then the same, bit for bit, for any number of threads. Eight ranges per thread balance items of uneven cost. A
    range costs some 0.07 ms to hand out, so kernels whose items all cost the same take one per thread.
    """
    device = _device([*outputs, *inputs])
    arguments = _arguments(kernel, [*inputs, *outputs], first=1)
    threads = min(_n_threads, n_items)
    if device.type == "cuda" or threads <= 1:
        with torch_stream(device):
            wp.launch(kernel, n_items, inputs=[0, *arguments], device=str(device))
        return
    kernel.module.load("cpu", 1)  # the block size of CPU launches; another one would be a second build
    step = -(-n_items // (ranges_per_thread * threads))

    def run(first: int) -> None:
        wp.launch(kernel, min(step, n_items - first), inputs=[first, *arguments], device="cpu")

    for done in [_pool(threads).submit(run, first) for first in range(0, n_items, step)]:
        done.result()


class _TapeNode(torch.autograd.Function):
    """One node of torch's graph that records a Warp launch and replays its adjoint."""

    @staticmethod
    def forward(ctx: Any, kernel: wp.Kernel, dim: int, shapes: Sequence[Sequence[int]], *inputs: Any) -> Any:
        device = _device(inputs)
        n_inputs = len(inputs)
        declared = [arg.type for arg in kernel.adj.args]
        needs_grad = ctx.needs_input_grad[3:]
        real = next((x.dtype for x in inputs if isinstance(x, Tensor) and x.is_floating_point()), torch.float32)
        outputs = tuple(torch.zeros(tuple(shape), device=device, dtype=real) for shape in shapes)
        with torch_stream(device), wp.Tape() as ctx.tape:
            ctx.arrays = [
                _argument(x, t, requires_grad=n) for x, t, n in zip(inputs, declared, needs_grad, strict=False)
            ]
            ctx.outputs = [
                _argument(x, t, requires_grad=any(needs_grad))
                for x, t in zip(outputs, declared[n_inputs:], strict=True)
            ]
            if dim:
                wp.launch(kernel, dim, inputs=ctx.arrays, outputs=ctx.outputs, device=str(device))
        ctx.save_for_backward(*(x for x in inputs if isinstance(x, Tensor)))
        return outputs[0] if len(outputs) == 1 else outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads_out: Tensor) -> Any:
        _ = ctx.saved_tensors  # torch raises here if an input was changed in place since forward
        with torch_stream(grads_out[0].device):
            ctx.tape.zero()
            grads = {out: to_warp(g.contiguous(), out.dtype) for out, g in zip(ctx.outputs, grads_out, strict=True)}
            ctx.tape.backward(grads=grads)
        # Cloned: Warp owns its gradient buffers and will zero them if the graph is walked again.
        owned = [
            wp.to_torch(a.grad).clone() if isinstance(a, wp.array) and a.requires_grad else None for a in ctx.arrays
        ]
        return None, None, None, *owned


def taped(kernel: wp.Kernel, dim: int, inputs: Sequence[Any], shapes: Sequence[Sequence[int]]) -> Any:
    """Run ``kernel`` as a node of torch's graph whose adjoint Warp derives.

    Only for straight-line kernels whose inputs are read and whose outputs are written once: Warp does not replay
    loops of data-dependent length that carry a value. A second derivative is refused.

    Args:
        kernel: The kernel; its arguments are the inputs, then the outputs.
        dim: Number of threads.
        inputs: Tensors or plain values, in the kernel's order.
        shapes: Shape of each output tensor.

    Returns:
        The output tensor, or a tuple of them.
    """
    return _TapeNode.apply(kernel, dim, shapes, *inputs)


def sort_pairs(keys: Tensor, values: Tensor, *, bits: int = 32) -> tuple[Tensor, Tensor]:
    """Sort ``keys`` and carry ``values`` along: a stable radix sort.

    Args:
        keys: Sort keys, shape [N], float32 or int32.
        values: Carried along, shape [N], int32.
        bits: Number of low bits in which the keys may differ.

    Returns:
        Both in ascending order of the keys, ties in their given order.
    """
    n = len(keys)
    room_keys, room_values = keys.new_empty(2 * n), values.new_empty(2 * n)
    room_keys[:n], room_values[:n] = keys, values
    if n:
        with torch_stream(keys.device):
            dtype = wp.float32 if keys.is_floating_point() else wp.int32
            wp.utils.radix_sort_pairs(to_warp(room_keys, dtype), to_warp(room_values, wp.int32), n, 0, bits)
    return room_keys[:n], room_values[:n]
