"""The measure of what an avatar's parts contribute: shares of made-up offsets, and a table for a real avatar."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).resolve().parents[1] / "tools"))

import parts

AVATAR = Path(__file__).parent / "data" / "format2_color_net.pt"


def test_the_share_that_varies():
    """Nothing of what is the same in all poses, all of what cancels over them, and a known mixture."""
    constant = torch.ones(4, 10, 3)
    swinging = torch.tensor([1.0, -1.0, 1.0, -1.0])[:, None, None] * constant
    assert parts.variable_share(constant) == 0.0
    assert parts.variable_share(swinging) == 1.0
    assert parts.variable_share(2.0 * constant + swinging) == pytest.approx(0.2)
    assert parts.variable_share(torch.zeros(4, 2)) == 0.0


def test_an_avatar_in_parts(tmp_path):
    """The table and the file have the same parts; an avatar of format 2 keeps its constant in the pose offsets."""
    table = parts.parts(AVATAR, json=tmp_path / "parts.json")
    found = json.loads((tmp_path / "parts.json").read_text())
    assert found["offsets"]["pose_share"] < 0.5
    assert found["offsets"]["pose_constant_mm"] > 0.0
    assert set(found["offset_net"]) == set(parts.GROUPS)
    assert 0.0 <= found["binding"]["beyond_position"] <= 1.0
    assert "energy that depends on the pose" in table
