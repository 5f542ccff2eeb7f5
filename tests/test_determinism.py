"""Equal bits from run to run: the gradient of frames, and the torch operations of one step of each stage."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from tiny import run, tiny_config, tiny_personal_head
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mgavatar.appearance.model import build_appearance
from mgavatar.appearance.stage import AppearanceStage
from mgavatar.config import HeadTuningConfig
from mgavatar.fitting.stage import Stage
from mgavatar.geometry.stage import GeometryStage
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.kernels.binding import bind_to_faces
from mgavatar.kernels.face_frames import gather_matrix

ADDS_IN_ANY_ORDER = {
    "index_add", "index_put", "_index_put_impl", "scatter_add", "scatter_reduce", "index_reduce", "put", "bincount",
    "cumsum", "histc", "kthvalue", "median", "embedding_dense_backward", "grid_sampler_2d_backward",
    "upsample_nearest2d_backward", "upsample_bilinear2d_backward", "upsample_bicubic2d_backward",
    "_adaptive_avg_pool2d_backward", "max_pool2d_with_indices_backward", "reflection_pad2d_backward",
    "replication_pad2d_backward",
}  # fmt: skip
"""Operations that add floats in any order on CUDA, or on a CPU with several threads, as torch documents."""


@contextmanager
def torch_threads(n: int) -> Iterator[None]:
    """Let torch use ``n`` CPU threads inside."""
    before = torch.get_num_threads()
    torch.set_num_threads(n)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@pytest.fixture
def deterministic() -> Iterator[None]:
    """Let torch raise where it has no deterministic implementation."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


class Recorder(TorchDispatchMode):
    """Collect the names of all operations on floats, those of the backward pass too.

    Sums of integers, such as counts and offsets, are the same in any order.
    """

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if any(isinstance(x, Tensor) and x.is_floating_point() for x in tree_leaves(args)):
            self.names.add(func.overloadpacket.__name__.rstrip("_"))
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("prepared", [True, False])
def test_frames_get_the_same_gradient_from_many_gaussians(prepared, rng):
    """Three Gaussians per face, far apart in the list: two threads that add with atomics differ from run to run."""
    n_faces = 8000
    face_ids = torch.arange(n_faces).repeat(3)
    n = len(face_ids)
    quats = torch.nn.functional.normalize(torch.randn(n_faces, 4, generator=rng), dim=1)
    frames = quats, torch.rand(n_faces, generator=rng), torch.randn(n_faces, 3, generator=rng)
    local = [torch.randn(n, k, generator=rng) for k in (3, 4, 3)]
    v_outputs = [torch.randn(n, k, generator=rng) for k in (3, 4, 3)]
    order = gather_matrix(face_ids, n_faces) if prepared else None

    def gradients() -> list[Tensor]:
        leaves = [x.clone().requires_grad_() for x in frames]
        outputs = bind_to_faces(leaves, face_ids, *local, torch.zeros(n), order=order)
        torch.autograd.backward(outputs[:3], v_outputs)
        return [x.grad for x in leaves]

    with torch_threads(1):
        expected = gradients()
    with torch_threads(2):
        for _ in range(20):
            assert all(torch.equal(a, b) for a, b in zip(gradients(), expected, strict=True))


def _stage(name: str, subject: Any) -> Stage:
    baseline = {"colors": "sh", "head_tuning": HeadTuningConfig(enabled=True)}
    config = tiny_config(appearance=baseline if name == "baseline" else None)
    head = tiny_personal_head(subject, config)
    if name == "geometry":
        return GeometryStage(VertexGaussians(head, config), config)
    return AppearanceStage(build_appearance(head, config, seed=0), config, seed=0)


@pytest.mark.parametrize("name", ["geometry", "appearance", "baseline"])
def test_a_step_uses_deterministic_operations_only(name, subject, views, deterministic):
    """Torch raises at those that it knows on this device; the recorded names cover the devices that are not here."""
    stage = _stage(name, subject)
    with Recorder() as recorder:
        run(stage, views, 5)  # with a round of density control
    assert {"mul", "cat"} <= recorder.names, "nothing was recorded"
    assert recorder.names & ADDS_IN_ANY_ORDER == set()
