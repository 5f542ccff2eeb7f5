"""Every kernel at extreme inputs: each row of the table is one test, and none is skipped."""

from __future__ import annotations

import pytest
import torch
from extreme_cases import Case, bounds, measure
from extreme_mesh import cases as mesh_cases
from extreme_raster import cases as raster_cases

BUILDS = {
    "blocks float32": (torch.float32, "blocks"),
    "plain float32": (torch.float32, "plain"),
    "plain float64": (torch.float64, "plain"),
}
RASTER = {case.id: case for case in raster_cases()}
MESH = {case.id: case for case in mesh_cases()}


def assert_row(
    case: Case, direction: str, dtype: torch.dtype, *, device: torch.device | str = "cpu", **build: str
) -> None:
    """The row's errors are within its bounds, or its refusal is the one that it states."""
    if case.expect == "refused":
        inputs = [tensor.to(device, dtype) for tensor in case.inputs(torch.Generator())]
        leaves = [tensor.requires_grad_(direction == "gradient") for tensor in inputs]
        with pytest.raises(ValueError, match=case.message):
            case.op(*leaves, **build)
        return
    measured = measure(case, dtype, device=device, **build)
    error, bound = getattr(measured, direction), getattr(bounds(case, dtype), direction)
    assert error <= bound, f"{case.id}: {direction} error {error:.2e}"


@pytest.mark.parametrize("direction", ["forward", "gradient"])
@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.parametrize("row", RASTER)
def test_rasterizer(row, build, direction, device):
    """Each form and precision of the rasterizer that the device has."""
    dtype, form = BUILDS[build]
    if form == "blocks" and device.type != "cpu":
        pytest.skip("the block form is the CPU's")
    assert_row(RASTER[row], direction, dtype, device=device, form=form)


@pytest.mark.parametrize("direction", ["forward", "gradient"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("row", MESH)
def test_mesh_kernels(row, dtype, direction):
    """Each precision of the mesh kernels."""
    assert_row(MESH[row], direction, dtype)


def test_the_table_is_complete():
    """At least 40 extremes, no two rows alike."""
    assert len(raster_cases()) == len(RASTER) >= 40
    assert len(mesh_cases()) == len(MESH) >= 40
