"""Time the parts of an optimizer step in place, forward and backward.

Functions are wrapped temporarily. The nodes that a function adds to torch's graph are timed under its name in the
backward pass. The time of a part inside another one is subtracted from the outer one, so the parts add up to the step.
"""

from __future__ import annotations

import functools
import importlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils.hooks import RemovableHandle

REST = "the rest"
"""Name of the remaining time: torch's bookkeeping, sums of losses, the loop."""

Parts = tuple[tuple[str, str, str], ...]
"""Module or class, attribute, name of the part."""

SHARED: Parts = (
    ("mgavatar.fitting.views:Views", "target", "data"),
    ("mgavatar.gaussians", "rasterize", "projection, sort, lists"),
    ("mgavatar.kernels.rasterize", "blend", "blending, forward"),
    ("mgavatar.kernels.rasterize", "blend_backward", "blending, backward"),
    ("torch.optim:Adam", "step", "Adam"),
)

GEOMETRY: Parts = (
    *SHARED,
    ("mgavatar.geometry.head:PersonalHead", "posed", "head: identity, expression, skinning"),
    ("mgavatar.geometry.refine_net:RefineNet", "encode", "RefineNet: triplane"),
    ("mgavatar.geometry.refine_net:RefineNet", "identity_offsets", "RefineNet: networks"),
    ("mgavatar.geometry.refine_net:RefineNet", "pose_offsets", "RefineNet: networks"),
    ("mgavatar.geometry.vertex_gaussians:VertexGaussians", "bound", "binding"),
    ("mgavatar.geometry.vertex_gaussians:VertexGaussians", "scales", "binding"),
    ("mgavatar.geometry.stage", "image_loss", "image loss"),
    ("mgavatar.geometry.stage", "offset_loss", "offset and Laplacian losses"),
    ("mgavatar.geometry.stage", "laplacian_loss", "offset and Laplacian losses"),
)

APPEARANCE: Parts = (
    *SHARED,
    ("mgavatar.appearance.model:FrozenHead", "at_timestep", "head"),
    ("mgavatar.appearance.model:Appearance", "forward", "binding"),
    ("mgavatar.appearance.model", "sparse_apply", "OffsetNet: samples"),
    ("mgavatar.appearance.offset_net:OffsetNet", "forward", "OffsetNet: network"),
    ("mgavatar.appearance.color_net:ColorNet", "forward", "ColorNet: network"),
    ("mgavatar.kernels.hash_grid:HashGrid", "forward", "ColorNet: hash grid"),
    ("mgavatar.kernels.hash_grid:HashGrid", "adam_step", "hash grid's Adam"),
    ("mgavatar.appearance.stage", "image_loss", "image loss"),
    ("mgavatar.appearance.stage", "binding_loss", "binding loss"),
    ("mgavatar.appearance.stage:AppearanceStage", "_control_density", "density control"),
)


class Profile:
    """Seconds of each part of one step; a part inside another one counts once."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._running: list[str] = []
        self._labelled: set[Any] = set()
        self._hooks: list[RemovableHandle] = []
        self.seconds: dict[str, float] = {}

    @contextmanager
    def step(self) -> Iterator[None]:
        """Time one step; ``seconds`` has its parts afterwards."""
        self.seconds = defaultdict(float)
        self._labelled = set()
        self._running = [REST]
        self._since = self.now()
        yield
        self._leave()
        for hook in self._hooks:  # nodes of parameters survive the step and would be timed twice in the next
            hook.remove()
        self._hooks = []

    @contextmanager
    def wrapped(self, parts: Parts) -> Iterator[None]:
        """Wrap the functions of ``parts`` inside the block."""
        with ExitStack() as stack:
            for place, attribute, name in parts:
                module, _, owner_name = place.partition(":")
                owner = importlib.import_module(module)
                owner = getattr(owner, owner_name) if owner_name else owner
                original = owner.__dict__[attribute]
                setattr(owner, attribute, self._timed(original, name))
                stack.callback(setattr, owner, attribute, original)
            yield

    def now(self) -> float:
        """Return the clock [s] after all work on the device has finished."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def _enter(self, name: str) -> None:
        now = self.now()
        self.seconds[self._running[-1]] += now - self._since
        self._running.append(name)
        self._since = now

    def _leave(self) -> None:
        now = self.now()
        self.seconds[self._running.pop()] += now - self._since
        self._since = now

    def _left(self, *_: Any) -> None:
        self._leave()

    def _timed(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            if not self._running:
                return function(*args, **kwargs)
            self._enter(name)
            try:
                result = function(*args, **kwargs)
                self._label(result, name)
            finally:
                self._leave()
            return result

        return timed

    def _label(self, result: Any, name: str) -> None:
        """Time the unnamed nodes behind ``result`` under ``name`` in the backward pass."""
        nodes = [tensor.grad_fn for tensor in _tensors(result)]
        while nodes:
            node = nodes.pop()
            if node is None or node in self._labelled:
                continue
            self._labelled.add(node)
            self._hooks += [node.register_prehook(lambda _: self._enter(name)), node.register_hook(self._left)]
            nodes += [following for following, _ in node.next_functions]


def _tensors(value: Any) -> Iterator[Tensor]:
    """Yield all tensors in the result of a function."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, tuple | list):
        for item in value:
            yield from _tensors(item)
    elif hasattr(value, "__dict__") and not isinstance(value, type):
        for item in vars(value).values():
            if isinstance(item, Tensor | tuple | list):
                yield from _tensors(item)
