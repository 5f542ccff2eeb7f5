"""The ball of known radius that the surface shift is calibrated on."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

PATH = Path(__file__).resolve().parent.parent / "tools" / "calibrate_shift.py"


@pytest.fixture(scope="module")
def tool():
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("calibrate_shift", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_disc_is_as_large_as_a_ball_looks(tool):
    """From 1 m the outline of a ball is that of its tangent cone, a little larger than the ball's own radius."""
    camera = tool.cameras(200.0, 64)[3]
    image = tool.photograph(camera, "disc", torch.ones(3))
    covered = ((1.0 - image[0]) / (1.0 - 0.4)).sum().item()
    radius = 200.0 * tool.RADIUS / np.sqrt(tool.DISTANCE**2 - tool.RADIUS**2)
    assert covered == pytest.approx(np.pi * radius**2, rel=3e-3)
    assert image[:, 32, 32].tolist() == pytest.approx([0.4] * 3)


def test_a_texture_stays_where_it_is_on_the_ball(tool):
    """The middle of each picture shows the point of the ball that faces the camera."""
    for camera in tool.cameras(800.0, 64)[::5]:
        image = tool.photograph(camera, "texture", torch.ones(3), samples=1)
        facing = tool.pattern(tool.RADIUS * camera.position / np.linalg.norm(camera.position), "texture")
        assert np.allclose(image[:, 31:33, 31:33].mean((1, 2)), facing, atol=0.01)


def test_gaussians_settle_inside_and_the_shift_brings_the_vertices_back(tool):
    """An outline pulls the vertices further inside than a texture; one shift serves both to a millimetre or two."""
    surfaces = ("disc", "texture")
    disc, texture = (tool.calibrate(0.35, 2.0, surface, 0.0, iterations=60) for surface in surfaces)
    assert -0.02 < disc < texture < -1e-3
    disc, texture = (tool.calibrate(0.35, 2.0, surface, 2.0, iterations=60) for surface in surfaces)
    assert abs(disc) < 1e-3
    assert abs(texture) < 2e-3
