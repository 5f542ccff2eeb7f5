"""Avatars of every past format load and draw what they drew when they were written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from mgavatar.avatar import Avatar
from mgavatar.avatar_file import _UPGRADES, FORMAT
from mgavatar.camera import Camera
from mgavatar.head.params import Pose

FILES = sorted((Path(__file__).parent / "data").glob("format*.pt"))
"""One small avatar per format and kind of colour; the ``.npz`` beside it holds a pose, a camera and its image then."""


def test_every_past_format_has_a_file():
    """A new format needs a file of the one that it replaces."""
    kept = {f"mgavatar/{path.stem.split('_')[0].removeprefix('format')}" for path in FILES}
    assert set(_UPGRADES) <= kept
    assert FORMAT not in _UPGRADES


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_past_avatar_draws_the_same_image(path):
    """The image is that of the version that wrote the file, to a hundredth of a grey level."""
    then = np.load(path.with_suffix(".npz"))
    names = ("expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation")
    pose = Pose(**{name: torch.from_numpy(then[name]) for name in names})
    camera = Camera(then["viewmat"], then["K"], *map(int, then["size"]))
    image = Avatar.load(path).render(pose, camera).image
    assert np.abs(image.numpy() - then["image"]).max() < 0.01 / 255.0


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_past_avatar_is_saved_in_the_present_format(path, tmp_path):
    """Loading and saving is all that it takes to upgrade a file, and nothing is lost on the way."""
    avatar = Avatar.load(path)
    avatar.save(tmp_path / "avatar.pt")
    assert torch.load(tmp_path / "avatar.pt", weights_only=True)["format"] == FORMAT
    again = Avatar.load(tmp_path / "avatar.pt")
    for name, value in avatar.vertex_gaussians.state_dict().items():
        assert torch.equal(again.vertex_gaussians.state_dict()[name], value)
    assert again.config == avatar.config
