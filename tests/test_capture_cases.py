"""Captures as people have them: each kind is read as it was meant, or refused with the remedy."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import write_capture, write_transforms
from PIL import Image
from tiny import tiny_head, write_tiny_capture

from mgavatar.capture.images import check_images, read_images, read_masks
from mgavatar.capture.placement import check_placement
from mgavatar.capture.read import read_capture
from mgavatar.capture.subject import SPLITS
from mgavatar.config import background_color
from mgavatar.errors import DataError
from mgavatar.fitting.views import Views


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "deep/er/subject")


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.INFO, logger="mgavatar")
    return caplog


def edit_frames(root: Path, change: Callable[[dict], object]) -> None:
    """Change every frame of every split in place."""
    for split in SPLITS:
        frames = json.loads((root / f"transforms_{split}.json").read_text())["frames"]
        for frame in frames:
            change(frame)
        write_transforms(root, split, frames)


def edit_params(root: Path, timestep: int, **changes: np.ndarray) -> None:
    path = root / f"flame_param/{timestep:05d}.npz"
    with np.load(path) as content:
        arrays = {**content, **changes}
    np.savez(path, **arrays)


def refusal(action: Callable[[], object]) -> str:
    with pytest.raises(DataError) as caught:
        action()
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ---- masks ----


def binary(mask: np.ndarray) -> Image.Image:
    return Image.fromarray((mask > 127).astype(np.uint8))


def binary_of_16_bits(mask: np.ndarray) -> Image.Image:
    return Image.fromarray((mask > 127).astype(np.uint16))


def in_a_wider_type(mask: np.ndarray) -> Image.Image:
    return Image.fromarray(mask.astype(np.uint16))


def of_16_bits(mask: np.ndarray) -> Image.Image:
    return Image.fromarray(mask.astype(np.uint16) * 257)


def palette(mask: np.ndarray) -> Image.Image:
    image = Image.fromarray((mask > 127).astype(np.uint8), "P")
    image.putpalette([0, 0, 0, 128, 0, 0])
    return image


def in_alpha_of_rgba(mask: np.ndarray) -> Image.Image:
    return Image.fromarray(np.dstack([np.full((*mask.shape, 3), 77, np.uint8), mask]))


def in_alpha_of_la(mask: np.ndarray) -> Image.Image:
    return Image.merge("LA", [Image.new("L", mask.shape[::-1], 255), Image.fromarray(mask)])


def rgb(mask: np.ndarray) -> Image.Image:
    return Image.fromarray(np.repeat(mask[..., None], 3, axis=2))


def opaque_rgba(mask: np.ndarray) -> Image.Image:
    return rgb(mask).convert("RGBA")


KINDS = [
    binary, binary_of_16_bits, in_a_wider_type, of_16_bits, palette, in_alpha_of_rgba, in_alpha_of_la, rgb, opaque_rgba
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_mask_is_the_same_mask(root, kind):
    before = read_masks(read_capture(root).frames["train"])
    for path in (root / "fg_masks").iterdir():
        kind(np.asarray(Image.open(path))).save(path)
    subject = read_capture(root)
    np.testing.assert_array_equal(read_masks(subject.frames["train"]).numpy(), before.numpy())
    check_images(subject)


@pytest.mark.parametrize("kind", [in_a_wider_type, of_16_bits, in_alpha_of_rgba, in_alpha_of_la, rgb])
def test_soft_masks_stay_soft(root, kind):
    frame = read_capture(root).frames["train"][0]
    soft = np.arange(32 * 24, dtype=np.uint32).reshape(32, 24) * 255 // (32 * 24 - 1)
    kind(soft.astype(np.uint8)).save(frame.mask_path)
    np.testing.assert_array_equal(read_masks([frame])[0].numpy(), soft)


def test_an_empty_mask_and_one_of_ones(root):
    frame = read_capture(root).frames["train"][0]
    for value, expected in ((0, 0), (1, 255)):
        Image.fromarray(np.full((32, 24), value, np.uint8)).save(frame.mask_path)
        assert (read_masks([frame]) == expected).all()


def test_masks_for_some_frames_are_used_where_they_are(root, said):
    """The others keep their background, and one line says so."""
    edit_frames(root, lambda frame: frame.pop("fg_mask_path") if frame["timestep_index"] == 1 else None)
    subject = read_capture(root)
    check_images(subject)
    (message,) = said.messages
    assert "2 of 6 training images have no mask" in message
    assert "00001_00.png" in message
    views = Views.of(subject, 64, with_masks=True)
    assert views.has_mask == [True, True, False, False, True, True]
    assert views.masks is not None
    expected = read_masks([subject.frames["train"][4]])[0]
    np.testing.assert_array_equal(views.masks[4].numpy(), expected.numpy())
    assert views.masks[2].min() == 255
    assert Views.of(subject, 64, with_masks=False).has_mask == [False] * 6


# ---- backgrounds ----


def paint_behind(root: Path, paint: Callable[[np.ndarray], np.ndarray]) -> None:
    """Replace what is outside the masks of all images."""
    for path in (root / "images").iterdir():
        pixels, mask = np.array(Image.open(path)), np.asarray(Image.open(root / "fg_masks" / path.name))
        Image.fromarray(np.where(mask[..., None] > 127, pixels, paint(pixels))).save(path)


def room(pixels: np.ndarray) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, pixels.shape, np.uint8)


def white_wall(pixels: np.ndarray) -> np.ndarray:
    """A room most of whose wall is white."""
    wall = np.full_like(pixels, 250)
    wall[: len(wall) // 2, : wall.shape[1] // 2] = (80, 60, 40)
    return wall


def green_screen(pixels: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.array([0, 255, 0], np.uint8), pixels.shape)


@pytest.mark.parametrize("behind", [room, white_wall, green_screen])
def test_raw_frames_are_composited_by_their_masks(root, said, behind):
    """Every reader of the images gets them on the stated background, and one line says so."""
    before = read_images(read_capture(root).frames["train"])
    paint_behind(root, behind)
    subject = read_capture(root)
    np.testing.assert_array_equal(read_images(subject.frames["train"]).numpy(), before.numpy())
    check_images(subject)
    (message,) = said.messages
    assert "12 of 12 images show something else than the stated background" in message
    assert "composited on it (RGB 1, 1, 1) with their masks" in message
    assert ("--background 0,255,0 would keep theirs" in message) == (behind is green_screen)


def test_a_stated_colour_is_kept(root, said):
    paint_behind(root, green_screen)
    subject = read_capture(root, background="0,255,0")
    np.testing.assert_array_equal(subject.background, [0.0, 1.0, 0.0])
    check_images(subject)
    assert not said.messages
    image = np.asarray(Image.open(subject.frames["train"][0].image_path)).transpose(2, 0, 1)
    np.testing.assert_array_equal(read_images(subject.frames["train"][:1])[0].numpy(), image)


def test_the_outline_loses_the_plain_background_that_it_is_mixed_with(root):
    """The share of a known background in a pixel is exchanged; multiplying by the matte would leave a fringe."""
    frame = read_capture(root).frames["train"][0]
    alpha = np.tile(np.linspace(0.0, 1.0, 24), (32, 1))[..., None]
    alpha[:, :8] = 0.0
    skin, green, white = (np.array(color, float) for color in ((180, 120, 90), (0, 255, 0), (255, 255, 255)))
    Image.fromarray(np.rint(alpha * skin + (1 - alpha) * green).astype(np.uint8)).save(frame.image_path)
    Image.fromarray(np.rint(255 * alpha[..., 0]).astype(np.uint8)).save(frame.mask_path)
    found = read_images([frame])[0].permute(1, 2, 0).numpy()
    assert np.abs(found - (alpha * skin + (1 - alpha) * white)).max() <= 2.0


def test_a_tight_mask_leaves_a_composited_image_alone(root, said):
    """Hair that a mask has missed is no other background."""
    frame = read_capture(root).frames["train"][0]
    mask = np.array(Image.open(frame.mask_path))
    mask[: len(mask) // 4] = 0
    Image.fromarray(mask).save(frame.mask_path)
    image = np.asarray(Image.open(frame.image_path)).transpose(2, 0, 1)
    np.testing.assert_array_equal(read_images([frame])[0].numpy(), image)


def test_a_plain_colour_without_masks_is_measured_and_named(tmp_path, said):
    root = write_capture(tmp_path / "subject", masks=False)
    for path in (root / "images").iterdir():
        pixels = np.array(Image.open(path))
        pixels[(pixels == 255).all(-1)] = (90, 120, 60)
        Image.fromarray(pixels).save(path)
    check_images(read_capture(root))
    assert "give them masks, or give --background 90,120,60" in said.messages[0]
    said.clear()
    check_images(read_capture(root, background="90,120,60"))
    assert not said.messages


@pytest.mark.parametrize(
    ("text", "color"),
    [("white", (1, 1, 1)), ("0,255,0", (0, 1, 0)), ("0.5, 0, 1", (0.5, 0, 1)), ("51,0,0", (0.2, 0, 0))],
)
def test_backgrounds_as_text(text, color):
    assert background_color(text) == pytest.approx(color)


@pytest.mark.parametrize("text", ["", "grey", "1,2", "1,2,3,4", "-1,0,0", "256,0,0", "nan,0,0", "inf,0,0"])
def test_no_backgrounds(text):
    with pytest.raises(ValueError, match="white, black or R,G,B"):
        background_color(text)


# ---- mattes in the images ----


def into_alpha(root: Path, *, hidden: tuple[int, int, int]) -> None:
    """Move the masks into the alpha channels of the images."""
    for path in (root / "images").iterdir():
        pixels, mask = np.array(Image.open(path)), np.asarray(Image.open(root / "fg_masks" / path.name))
        pixels[mask == 0] = hidden
        Image.fromarray(np.dstack([pixels, mask])).save(path)
    shutil.rmtree(root / "fg_masks")
    edit_frames(root, lambda frame: frame.pop("fg_mask_path"))


@pytest.mark.parametrize("hidden", [(0, 0, 0), (20, 200, 90), (255, 255, 255)])
@pytest.mark.parametrize("background", ["white", "black", "0,0,255"])
def test_the_matte_in_an_images_alpha_is_its_mask(root, hidden, background):
    before = read_capture(root).frames["train"]
    masks = read_masks(before)
    images = read_images(before).float()
    into_alpha(root, hidden=hidden)
    subject = read_capture(root, background=background)
    check_images(subject)
    np.testing.assert_array_equal(read_masks(subject.frames["train"]).numpy(), masks.numpy())
    color = np.array(background_color(background))[:, None, None] * 255.0
    expected = np.where(masks[:, None].numpy() == 255, images.numpy(), color)
    np.testing.assert_array_equal(read_images(subject.frames["train"]).numpy(), expected)


def test_an_opaque_alpha_channel_is_no_matte(root):
    for path in (root / "images").iterdir():
        Image.open(path).convert("RGBA").save(path)
    edit_frames(root, lambda frame: frame.pop("fg_mask_path"))
    subject = read_capture(root)
    check_images(subject)
    assert all(frame.mask_path is None for frame in subject.frames["train"])


def test_soft_alpha_is_composited(root):
    frame = read_capture(root).frames["train"][0]
    pixels = np.dstack([np.full((32, 24, 3), 100, np.uint8), np.full((32, 24), 51, np.uint8)])
    Image.fromarray(pixels).save(frame.image_path)
    assert (read_images([frame]) == round(0.2 * 100 + 0.8 * 255)).all()


# ---- sizes, endings, orientations ----


def test_sizes_come_from_the_images_where_the_file_has_none(root):
    """As in captures for NeRF: the focal length is then that of camera_angle_x."""
    before = read_capture(root)
    edit_frames(root, lambda frame: [frame.pop(key) for key in ("w", "h", "cx", "cy", "fl_x", "fl_y")])
    after = read_capture(root)
    for a, b in zip(before.frames["train"], after.frames["train"], strict=True):
        assert (a.camera.width, a.camera.height) == (b.camera.width, b.camera.height)
        np.testing.assert_allclose(a.camera.K, b.camera.K)


@pytest.mark.parametrize(("stored", "named"), [(".png", ""), (".jpg", ".png"), (".JPG", ""), (".webp", ".jpeg")])
def test_endings_are_found(root, stored, named):
    for path in (root / "images").iterdir():
        Image.open(path).save(path.with_suffix(stored), quality=95)
        path.unlink() if stored != ".png" else None
    edit_frames(root, lambda frame: frame.update(file_path=frame["file_path"].removesuffix(".png") + named))
    subject = read_capture(root)
    check_images(subject)
    assert subject.frames["train"][0].image_path.name == f"00000_00{stored}"


def test_no_ending_helps_an_image_that_is_not_there(root):
    (root / "images/00001_00.png").unlink()
    assert "images/00001_00.png does not exist" in refusal(lambda: read_capture(root))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_exif_orientation(root, orientation, kind):
    """The image is turned as every viewer shows it, and its size with it."""
    pixels = np.asarray(Image.open(root / "images/00000_00.png")).copy()
    pixels[:10, :8] = 0
    undo = {
        1: pixels,
        2: pixels[:, ::-1],
        3: pixels[::-1, ::-1],
        4: pixels[::-1],
        5: pixels.swapaxes(0, 1),
        6: np.rot90(pixels, 1),
        7: np.rot90(pixels, 2).swapaxes(0, 1),
        8: np.rot90(pixels, -1),
    }
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = Image.fromarray(np.ascontiguousarray(undo[orientation]))
    stored.save(root / f"images/turned.{kind}", exif=exif, quality=100, subsampling=0)
    frame = read_capture(root).frames["train"][0]
    turned = replace(frame, image_path=root / f"images/turned.{kind}", mask_path=None)
    found = read_images([turned])[0].permute(1, 2, 0).numpy().astype(int)
    assert np.abs(found - pixels).mean() < 4.0
    edit_frames(root, lambda frame: [frame.pop(key) for key in ("w", "h", "fg_mask_path")])
    edit_frames(root, lambda frame: frame.update(file_path=f"images/turned.{kind}"))
    assert read_capture(root).frames["train"][0].camera.width == 24


def test_an_image_that_was_calibrated_as_stored_is_not_turned(root):
    exif = Image.Exif()
    exif[0x0112] = 6
    path = root / "images/00000_00.png"
    before = np.asarray(Image.open(path))
    Image.fromarray(before).save(path, exif=exif)
    frame = read_capture(root).frames["train"][0]
    np.testing.assert_array_equal(read_images([frame])[0].permute(1, 2, 0).numpy(), before)


# ---- links ----


def test_a_linked_folder_is_followed_and_said(root, tmp_path, said):
    shutil.move(root / "images", tmp_path / "disk2")
    (root / "images").symlink_to(tmp_path / "disk2")
    subject = read_capture(root)
    assert subject.frames["train"][0].image_path == tmp_path.resolve() / "disk2/00000_00.png"
    (message,) = said.messages
    assert "images: is a link to " in message
    assert "disk2" in message


def test_a_linked_sequence_beside_a_union_is_followed(tmp_path):
    write_capture(tmp_path / "disk2/seq")
    union = tmp_path / "inner/deep/union"
    union.mkdir(parents=True)
    (tmp_path / "inner/deep/seq").symlink_to(tmp_path / "disk2/seq")
    frames = json.loads((tmp_path / "disk2/seq/transforms_train.json").read_text())["frames"]
    for frame in frames:
        frame.update({key: f"../seq/{frame[key]}" for key in ("file_path", "fg_mask_path", "flame_param_path")})
    write_transforms(union, "train", frames)
    assert len(read_capture(union).frames["train"]) == 6


def test_a_linked_file_is_followed_on_request(root, tmp_path):
    shutil.move(root / "images/00000_01.png", tmp_path / "elsewhere.png")
    (root / "images/00000_01.png").symlink_to(tmp_path / "elsewhere.png")
    assert "--follow-links" in refusal(lambda: read_capture(root))
    subject = read_capture(root, follow_links=True)
    assert subject.frames["train"][1].image_path == tmp_path.resolve() / "elsewhere.png"


def test_a_link_inside_a_linked_folder_leads_no_further(root, tmp_path):
    shutil.move(root / "images", tmp_path / "disk2")
    (root / "images").symlink_to(tmp_path / "disk2")
    shutil.move(tmp_path / "disk2/00000_01.png", tmp_path / "secret.png")
    (tmp_path / "disk2/00000_01.png").symlink_to(tmp_path / "secret.png")
    assert "leads out of" in refusal(lambda: read_capture(root))


@pytest.mark.parametrize("follow_links", [False, True])
def test_paths_that_climb_out_are_never_links(root, follow_links):
    (root.parent.parent / "secret.png").write_bytes((root / "images/00000_00.png").read_bytes())
    edit_frames(root, lambda frame: frame.update(file_path="../../secret"))
    assert "leads out of" in refusal(lambda: read_capture(root, follow_links=follow_links))


# ---- numbers ----


def test_serial_numbers_and_time_stamps(root):
    edit_frames(
        root,
        lambda frame: frame.update(
            camera_index=222_200_036 + frame["camera_index"],
            timestep_index=1_700_000_000_123_456_789 + frame["timestep_index"],
        ),
    )
    subject = read_capture(root)
    assert subject.timestep_ids == tuple(1_700_000_000_123_456_789 + step for step in range(4))
    assert {frame.camera_id for frame in subject.frames["train"]} == {222_200_036, 222_200_037}


def test_numbers_as_text(root):
    before = read_capture(root)
    numbers = ("camera_index", "timestep_index", "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x")
    edit_frames(root, lambda frame: frame.update({key: str(frame[key]) for key in numbers}))
    edit_frames(
        root,
        lambda frame: frame.update(transform_matrix=[[str(x) for x in row] for row in frame["transform_matrix"]]),
    )
    after = read_capture(root)
    assert before.timestep_ids == after.timestep_ids
    for a, b in zip(before.frames["train"], after.frames["train"], strict=True):
        assert (a.camera_id, a.timestep) == (b.camera_id, b.timestep)
        np.testing.assert_array_equal(a.camera.K, b.camera.K)
        np.testing.assert_array_equal(a.camera.viewmat, b.camera.viewmat)


@pytest.mark.parametrize("text", ["front", "", "1_0", "0x10", "nan", "1e400", "12 13"])
def test_text_that_is_no_number(root, text):
    edit_frames(root, lambda frame: frame.update(camera_index=text))
    message = refusal(lambda: read_capture(root))
    assert "camera_index is " in message
    assert "a whole number is needed" in message


# ---- frames that failed ----


def nan_params(root: Path) -> None:
    edit_params(root, 1, jaw_pose=np.array([[np.nan, 0, 0]]))


def damaged_params(root: Path) -> None:
    (root / "flame_param/00001.npz").write_bytes(b"")


def missing_params(root: Path) -> None:
    (root / "flame_param/00001.npz").unlink()


def nan_camera(root: Path) -> None:
    def change(frame: dict) -> None:
        if frame["timestep_index"] == 1:
            frame["transform_matrix"][0][3] = float("nan")

    edit_frames(root, change)


def missing_images(root: Path) -> None:
    for path in (root / "images").glob("00001_*"):
        path.unlink()


FAILURES = [nan_params, damaged_params, missing_params, nan_camera, missing_images]


@pytest.mark.parametrize("fail", FAILURES)
def test_a_frame_that_failed_is_left_out_on_request(root, said, fail):
    """Without the flag, the one line names it."""
    fail(root)
    assert "--skip-bad leaves such frames out" in refusal(lambda: read_capture(root))
    subject = read_capture(root, skip_bad=True)
    assert subject.timestep_ids == (0, 2, 3)
    assert [len(subject.frames[split]) for split in SPLITS] == [4, 2, 3]
    assert {frame.timestep for frame in subject.frames["test"]} == {2}
    (message,) = said.messages
    assert "left out" in message
    assert "00001" in message


def test_images_that_cannot_be_decoded_are_left_out_on_request(root, said):
    (root / "images/00001_00.png").write_bytes(b"")
    subject = read_capture(root, skip_bad=True)
    assert len(subject.frames["train"]) == 5
    assert "00001_00.png" in said.messages[0]
    check_images(subject)


def test_the_flag_is_no_remedy_where_everything_fails(root):
    for timestep in range(4):
        edit_params(root, timestep, jaw_pose=np.full((1, 3), np.nan))
    assert "--skip-bad" not in refusal(lambda: read_capture(root))
    assert "jaw_pose holds 3 values" in refusal(lambda: read_capture(root, skip_bad=True))


def test_a_sound_capture_is_the_same_with_the_flag(root, said):
    assert read_capture(root, skip_bad=True).timestep_ids == read_capture(root).timestep_ids
    assert not said.messages


# ---- identities ----


@pytest.mark.parametrize("change", [0.05, -0.2])
def test_identities_of_sequences_that_were_tracked_one_by_one_are_merged(root, said, change):
    """The first is taken, and one line has the size of the difference."""
    first = read_capture(root).params.shape
    for timestep in (2, 3):
        edit_params(root, timestep, shape=first + np.float32(change))
    np.testing.assert_array_equal(read_capture(root).params.shape, first)
    (message,) = said.messages
    assert "shape of 2 of 4 timesteps differs from that of the first" in message
    assert f"by {abs(change):g} rms per coefficient" in message


def test_two_people_are_refused(root):
    edit_params(root, 2, shape=np.random.default_rng(9).normal(0.0, 1.0, 12).astype(np.float32))
    assert "these are two people" in refusal(lambda: read_capture(root))


# ---- placement ----


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture whose head is where its images show it."""
    return write_tiny_capture(tmp_path_factory.mktemp("placed") / "capture")


def moved(placed: Path, tmp_path: Path, change: Callable[[np.ndarray], np.ndarray], *, masks: bool) -> Path:
    """A copy with other camera matrices."""
    root = Path(shutil.copytree(placed, tmp_path / "moved"))

    def edit(frame: dict) -> None:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
        if not masks:
            frame.pop("fg_mask_path")

    edit_frames(root, edit)
    return root


def scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda matrix: np.vstack([matrix[:3] * [1.0, 1.0, 1.0, factor], matrix[3]])


def aside(matrix: np.ndarray) -> np.ndarray:
    return matrix + 5.0 * np.outer([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])


def opencv(matrix: np.ndarray) -> np.ndarray:
    return matrix @ np.diag([1.0, -1.0, -1.0, 1.0])


def inverted(matrix: np.ndarray) -> np.ndarray:
    return np.linalg.inv(matrix)


def inverted_opencv(matrix: np.ndarray) -> np.ndarray:
    return np.linalg.inv(opencv(matrix))


def test_a_sound_capture_is_in_place(placed, said):
    check_placement(read_capture(placed), tiny_head())
    assert not said.messages


@pytest.mark.parametrize("masks", [True, False])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (scaled(1000.0), ("too small", "seem to be in millimetres, metres are needed: multiply them by 0.001")),
        (scaled(100.0), ("too small", "seem to be in centimetres, metres are needed: multiply them by 0.01")),
        (opencv, ("behind the camera", "seems to be in OpenCV's axes", "negate its second and third column")),
        (inverted_opencv, ("seems to be world to camera, in OpenCV's axes",)),
        (aside, ("outside the image", "must be camera to world")),
    ],
    ids=["millimetres", "centimetres", "opencv", "inverted opencv", "elsewhere"],
)
def test_a_head_out_of_view_is_refused_with_the_cause(placed, tmp_path, change, words, masks):
    root = moved(placed, tmp_path, change, masks=masks)
    message = refusal(lambda: check_placement(read_capture(root), tiny_head()))
    for word in words:
        assert word in message


@pytest.mark.parametrize("factor", [37.0, 0.2])
def test_the_factor_of_other_units_is_found(placed, tmp_path, said, factor):
    """As structure from motion leaves them: the factor is right within a fifth."""
    root = moved(placed, tmp_path, scaled(factor), masks=True)
    try:
        check_placement(read_capture(root), tiny_head())
        message = said.messages[0]
    except DataError as error:
        message = str(error)
    assert "are in other units than the head" in message or "inside" in message, message
    found = float(message.rsplit("multiply them by ", 1)[1].split(";")[0])
    assert 0.8 < found * factor < 1.25


def test_another_head_than_the_masks_show_is_noticed(placed, said):
    """The posed mesh does not lie on the masks."""
    head = tiny_head()
    verts = head.v_template + np.array([0.0, 0.16, 0.0], np.float32)
    check_placement(read_capture(placed), replace(head, v_template=verts))
    assert "is it the head model that the capture was tracked with (--head-model)" in said.messages[0]


def test_static_offsets_of_another_mesh_are_noticed(placed, tmp_path, said):
    root = Path(shutil.copytree(placed, tmp_path / "flame"))
    edit_params(root, 0, static_offset=np.zeros((1, 5143, 3), np.float32))
    check_placement(read_capture(root), tiny_head())
    assert "tracked with a head model of 5143 vertices" in said.messages[0]
    assert "FLAME with VHAP's teeth" in said.messages[0]
    assert "--head-model" in said.messages[0]
