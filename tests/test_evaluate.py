"""Scores: of images, of geometry, of predictors that know nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_avatar import tiny_avatar
from torch import Tensor, nn
from twins import image as twins

from mgavatar import losses
from mgavatar.avatar import Avatar
from mgavatar.capture.images import read_images
from mgavatar.capture.read import read_capture
from mgavatar.capture.subject import Subject
from mgavatar.errors import DataError
from mgavatar.head.params import Pose
from mgavatar.kernels.rasterize import Rendering
from mgavatar.scoring.baselines import NaiveBaselines, pose_distances
from mgavatar.scoring.evaluate import evaluate, evaluate_sample, write_metrics
from mgavatar.scoring.image_metrics import image_metrics, psnr, ssim
from mgavatar.scoring.lpips import Lpips, load_lpips, weight_shapes

GRAY = 0.25


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Avatar, Subject]:
    return tiny_avatar(tmp_path)


def _fake_renderer(avatar: Avatar, monkeypatch: pytest.MonkeyPatch) -> list[Pose]:
    """Make the avatar draw grey images; returns the list of poses that it is asked for."""
    poses = []

    def render(pose: Pose, camera: Any, background: Tensor | None = None) -> Rendering:
        poses.append(pose)
        flat = torch.ones(camera.height, camera.width)
        return Rendering(GRAY * flat.expand(3, -1, -1), flat, flat, torch.ones(1, dtype=torch.bool))

    monkeypatch.setattr(avatar, "render", render)
    return poses


def _images(subject: Subject, split: str) -> np.ndarray:
    return read_images(subject.frames[split]).numpy() / 255.0  # type: ignore[index]


def _db(image: Any, target: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((image - target) ** 2)))


def test_psnr_by_hand() -> None:
    assert psnr(torch.full((3, 2, 2), 0.6), torch.full((3, 2, 2), 0.5)) == pytest.approx(20.0, abs=1e-4)
    assert psnr(torch.zeros(3, 2, 2), torch.zeros(3, 2, 2)) == 100.0


@pytest.mark.parametrize("size", [(1, 1), (4, 7), (11, 11), (33, 50)])
def test_ssim_is_that_of_gaussian_splatting(size: tuple[int, int], rng: torch.Generator) -> None:
    """The explicit window in double precision, and the loss that the fit minimises, agree, also below 11 pixels."""
    image = torch.rand(3, *size, generator=rng)
    target = (image + 0.2 * torch.rand(3, *size, generator=rng)).clamp(0.0, 1.0)
    assert ssim(image, target) == pytest.approx(float(twins.ssim(image.double(), target.double())), abs=1e-5)
    assert ssim(image, target) == pytest.approx(float(losses.ssim(image, target)), abs=1e-5)
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-6)


def test_image_metrics_are_one_record(rng: torch.Generator) -> None:
    """The three scores of a pair; LPIPS only with weights; images of two shapes are refused."""
    image, target = torch.rand(2, 3, 16, 16, generator=rng)
    scores = image_metrics(image, target)
    assert scores == {"psnr": psnr(image, target), "ssim": ssim(image, target), "lpips": None}
    assert image_metrics(image, target, lambda a, b: (a - b).abs().sum())["lpips"] == float(
        (image - target).abs().sum()
    )  # type: ignore[arg-type]
    for score in (psnr, ssim, image_metrics):
        with pytest.raises(ValueError, match=r"image has shape \(3, 16, 16\), but its target \(3, 16, 15\)"):
            score(image, target[..., :15])


def test_metrics_of_a_known_image(pair: tuple[Avatar, Subject], monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores are those of each image, averaged; the record has the keys that it promises."""
    avatar, subject = pair
    _fake_renderer(avatar, monkeypatch)
    done = []
    metrics = evaluate(
        avatar, subject, avatar_path=Path("a.pt"), splits=("val", "test"), progress=lambda *at: done.append(at)
    )
    assert set(metrics) == {
        "avatar", "data", "device", "splits", "geometry", "geometry_reason", "seconds_per_frame",
    }  # fmt: skip
    assert metrics["avatar"] == "a.pt"
    assert metrics["geometry"] is None
    assert metrics["geometry_reason"] == "the capture has no ground truth"
    assert metrics["seconds_per_frame"] > 0
    for split, task in (("val", "novel-view"), ("test", "self-reenactment")):
        score, images = metrics["splits"][split], _images(subject, split)
        assert set(score) == {
            "task", "frames", "cameras", "timesteps", "psnr", "ssim", "lpips", "lpips_reason", "naive",
        }  # fmt: skip
        assert score["task"] == task
        assert score["frames"] == len(images)
        assert score["psnr"] == pytest.approx(np.mean([_db(GRAY, image) for image in images]), abs=1e-4)
        gray = torch.full(images.shape[1:], GRAY)
        expected = np.mean([float(twins.ssim(gray.double(), torch.tensor(image))) for image in images])
        assert score["ssim"] == pytest.approx(expected, abs=1e-6)
        assert score["lpips"] is None
        assert score["lpips_reason"] == "no weights given (--lpips-weights)"
        assert score["naive"]["white"] == pytest.approx(np.mean([_db(1.0, image) for image in images]), abs=1e-4)
        mean = _images(subject, "train").mean(axis=0)
        assert score["naive"]["mean_image"] == pytest.approx(np.mean([_db(mean, i) for i in images]), abs=1e-4)
    assert (metrics["splits"]["val"]["cameras"], metrics["splits"]["val"]["timesteps"]) == (1, 3)
    assert done[-1] == (6, 6)


def test_refined_poses_only_where_the_fit_has_seen_them(
    pair: tuple[Avatar, Subject], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training timesteps of the own capture as refined, all others as tracked."""
    avatar, subject = pair
    avatar.head.poses["jaw_pose"] += 1.0
    jaws = torch.from_numpy(subject.params.jaw_pose)
    poses = _fake_renderer(avatar, monkeypatch)
    evaluate(avatar, subject, avatar_path=Path("a.pt"), splits=("val", "test"))
    times = [frame.timestep for split in ("val", "test") for frame in subject.frames[split]]  # type: ignore[index]
    seen = set(avatar.capture.train_timesteps)
    assert any(t in seen for t in times)
    assert not all(t in seen for t in times)
    for pose, t in zip(poses, times, strict=True):
        assert torch.allclose(pose.jaw_pose, jaws[t] + (1.0 if t in seen else 0.0))
    poses.clear()
    other = replace(subject, params=replace(subject.params, jaw_pose=subject.params.jaw_pose + 0.5))
    evaluate(avatar, other, avatar_path=Path("a.pt"), splits=("val", "test"))
    for pose, t in zip(poses, times, strict=True):
        assert torch.allclose(pose.jaw_pose, jaws[t] + 0.5)


def test_samples_and_missing_splits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    avatar, subject = tiny_avatar(tmp_path, n_cameras=1, n_timesteps=10, size=(8, 8))
    _fake_renderer(avatar, monkeypatch)
    assert evaluate_sample(avatar, subject, avatar_path=Path("a.pt"))["splits"].keys() == {"test"}
    (score,) = evaluate_sample(avatar, subject, avatar_path=Path("a.pt"), max_frames=2)["splits"].values()
    assert (score["frames"], score["sampled_from"]) == (2, 3)
    with pytest.raises(DataError, match="no images in val"):
        evaluate(avatar, subject, avatar_path=Path("a.pt"), splits=("val",))
    alone = replace(subject, frames={**subject.frames, "test": ()})
    metrics = evaluate_sample(avatar, alone, avatar_path=Path("a.pt"))
    assert metrics["splits"]["train"]["task"] == "training-views"
    assert "nearest_frame" not in metrics["splits"]["train"]["naive"]


def test_training_images_are_never_scored(
    pair: tuple[Avatar, Subject], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The same camera and timestep, or the same file, is left out and said; with nothing left there is no score."""
    avatar, subject = pair
    _fake_renderer(avatar, monkeypatch)
    train, test = subject.frames["train"], subject.frames["test"]
    same_place = replace(test[0], camera_id=train[0].camera_id, timestep=train[0].timestep)
    detour = train[1].image_path.parent / ".." / "images" / train[1].image_path.name
    same_file = replace(test[0], image_path=detour)
    mixed = replace(subject, frames={**subject.frames, "test": (same_place, *test, same_file)})
    metrics = evaluate(avatar, mixed, avatar_path=Path("a.pt"), splits=("val", "test"), max_frames=2)
    assert (metrics["splits"]["test"]["frames"], metrics["splits"]["test"]["sampled_from"]) == (2, len(test))
    assert caplog.text.count("not scored") == 1
    assert "2 images of test are training images and not scored" in caplog.text
    clean = evaluate(avatar, subject, avatar_path=Path("a.pt"), splits=("test",))["splits"]["test"]
    assert evaluate(avatar, mixed, avatar_path=Path("a.pt"), splits=("test",))["splits"]["test"] == clean
    leaked = replace(subject, frames={**subject.frames, "test": (same_place, same_file)})
    with pytest.raises(DataError, match="every image in test is a training image"):
        evaluate(avatar, leaked, avatar_path=Path("a.pt"), splits=("test",))
    assert evaluate(avatar, leaked, avatar_path=Path("a.pt"), splits=("val", "test"))["splits"].keys() == {"val"}
    nothing = replace(leaked, frames={**leaked.frames, "val": ()})
    assert evaluate_sample(avatar, nothing, avatar_path=Path("a.pt"))["splits"].keys() == {"train"}


def test_the_splits_of_the_real_capture_do_not_overlap(real_data: Path) -> None:
    """Neither by camera and timestep, nor by file, nor by what is in the files."""
    frames = read_capture(real_data / "subjects/lps_multiview").frames
    every = [frame for split in frames.values() for frame in split]
    assert len({(frame.camera_id, frame.timestep) for frame in every}) == len(every)
    assert len({frame.image_path.resolve() for frame in every}) == len(every)
    contents = {split: {frame.image_path.read_bytes() for frame in own} for split, own in frames.items()}
    assert not contents["train"] & (contents["val"] | contents["test"])


def test_metrics_file(tmp_path: Path) -> None:
    write_metrics(tmp_path / "metrics.json", {"a": [1.5, None]})
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"a": [1.5, None]}


def test_nearest_frame_by_hand(pair: tuple[Avatar, Subject]) -> None:
    """The nearest pose of the same camera; the nearest camera where training lacks it."""
    _, subject = pair
    still = {name: np.zeros_like(getattr(subject.params, name)) for name in ("jaw_pose", "expr", "translation")}
    rotation, neck = np.zeros((2, 4, 3), np.float32)
    rotation[:, 1] = [0.0, 0.5, 1.0, 0.0]
    neck[:, 1] = [0.0, 0.0, 0.0, 0.6]  # timestep 3 turns its neck as far as timestep 1, about, turns its root
    params = replace(subject.params, rotation=rotation, neck_pose=neck, **still)
    naive = NaiveBaselines(replace(subject, params=params))
    tests = {frame.camera_id: frame for frame in subject.frames["test"]}
    assert {frame.camera_id for frame in subject.frames["train"]} == {0, 1}
    for camera, expected in ((0, 0), (1, 1), (2, 1)):
        nearest = naive.nearest_frame(tests[camera])
        assert nearest is not None
        assert (nearest.camera_id, nearest.timestep) == (expected, 1)
    assert naive.nearest_frame(subject.frames["train"][0]) is None


def test_pose_distance_weighs_what_moves(pair: tuple[Avatar, Subject]) -> None:
    """A tenth of a radian moves the head's surface by about a centimetre."""
    zero = {
        name: np.zeros_like(getattr(pair[1].params, name))
        for name in ("rotation", "neck_pose", "jaw_pose", "translation", "expr")
    }
    turned = np.zeros((4, 3), np.float32)
    turned[1] = [0.0, 0.0, 0.1]
    params = replace(pair[1].params, **zero)
    assert pose_distances(replace(params, rotation=turned), 0)[1] == pytest.approx(0.01, rel=1e-5)
    assert pose_distances(replace(params, rotation=turned, neck_pose=-turned), 0)[1] == pytest.approx(0.0, abs=1e-7)
    assert pose_distances(replace(params, translation=turned), 0)[1] == pytest.approx(0.1, rel=1e-5)


def test_naive_baselines_on_real_data(real_data: Path) -> None:
    """The table in the data's own description."""
    subject = read_capture(real_data / "subjects/lps_multiview")
    naive = NaiveBaselines(subject)
    table = {"val": (10.69, 18.92, 19.22), "test": (10.44, 17.87, 21.02)}
    for split, expected in table.items():
        frames = subject.frames[split]  # type: ignore[index]
        scores = [naive.scores(frame, read_images([frame])[0].float() / 255.0) for frame in frames]
        means = [np.mean([score[name] for score in scores]) for name in ("white", "mean_image", "nearest_frame")]
        assert means == pytest.approx(expected, abs=0.006)


@pytest.fixture(scope="module")
def weights() -> dict[str, Tensor]:
    """Random weights in the layout of the real ones; only the last layers must not be negative."""
    generator = torch.Generator().manual_seed(0)
    made = {}
    for name, shape in weight_shapes().items():
        fan = float(np.prod(shape[1:])) if len(shape) > 1 else 100.0
        made[name] = torch.randn(shape, generator=generator) * (2.0 / fan) ** 0.5
        if name.startswith(("lin", "scaling_layer.scale")):
            made[name] = made[name].abs() + 0.1
    return made


@pytest.fixture(scope="module")
def weights_file(weights: dict[str, Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lpips") / "vgg.pth"
    torch.save({**weights, "lins.0.model.1.weight": weights["lin0.model.1.weight"]}, path)
    return path


def _twin(weights: dict[str, Tensor], image: Tensor, target: Tensor) -> float:
    """LPIPS on VGG16 as a stack of layers whose indices are the numbers in the weights' names, in double precision."""
    layers: list[nn.Module] = []
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if width == 0:
            layers.append(nn.MaxPool2d(2))
            continue
        name = next(key for key in weights if key.endswith(f".{len(layers)}.weight") and key.startswith("net."))
        layer = nn.utils.skip_init(nn.Conv2d, weights[name].shape[1], width, 3, padding=1, dtype=torch.float64)
        layer.load_state_dict({"weight": weights[name], "bias": weights[name.replace("weight", "bias")]})
        layers += [layer, nn.ReLU()]
    total = 0.0
    x, y = (
        ((2.0 * value.double()[None] - 1.0) - weights["scaling_layer.shift"]) / weights["scaling_layer.scale"]
        for value in (image, target)
    )
    ends = {3: 0, 8: 1, 15: 2, 22: 3, 29: 4}
    for index, layer in enumerate(layers):
        x, y = layer(x), layer(y)
        if index in ends:
            unit_x, unit_y = (value / (value.norm(dim=1, keepdim=True) + 1e-10) for value in (x, y))
            weight = weights[f"lin{ends[index]}.model.1.weight"].double()
            total += float(nn.functional.conv2d((unit_x - unit_y) ** 2, weight).mean())
    return total


def test_lpips_against_its_twin(weights: dict[str, Tensor], rng: torch.Generator) -> None:
    """Zero for equal images, symmetric, positive, and the value of an independent VGG16."""
    lpips = Lpips(weights)
    a, b = torch.rand(2, 3, 16, 18, generator=rng)
    assert float(lpips(a, a)) == 0.0
    assert float(lpips(a, b)) > 0.0
    assert float(lpips(a, b)) == pytest.approx(float(lpips(b, a)), rel=1e-5)
    with torch.no_grad():
        assert float(lpips(a, b)) == pytest.approx(_twin(weights, a, b), rel=1e-4)
    for wrong in (torch.zeros(3, 16, 17), torch.zeros(1, 16, 18), torch.zeros(16, 18)):
        with pytest.raises(ValueError, match="images must be"):
            lpips(a, wrong)


def test_lpips_in_the_scores(
    pair: tuple[Avatar, Subject], weights_file: Path, weights: dict[str, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, subject = pair
    _fake_renderer(avatar, monkeypatch)
    alone = replace(subject, frames={**subject.frames, "val": subject.frames["val"][:1]})
    score = evaluate(avatar, alone, avatar_path=Path("a"), splits=("val",), lpips_weights=weights_file)["splits"]["val"]
    image = torch.tensor(_images(alone, "val")[0], dtype=torch.float32)
    assert score["lpips"] == pytest.approx(float(Lpips(weights)(torch.full_like(image, GRAY), image)), rel=1e-4)
    assert score["lpips_reason"] is None


def test_other_files_are_no_lpips_weights(weights: dict[str, Tensor], tmp_path: Path) -> None:
    path = tmp_path / "w.pth"
    with pytest.raises(DataError, match="no such file"):
        load_lpips(path)
    path.write_text("hello")
    with pytest.raises(DataError, match=r"w\.pth: not a file of weights"):
        load_lpips(path)
    torch.save([1, 2], path)
    with pytest.raises(DataError, match="holds no state dict"):
        load_lpips(path)
    few = {name: value for name, value in weights.items() if not name.startswith("net.slice")}
    torch.save(few, path)
    with pytest.raises(DataError, match=r"net\.slice1\.0\.weight is missing"):
        load_lpips(path)
    torch.save({**few, "net.slice1.0.weight": torch.zeros(64, 1, 3, 3)}, path)
    with pytest.raises(DataError, match=r"of shape \(64, 1, 3, 3\), \(64, 3, 3, 3\) is needed"):
        load_lpips(path)
    torch.save({**few, "scaling_layer.scale": torch.full((1, 3, 1, 1), torch.nan)}, path)
    with pytest.raises(DataError, match=r"scaling_layer\.scale is not finite"):
        load_lpips(path)


def test_a_dropped_expression_is_said(
    pair: tuple[Avatar, Subject], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The capture has ten expression coefficients, the ball has three directions."""
    avatar, subject = pair
    _fake_renderer(avatar, monkeypatch)
    evaluate(avatar, subject, avatar_path=Path("a.pt"), splits=("val",))
    assert "expression columns from 3 on are not used" in caplog.text
    caplog.clear()
    fitting = replace(subject, params=replace(subject.params, expr=subject.params.expr[:, :3]))
    evaluate(avatar, fitting, avatar_path=Path("a.pt"), splits=("val",))
    assert "expression" not in caplog.text


def test_images_of_a_size_that_training_lacks_have_no_mean_and_no_nearest(pair: tuple[Avatar, Subject]) -> None:
    _, subject = pair
    frame = subject.frames["val"][0]
    large = replace(frame, camera=frame.camera.scaled(48, 64))
    scores = NaiveBaselines(subject).scores(large, torch.zeros(3, 64, 48))
    assert scores == {"white": 0.0, "mean_image": None, "nearest_frame": None}
