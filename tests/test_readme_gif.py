"""``tools/readme_gif.py``: a GIF that loops, with the avatar and its mesh on pure white."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from readme_gif import cropped, panel_palette, readme_gif
from tiny_avatar import tiny_avatar

from mgavatar.errors import DataError


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """An avatar and a motion of six frames at 25 per second."""
    root = tmp_path_factory.mktemp("gif")
    tiny_avatar(root)[0].save(root / "avatar.pt")
    np.savez(root / "driving.npz", neck_pose=np.linspace([0.0, -0.3, 0.0], [0.0, 0.3, 0.0], 6, dtype=np.float32))
    return root


def test_a_gif_of_every_second_frame(inputs):
    """Three frames at half the rate, which loop; both panels show something, and the background is white."""
    out = inputs / "driven.gif"
    text = readme_gif(avatar=inputs / "avatar.pt", driving=inputs / "driving.npz", out=out, height=48, colors=32)
    with Image.open(out) as gif:
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"]) == (3, 80, 0)
        assert text.startswith(f"{out}: {gif.width} x 48, 3 frames")
        for index in range(gif.n_frames):
            gif.seek(index)
            pixels = np.asarray(gif.convert("RGB"))
            halves = np.array_split(pixels, 2, axis=1)
            assert len(np.unique(pixels.reshape(-1, 3), axis=0)) <= 32
            assert np.all(pixels[0, 0] == 255)
            assert all((half < 255).any() for half in halves)
            assert (halves[0] != halves[1][:, : halves[0].shape[1]]).any()


def test_what_is_refused(inputs, tmp_path):
    """A GIF that is there already, another kind of file, and numbers out of range, before anything is drawn."""
    files = {"avatar": inputs / "avatar.pt", "driving": inputs / "driving.npz"}
    (tmp_path / "old.gif").write_bytes(b"GIF89a")
    with pytest.raises(DataError, match=r"old\.gif: .*exists; .*--overwrite"):
        readme_gif(**files, out=tmp_path / "old.gif")
    with pytest.raises(DataError, match=r"frames: give a name that ends in \.gif"):
        readme_gif(**files, out=tmp_path / "frames")
    with pytest.raises(DataError, match="--colors"):
        readme_gif(**files, out=tmp_path / "new.gif", colors=256)
    assert [path.name for path in tmp_path.iterdir()] == ["old.gif"]


def test_columns_that_any_picture_uses_are_kept():
    """The same cut for all pictures, so that nothing jumps; pictures of nothing are refused."""
    image, mesh = np.full((2, 4, 60, 3), 255, np.uint8)
    image[2, 20] = 0
    mesh[1, 39, 1] = 254
    ((left, right),) = cropped([(image, mesh)])
    assert left.shape == right.shape == (4, 36, 3)
    assert not left[2, 8].any()
    assert right[1, -9, 1] == 254
    with pytest.raises(DataError, match="sees nothing"):
        cropped([(np.full((4, 6, 3), 255, np.uint8),) * 2])


def test_a_palette_of_what_is_there():
    """Two colours beside white give these two, whatever the number that is allowed."""
    picture = np.full((8, 8, 3), 255, np.uint8)
    picture[:2], picture[6:] = (200, 10, 30), (0, 90, 250)
    palette = panel_palette([picture] * 3, colors=16)
    assert {tuple(color) for color in palette} >= {(200, 10, 30), (0, 90, 250)}
    assert len(palette) <= 16
