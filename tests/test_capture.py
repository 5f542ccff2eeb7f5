"""Captures: what is read, and what each kind of bad file is told."""

from __future__ import annotations

import inspect
import json
import logging
import os
import pkgutil
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from captures import write_capture, write_transforms
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from mgavatar.camera import look_at
from mgavatar.capture import read, readers
from mgavatar.capture.images import check_images, read_images, read_masks
from mgavatar.capture.read import read_capture
from mgavatar.capture.subject import SPLITS
from mgavatar.errors import DataError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "subject")


def frames_of(root: Path, split: str) -> list[dict]:
    return json.loads((root / f"transforms_{split}.json").read_text())["frames"]


def edit_frame(root: Path, split: str = "train", index: int = 1, **changes: object) -> None:
    """Change keys of one frame; None removes a key."""
    frames = frames_of(root, split)
    frames[index] = {key: value for key, value in {**frames[index], **changes}.items() if value is not None}
    write_transforms(root, split, frames)


def edit_params(root: Path, timestep: int, **changes: np.ndarray | None) -> None:
    path = root / f"flame_param/{timestep:05d}.npz"
    with np.load(path) as content:
        arrays = {**content, **changes}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})


def refusal(action: Callable[[], object], *parts: str) -> None:
    """``action`` raises a ``DataError`` of one line that has all the parts."""
    with pytest.raises(DataError) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message, message


def test_reads_what_was_written(root):
    """Splits, cameras in OpenCV axes, rows of parameters and the timesteps' own numbers."""
    subject = read_capture(root)
    assert {split: len(subject.frames[split]) for split in SPLITS} == {"train": 6, "val": 3, "test": 3}
    assert subject.timestep_ids == (0, 1, 2, 3)
    assert subject.params.expr.shape == (4, 10)
    assert subject.params.eyes_pose.dtype == np.float32
    assert subject.params.static_offset is None
    np.testing.assert_array_equal(subject.background, [1.0, 1.0, 1.0])
    frame = subject.frames["train"][0]
    expected = look_at(np.array([np.sin(-0.5), 0.0, np.cos(0.5)]), np.zeros(3), focal=64.0, width=24, height=32)
    np.testing.assert_allclose(frame.camera.viewmat, expected.viewmat, atol=1e-12)
    np.testing.assert_allclose(frame.camera.K, expected.K)
    assert frame.camera.viewmat.dtype == np.float64
    with np.load(root / "flame_param/00003.npz") as content:
        np.testing.assert_array_equal(subject.params.neck_pose[3], content["neck_pose"][0])
        np.testing.assert_array_equal(subject.params.shape, content["shape"])
    assert subject.ground_truth is None


def test_val_and_test_may_be_missing_or_empty(tmp_path):
    root = write_capture(tmp_path / "mono", n_cameras=1)
    (root / "transforms_test.json").unlink()
    subject = read_capture(root)
    assert subject.frames["val"] == ()
    assert subject.frames["test"] == ()
    assert subject.timestep_ids == (0, 1, 2)


def test_timesteps_need_not_be_consecutive(root):
    for split in SPLITS:
        frames = [{**f, "timestep_index": 10 * f["timestep_index"] + 5} for f in frames_of(root, split)]
        write_transforms(root, split, frames)
    subject = read_capture(root)
    assert subject.timestep_ids == (5, 15, 25, 35)
    assert {frame.timestep for frame in subject.frames["test"]} == {3}


def test_union_folder_leads_to_its_siblings(tmp_path):
    write_capture(tmp_path / "seq")
    union = tmp_path / "UNION"
    union.mkdir()
    for split in SPLITS:
        frames = frames_of(tmp_path / "seq", split)
        paths = ("file_path", "fg_mask_path", "flame_param_path")
        write_transforms(union, split, [{**f, **{key: f"../seq/{f[key]}" for key in paths}} for f in frames])
    subject = read_capture(union)
    assert subject.frames["val"][0].image_path == (tmp_path / "seq/images/00000_02.png").resolve()
    assert read_images(subject.frames["train"]).shape == (6, 3, 32, 24)


def test_intrinsics_from_the_angle_and_from_the_top_of_the_file(root):
    frames = [{k: v for k, v in f.items() if k not in ("fl_x", "fl_y", "w", "h")} for f in frames_of(root, "train")]
    (root / "transforms_train.json").write_text(json.dumps({"frames": frames, "w": 24, "h": 32}))
    camera = read_capture(root).frames["train"][0].camera
    assert (camera.width, camera.height) == (24, 32)
    np.testing.assert_allclose(camera.K, [[64.0, 0.0, 12.0], [0.0, 64.0, 16.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("mode", "expected"), [("center", (12.0, 16.0)), ("opencv", (13.0, 15.0)), ("opengl", (13.0, 17.0))]
)
def test_principal_point(root, caplog, mode, expected):
    edit_frame(root, index=0, cx=13.0, cy=15.0)
    with caplog.at_level(logging.WARNING, logger="mgavatar"):
        camera = read_capture(root, principal_point=mode).frames["train"][0].camera
    assert (camera.K[0, 2], camera.K[1, 2]) == expected
    warned = "transforms_train.json: the principal point of 1 frames" in caplog.text
    assert warned == (mode == "center")


def test_static_offset_and_ground_truth(root):
    edit_params(root, 0, static_offset=np.ones((1, 7, 3), np.float32))
    (root / "ground_truth").mkdir()
    np.savez(root / "ground_truth/scan.npz", vertices=np.zeros((1, 3)))
    subject = read_capture(root)
    assert subject.params.static_offset.shape == (7, 3)
    assert subject.ground_truth == root.resolve() / "ground_truth/scan.npz"


class OtherReader:
    """A second format, to see that the entrance goes through all of them."""

    MARK = "other.json"

    def recognises(self, root: Path) -> bool:
        return (root / self.MARK).exists()

    def read(self, root: Path, **options: str) -> tuple[Path, dict[str, str]]:
        return root, options


def test_the_first_reader_that_recognises_a_folder_reads_it(tmp_path, monkeypatch):
    """With its resolved path and the options; the message of an unknown folder names all marks."""
    (tmp_path / "a").mkdir()
    (tmp_path / "a/other.json").touch()
    root = write_capture(tmp_path / "b")
    refusal(
        lambda: read_capture(tmp_path / "a"),
        "a: no checkpoint/*.frame or transforms_train.json in this folder; export the capture",
    )
    monkeypatch.setattr(read, "READERS", (*read.READERS, OtherReader()))
    options = {"principal_point": "opengl", "skip_bad": False, "follow_links": True}
    expected = (tmp_path / "a").resolve(), {"background": (0.0, 0.0, 0.0), **options}
    assert read_capture(tmp_path / "b/../a", background="black", **options) == expected
    assert read_capture(root).root == root.resolve()
    (root / "other.json").touch()
    assert read_capture(root).root == root.resolve()
    marks = "no checkpoint/*.frame or transforms_train.json or other.json in this folder"
    refusal(lambda: read_capture(tmp_path), f"{tmp_path}: {marks}; did you mean {tmp_path / 'a'}?")


def test_every_reader_is_tried():
    """No module of the folder is forgotten, and each keeps the interface."""
    modules = {module.name for module in pkgutil.iter_modules(readers.__path__)}
    assert {reader.__name__.rpartition(".")[2] for reader in read.READERS} == modules
    for reader in read.READERS:
        assert isinstance(reader.MARK, str)
        assert list(inspect.signature(reader.recognises).parameters) == ["root"]
        assert list(inspect.signature(reader.read).parameters) == [
            "root",
            "background",
            "principal_point",
            "skip_bad",
            "follow_links",
        ]


def test_a_file_in_the_place_of_the_folder(root):
    refusal(lambda: read_capture(root / "transforms_train.json"), "is a file, a folder is needed")


def test_missing_folder(tmp_path):
    refusal(lambda: read_capture(tmp_path / "nobody"), "nobody: no such folder")


def test_no_transforms_file(root, tmp_path):
    refusal(
        lambda: read_capture(tmp_path),
        f"{tmp_path}: no checkpoint/*.frame or transforms_train.json",
        f"did you mean {root}?",
    )


def test_broken_json(root):
    (root / "transforms_val.json").write_text('{"frames": [')
    refusal(lambda: read_capture(root), "transforms_val.json: not valid JSON")


def test_frame_without_parameters(root):
    edit_frame(root, flame_param_path=None)
    refusal(lambda: read_capture(root), "transforms_train.json: frame images/00000_01.png has no flame_param_path")


def test_missing_parameter_file(root):
    (root / "flame_param/00002.npz").unlink()
    refusal(lambda: read_capture(root), "transforms_train.json: frame images/00002_00.png", "00002.npz does not exist")


def test_missing_image(root):
    (root / "images/00001_00.png").unlink()
    refusal(lambda: read_capture(root), "transforms_train.json: frame images/00001_00.png", "does not exist")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e400])
def test_nan_in_a_camera(root, value):
    matrix = frames_of(root, "val")[1]["transform_matrix"]
    matrix[0][3] = value
    edit_frame(root, "val", transform_matrix=matrix)
    refusal(lambda: read_capture(root), "transforms_val.json: frame images/00001_02.png: transform_matrix holds NaN")


@pytest.mark.parametrize(
    "change",
    [
        {"fl_x": float("nan")},
        {"fl_x": -3.0},
        {"fl_x": "wide"},
        {"fl_x": "nan"},
        {"fl_x": True},
        {"w": 24.5},
        {"w": 0},
        {"w": 1 << 20, "h": 1 << 20},
        {"timestep_index": -1},
        {"timestep_index": 10**400},
        {"timestep_index": 2.5},
        {"camera_index": "front"},
        {"transform_matrix": [[1, 0], [0, 1]]},
        {"transform_matrix": "identity"},
        {"transform_matrix": (2 * np.eye(4)).tolist()},
        {"transform_matrix": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()},
        {"file_path": 7},
        {"file_path": ""},
    ],
    ids=str,
)
def test_nonsense_in_a_frame(root, change):
    edit_frame(root, **change)
    refusal(lambda: read_capture(root), "transforms_train.json: frame ")


@pytest.mark.parametrize(
    "path",
    [
        "../../secret.png",
        "/etc/passwd",
        "C:\\secret.png",
        "images",
        "a" * 5000,
        "images/\0.png",
        "..",
        "pipe",
        "\ud800",
    ],
)
@pytest.mark.parametrize("key", ["file_path", "fg_mask_path", "flame_param_path"])
def test_paths_that_lead_elsewhere(tmp_path, path, key):
    root = write_capture(tmp_path / "inner/subject")
    (tmp_path / "secret.png").write_bytes((root / "images/00000_00.png").read_bytes())
    if hasattr(os, "mkfifo"):  # elsewhere the name leads nowhere, which is refused too
        os.mkfifo(root / "pipe")
    edit_frame(root, **{key: path})
    refusal(lambda: read_capture(root), "transforms_train.json: frame ")


def test_links_may_not_lead_out_of_the_parent_folder(tmp_path):
    root = write_capture(tmp_path / "inner/subject")
    shutil.move(root / "images/00000_01.png", tmp_path / "elsewhere.png")
    (root / "images/00000_01.png").symlink_to(tmp_path / "elsewhere.png")
    refusal(lambda: read_capture(root), "frame images/00000_01.png", "leads out of", "must be copied")


def test_a_loop_of_links(root):
    image = root / "images/00000_01.png"
    image.unlink()
    image.symlink_to(image)
    refusal(lambda: read_capture(root), "frame images/00000_01.png", "cannot be opened")


@pytest.mark.parametrize(("source", "target"), [("test", "val"), ("train", "test"), ("train", "val")])
def test_splits_may_share_images(root, source, target):
    """INSTA's exports have the end of ``test`` as ``val``; every split is read as its file says."""
    write_transforms(root, target, frames_of(root, source)[-2:])
    subject = read_capture(root)
    pairs = {split: [(frame.timestep, frame.camera_id) for frame in subject.frames[split]] for split in SPLITS}
    assert pairs[target] == pairs[source][-2:]


@pytest.mark.parametrize("split", SPLITS)
def test_an_image_twice_in_one_split(root, split):
    frames = frames_of(root, split)
    write_transforms(root, split, [*frames, frames[0]])
    label = frames[0]["file_path"]
    refusal(lambda: read_capture(root), f"transforms_{split}.json: frame {label} is timestep", f"so is {label}; remove")


def test_cameras_that_cannot_be_told_apart(root):
    for index in range(2):
        edit_frame(root, index=index, camera_index=None)
    refusal(lambda: read_capture(root), "transforms_train.json: frame images/00000_01.png", "apart by camera_index")


def test_two_parameter_files_for_a_timestep(root):
    edit_frame(root, flame_param_path="flame_param/00003.npz")
    refusal(lambda: read_capture(root), "transforms_train.json: frame images/00000_01.png has 00003.npz")


def test_expr_of_another_length(root):
    edit_params(root, 2, expr=np.zeros((1, 7), np.float32))
    refusal(
        lambda: read_capture(root), "flame_param/00002.npz: expr has 7 coefficients", "flame_param/00000.npz has 10"
    )


@pytest.mark.parametrize("value", [np.zeros(12, np.float32), np.zeros(5, np.float32)])
def test_another_identity(root, value):
    edit_params(root, 3, shape=value)
    refusal(lambda: read_capture(root), "flame_param/00003.npz: shape ", "flame_param/00000.npz")


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("jaw_pose", None, "no jaw_pose"),
        ("jaw_pose", np.full((1, 3), np.nan), "jaw_pose holds 3 values that are NaN"),
        ("jaw_pose", np.zeros((1, 6)), "jaw_pose has shape (1, 6), (1, 3) is needed"),
        ("expr", np.zeros((2, 10)), "expr has shape (2, 10)"),
        ("expr", np.array(["a"] * 10), "expr holds <U1, numbers are needed"),
        ("rotation", np.array([[None] * 3]), "holds object, not plain numbers"),
    ],
)
def test_bad_parameters(root, key, value, words):
    edit_params(root, 1, **{key: value})
    refusal(lambda: read_capture(root), "flame_param/00001.npz", words)


def test_parameter_file_that_is_no_npz(root):
    (root / "flame_param/00001.npz").write_bytes(b"not a zip archive")
    refusal(lambda: read_capture(root), "flame_param/00001.npz: not a readable .npz file")


def test_images_and_masks_are_those_of_the_files(root):
    frames = read_capture(root).frames["train"]
    images, masks = read_images(frames), read_masks(frames, threads=1)
    assert images.dtype == masks.dtype == torch.uint8
    for index, frame in enumerate(frames):
        expected = np.asarray(Image.open(frame.image_path)).transpose(2, 0, 1)
        np.testing.assert_array_equal(images[index].numpy(), expected)
        np.testing.assert_array_equal(masks[index].numpy(), np.asarray(Image.open(frame.mask_path)))


@pytest.mark.parametrize("mode", ["L", "P", "RGBA", "1", "LA", "I;16"])
def test_other_kinds_of_png(root, mode):
    """Every kind that Pillow writes gives the pixels that Pillow shows."""
    frame = read_capture(root).frames["train"][0]
    image = Image.open(frame.image_path).convert("RGB")
    if mode == "I;16":
        grey = np.asarray(image.convert("L"))
        Image.fromarray(grey.astype(np.uint16) * 257).save(frame.image_path)
        expected = np.repeat(grey[..., None], 3, axis=-1)
    else:
        image.convert(mode).save(frame.image_path)
        expected = np.asarray(image.convert(mode).convert("RGB"))
    np.testing.assert_array_equal(read_images([frame])[0].permute(1, 2, 0).numpy(), expected)


def test_jpeg(root):
    image = Image.open(root / "images/00000_01.png")
    image.save(root / "images/frame.jpg", quality=95)
    edit_frame(root, file_path="images/frame.jpg")
    frame = read_capture(root).frames["train"][1]
    expected = np.asarray(Image.open(root / "images/frame.jpg")).transpose(2, 0, 1)
    np.testing.assert_array_equal(read_images([frame])[0].numpy(), expected)


def test_resampling_takes_exact_area_means(tmp_path):
    """Integer ratios are block means; any ratio keeps the mean of the image and linear ramps straight."""
    frame = read_capture(write_capture(tmp_path / "subject", masks=False)).frames["train"][0]
    pixels = np.random.default_rng(0).integers(0, 256, (32, 24, 3), np.uint8)
    Image.fromarray(pixels).save(frame.image_path)
    half = read_images([frame], size=(12, 16))[0].permute(1, 2, 0).numpy()
    expected = pixels.reshape(16, 2, 12, 2, 3).mean(axis=(1, 3))
    assert np.abs(half - expected).max() <= 0.5
    odd = read_images([frame], size=(9, 13))[0].permute(1, 2, 0).numpy()
    assert np.abs(odd.mean(axis=(0, 1)) - pixels.mean(axis=(0, 1))).max() < 0.2
    ramp = np.repeat(np.arange(24, dtype=np.uint8)[None, :, None] * 10, 32, axis=0).repeat(3, axis=2)
    Image.fromarray(ramp).save(frame.image_path)
    columns = read_images([frame], size=(9, 32))[0, 0, 0].numpy()
    assert np.abs(columns - ((np.arange(9) + 0.5) * 24 / 9 - 0.5) * 10).max() < 1.5


def test_sizes_that_differ(root):
    image = root / "images/00000_01.png"
    Image.open(image).resize((12, 16)).save(image)
    edit_frame(root, w=12, h=16, fg_mask_path=None)
    frames = read_capture(root).frames["train"]
    refusal(lambda: read_images(frames), "images/00000_00.png is 24x32, but ", "images/00000_01.png is 12x16")
    assert read_images(frames, size=(12, 16)).shape == (6, 3, 16, 12)


@pytest.mark.parametrize("keep", [0.5, 0.95, 0.01])
@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_truncated_image(root, keep, kind):
    image = root / f"images/frame.{kind}"
    noise = np.random.default_rng(0).integers(0, 256, (32, 24, 3), np.uint8)
    Image.fromarray(noise).save(image)
    edit_frame(root, file_path=f"images/frame.{kind}")
    data = image.read_bytes()
    image.write_bytes(data[: int(keep * len(data))])
    subject = read_capture(root)
    refusal(lambda: check_images(subject), f"images/frame.{kind}: not a readable image")
    refusal(lambda: read_images(subject.frames["train"]), f"images/frame.{kind}: not a readable image")


def test_image_of_another_size_than_stated(root):
    image = root / "images/00003_01.png"
    Image.open(image).resize((12, 16)).save(image)
    subject = read_capture(root)
    refusal(lambda: check_images(subject), "images/00003_01.png is 12x16 but", "says 24x32")


def test_mask_of_another_size_than_stated(root):
    mask = root / "fg_masks/00001_02.png"
    Image.open(mask).resize((12, 16)).save(mask)
    subject = read_capture(root)
    refusal(lambda: check_images(subject), "fg_masks/00001_02.png is 12x16 but", "says 24x32")


def test_image_bomb_is_refused_by_its_header(root):
    """A file of a few bytes whose header claims 60000x60000 pixels is never decoded."""
    image = root / "images/00000_00.png"
    data = bytearray(image.read_bytes())
    data[16:24] = (60000).to_bytes(4, "big") * 2
    image.write_bytes(bytes(data))
    refusal(lambda: check_images(read_capture(root)), "images/00000_00.png")


def test_the_first_bad_image_is_named(root):
    for name in ("00001_00", "00002_01", "00003_00"):
        (root / f"images/{name}.png").write_bytes(b"")
    subject = read_capture(root)
    for _ in range(3):
        refusal(lambda: check_images(subject), "images/00001_00.png")


def test_frames_without_masks(tmp_path):
    subject = read_capture(write_capture(tmp_path / "subject", masks=False))
    check_images(subject)
    refusal(lambda: read_masks(subject.frames["train"]), "images/00000_00.png", "no foreground mask")


@pytest.mark.parametrize("masks", [True, False])
@pytest.mark.parametrize(("stated", "actual"), [("black", "white"), ("white", "black")])
def test_another_background_than_stated(tmp_path, stated, actual, masks):
    """If all images are on the other one, it is refused with the flag that helps, which then works."""
    root = write_capture(tmp_path / "subject", masks=masks)
    if actual == "black":
        for path in (root / "images").iterdir():
            pixels = np.array(Image.open(path))
            pixels[(pixels == 255).all(-1)] = 0
            Image.fromarray(pixels).save(path)
    words = ("subject: the images are on", "images/00000_00.png", f"give --background {actual}")
    refusal(lambda: check_images(read_capture(root, background=stated)), *words)
    check_images(read_capture(root, background=actual))


@pytest.mark.parametrize(
    ("color", "masks", "words"),
    [
        ((0, 0, 0), True, "they are composited on it (RGB 1, 1, 1) with their masks"),
        ((0, 0, 0), False, "or give --background black if that is the background of the others"),
        ((90, 120, 40), True, "they are composited on it (RGB 1, 1, 1) with their masks"),
        ((90, 120, 40), False, "have no masks to composite them with; give them masks"),
    ],
)
def test_some_images_on_another_background(tmp_path, caplog, color, masks, words):
    """A warning with a remedy."""
    root = write_capture(tmp_path / "subject", masks=masks)
    path = root / "images/00001_01.png"
    pixels = np.array(Image.open(path))
    pixels[(pixels == 255).all(-1)] = color
    Image.fromarray(pixels).save(path)
    with caplog.at_level(logging.WARNING, logger="mgavatar"):
        check_images(read_capture(root))
    (message,) = caplog.messages
    assert "1 of 12 images" in message
    assert "00001_01.png" in message
    assert words in message


def test_an_unknown_background(root):
    refusal(lambda: read_capture(root, background="grey"), "background 'grey': must be white, black or R,G,B")
    refusal(lambda: read_capture(root, principal_point="middle"), "principal_point 'middle': must be one of center")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9) | st.just("images/00000_02.png"),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=16,
)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_json_value_anywhere_is_read_or_refused(fuzz_root, data):
    """Whatever stands in a transforms file, the reader returns or says in one line which file is wrong."""
    meta = json.loads((fuzz_root / "whole.json").read_text())
    place = data.draw(st.sampled_from(["frame", "frame", "frame", "top", "file", "number"]))
    frame = meta["frames"][1]
    if place == "frame":
        frame[data.draw(st.sampled_from(sorted(frame)))] = data.draw(VALUES)
    elif place == "number":
        frame["transform_matrix"][data.draw(st.integers(0, 3))][data.draw(st.integers(0, 3))] = data.draw(VALUES)
    elif place == "top":
        meta[data.draw(st.sampled_from(["frames", "w", "cx", "fl_x"]))] = data.draw(VALUES)
    else:
        meta = data.draw(VALUES)
    (fuzz_root / "transforms_val.json").write_text(json.dumps(meta))
    try:
        read_capture(fuzz_root)
    except DataError as error:
        message = str(error)
    else:
        message = ""
    assert "\n" not in message
    assert not message or str(fuzz_root) in message


@pytest.fixture(scope="module")
def fuzz_root(tmp_path_factory) -> Path:
    """A capture whose train split has other timesteps than the file that is damaged, which stands for val."""
    root = write_capture(tmp_path_factory.mktemp("fuzz") / "subject")
    (root / "transforms_test.json").rename(root / "whole.json")
    return root


def test_real_capture(real_data):
    """The sample capture: counts, the identity's width, and its camera model against the ground truth's silhouette."""
    subject = read_capture(real_data / "subjects/lps_multiview")
    assert [len(subject.frames[split]) for split in SPLITS] == [135, 9, 48]
    assert subject.params.shape.shape == (300,)
    assert len(subject.params) == 12
    assert subject.ground_truth.name == "scan.npz"
    frame = subject.frames["val"][0]
    with np.load(subject.ground_truth) as truth:
        points = truth["vertices"][frame.timestep]
    in_camera = points @ frame.camera.viewmat[:3, :3].T + frame.camera.viewmat[:3, 3]
    assert in_camera[:, 2].min() > 0.5
    pixels = (in_camera @ frame.camera.K.T)[:, :2] / in_camera[:, 2:]
    columns, rows = np.floor(pixels).astype(int).T
    seen = (columns >= 0) & (columns < 400) & (rows >= 0) & (rows < 550)
    mask = read_masks([frame])[0].numpy()
    assert (mask[rows[seen], columns[seen]] > 0).mean() > 0.99
    assert read_images([frame], size=(200, 275)).shape == (1, 3, 275, 200)
