"""Tensors follow their module to another device, and states of another device are brought over when they are loaded.

The second device of a machine without an accelerator is ``meta``: nothing can be computed there, so everything is built
on the CPU, moved, and given a state from the CPU. What is then left on the CPU would end a resumed fit on CUDA.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import WHITE, run, tiny_personal_head, tiny_resolved
from torch import Tensor, nn

import mgavatar
from mgavatar.appearance.model import build_appearance
from mgavatar.appearance.stage import AppearanceStage
from mgavatar.capture.subject import Subject
from mgavatar.config import ResolvedConfig
from mgavatar.fitting.stage import Stage
from mgavatar.fitting.views import Views
from mgavatar.geometry.stage import GeometryStage
from mgavatar.geometry.vertex_gaussians import VertexGaussians

META = torch.device("meta")

ON_THE_HOST = {"parents"}
"""Attributes that only the host reads, whatever the device: ``Body.parents``."""

pytestmark = pytest.mark.filterwarnings("ignore:for .* copying from a non-meta parameter")


def tensors_of(thing: Any, path: str = "", seen: set[int] | None = None) -> Iterator[tuple[str, Tensor]]:
    """Yield every tensor that can be reached from an object, with its path: attributes, containers, gradients."""
    seen = set() if seen is None else seen
    if id(thing) in seen or isinstance(thing, type):
        return
    seen.add(id(thing))
    if isinstance(thing, Tensor):
        yield path, thing
        parts = [(".grad", thing.grad)]
    elif isinstance(thing, dict):
        parts = [(f"[{key if isinstance(key, str | int) else '...'}]", value) for key, value in thing.items()]
    elif isinstance(thing, list | tuple):
        parts = [(f"[{index}]", value) for index, value in enumerate(thing)]
    else:
        parts = [(f".{name}", value) for name, value in getattr(thing, "__dict__", {}).items()]
    for name, value in parts:
        if name.lstrip(".") not in ON_THE_HOST:
            yield from tensors_of(value, path + name, seen)


def left_behind(thing: Any) -> list[str]:
    """List the paths of the tensors that are not on ``meta``."""
    return [path for path, tensor in tensors_of(thing) if tensor.device != META]


def module_of(name: str, subject: Subject, views: Views) -> nn.Module:
    """Return the module that a stage learns, after steps that have filled its caches."""
    config = tiny_resolved()
    head = tiny_personal_head(subject, config)
    torch.manual_seed(0)
    module = VertexGaussians(head, config) if name == "geometry" else build_appearance(head, config, seed=0)
    run(stage_of(module, config), views, 5)
    return module


def stage_of(module: nn.Module, config: ResolvedConfig) -> Stage:
    if isinstance(module, VertexGaussians):
        return GeometryStage(module, config)
    return AppearanceStage(module, config, seed=0)


@pytest.mark.parametrize("name", ["geometry", "appearance"])
def test_a_module_takes_everything_along(name, subject, views):
    """``to`` moves parameters, buffers, prepared matrices and caches, and the head that an appearance is bound to."""
    module = module_of(name, subject, views)
    known = dict(tensors_of(module))
    assert len(known) > 50
    assert {tensor.device.type for tensor in known.values()} == {"cpu"}
    assert module.to(META) is module
    assert left_behind(module) == []
    assert len(list(tensors_of(module))) > 40


@pytest.mark.parametrize("name", ["geometry", "appearance"])
def test_a_loaded_state_is_brought_over(name, subject, views, monkeypatch):
    """A checkpoint is read to the CPU; after loading it, nothing of a stage is there any more."""
    config = tiny_resolved()
    trained = stage_of(module_of(name, subject, views), config)
    run(trained, views, 5)  # past the first round of density control, which changes the number of Gaussians
    module = module_of(name, subject, views).to(META)
    with monkeypatch.context() as patch:  # fused Adam refuses parameters on meta; the loaded state says fused again
        adam = torch.optim.Adam
        patch.setattr(torch.optim, "Adam", lambda groups, *, eps, fused: adam(groups, eps=eps))
        stage = stage_of(module, config)
    stage.load_state_dict(copy.deepcopy(trained.state_dict()))
    assert any("exp_avg" in path for path, _ in tensors_of(stage.optimizer))
    assert left_behind(stage) == []


@pytest.mark.parametrize("name", ["geometry", "appearance"])
def test_a_stage_goes_on_from_a_state_of_the_cpu(name, subject, views, device):
    """On every device that this machine has, with Gaussians added before."""
    config = tiny_resolved()
    trained = stage_of(module_of(name, subject, views), config)
    run(trained, views, 5)
    stage = stage_of(module_of(name, subject, views).to(device), config)
    stage.load_state_dict(copy.deepcopy(trained.state_dict()))
    target = views.target(0, WHITE.to(device), WHITE.to(device))
    terms = stage.step(views.cameras[0], views.timesteps[0], target, WHITE.to(device))
    assert terms["loss"] == pytest.approx(run(trained, views, 1)[0]["loss"], rel=1e-3)


def test_a_loaded_state_is_copied(subject, views):
    """What density control collects afterwards does not change the checkpoint."""
    stage = stage_of(module_of("appearance", subject, views), tiny_resolved())
    run(stage, views, 1)
    state = copy.deepcopy(stage.density.state_dict())
    before = copy.deepcopy(state)
    stage.density.load_state_dict(state)
    run(stage, views, 1)
    assert not torch.equal(stage.density.total, before["total"])
    assert all(torch.equal(state[name], before[name]) for name in before)


def test_every_loader_is_covered(subject, views):
    """A class that loads a state of its own is part of a stage, so that the tests above see it."""
    stages = [stage_of(module_of(name, subject, views), tiny_resolved()) for name in ("geometry", "appearance")]
    covered = {type(thing).__name__ for stage in stages for thing in (stage, *vars(stage).values())}
    package = Path(mgavatar.__file__).parent
    loaders = {
        node.name
        for path in package.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ClassDef) and not any(ast.unparse(base) == "Protocol" for base in node.bases)
        and any(isinstance(part, ast.FunctionDef) and part.name == "load_state_dict" for part in node.body)
    }  # fmt: skip
    assert {"GeometryStage", "AppearanceStage", "DensityControl"} <= loaders
    assert loaders <= covered
