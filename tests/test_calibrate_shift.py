"""The ball of known radius that the surface shift is calibrated on."""

from __future__ import annotations

import calibrate_shift as tool
import numpy as np
import pytest
import torch
from markdown_cells import cells_of


def test_the_disc_is_as_large_as_a_ball_looks():
    """From 1 m the outline of a ball is that of its tangent cone, a little larger than the ball's own radius."""
    camera = tool.cameras(200.0, 64)[3]
    image = tool.photograph(camera, "disc", torch.ones(3))
    covered = ((1.0 - image[0]) / (1.0 - 0.4)).sum().item()
    radius = 200.0 * tool.RADIUS / np.sqrt(tool.DISTANCE**2 - tool.RADIUS**2)
    assert covered == pytest.approx(np.pi * radius**2, rel=3e-3)
    assert image[:, 32, 32].tolist() == pytest.approx([0.4] * 3)


def test_a_texture_stays_where_it_is_on_the_ball():
    """The middle of each picture shows the point of the ball that faces the camera."""
    for camera in tool.cameras(800.0, 64)[::5]:
        image = tool.photograph(camera, "texture", torch.ones(3), samples=1)
        facing = tool.pattern(tool.RADIUS * camera.position / np.linalg.norm(camera.position), "texture")
        assert np.allclose(image[:, 31:33, 31:33].mean((1, 2)), facing, atol=0.01)


def test_gaussians_settle_inside_and_the_shift_brings_the_vertices_back():
    """An outline pulls the vertices further inside than a texture; one shift serves both to a millimetre or two."""
    surfaces = ("disc", "texture")
    disc, texture = (tool.calibrate(0.35, 2.0, surface, 0.0, iterations=60) for surface in surfaces)
    assert -0.02 < disc < texture < -1e-3
    disc, texture = (tool.calibrate(0.35, 2.0, surface, 2.0, iterations=60) for surface in surfaces)
    assert abs(disc) < 1e-3
    assert abs(texture) < 2e-3


def test_the_table_has_a_row_per_combination(monkeypatch):
    """Errors in millimetres, with their signs; the fits themselves are tested above."""
    monkeypatch.setattr(tool, "calibrate", lambda sigma, edge_px, surface, shift: 1e-3 * (shift - sigma))
    rows = cells_of(tool.table((0.25, 0.5), (3.0,)))
    assert len(rows) == 1 + 4
    assert rows[1] == ["0.25", "3 px", "disc", "-0.25", "+1.25", "+1.55", "+1.75", "+2.25"]
