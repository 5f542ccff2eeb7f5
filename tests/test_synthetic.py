"""Synthetic captures: layout, truth, and what makes them hard to cheat on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from PIL import Image

from mgavatar.capture.info import CaptureInfo
from mgavatar.capture.read import read_capture
from mgavatar.capture.subject import SPLITS
from mgavatar.errors import DataError
from mgavatar.head.find import find_head_model
from mgavatar.head.mesh_math import vertex_normals
from mgavatar.head.model import HeadModel
from mgavatar.head.params import HeadParams
from mgavatar.head.procedural.build import build_head
from mgavatar.kernels.portrait import View, portrait
from mgavatar.kernels.ray_cast import RayMesh
from mgavatar.synthetic.capture import make_synthetic_capture
from mgavatar.synthetic.motion import action_columns, perform
from mgavatar.synthetic.person import Person, make_person, subdivision
from mgavatar.synthetic.studio import Studio, front_camera, frontal_arc, held_out_camera, make_look, side_cameras

SIZE = (48, 40)
KEYS = {"shape", "expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation"}


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return build_head()


@pytest.fixture(scope="module")
def capture(head: HeadModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four cameras, three timesteps."""
    out = tmp_path_factory.mktemp("synthetic") / "person"
    calls: list[tuple[int, int]] = []
    made = make_synthetic_capture(
        out, cameras=4, timesteps=3, size=SIZE, seed=3, head=head, progress=lambda *done: calls.append(done)
    )
    assert made == out
    assert calls == [(i + 1, 12) for i in range(12)]
    return out


@pytest.fixture(scope="module")
def person(head: HeadModel) -> Person:
    return make_person(head, np.random.default_rng(3))


def meta(root: Path, split: str) -> dict:
    return json.loads((root / f"transforms{split}.json").read_text("utf-8"))


def arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def every_byte(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_layout_is_complete(capture: Path) -> None:
    """Every file of the VHAP layout is there, and nothing else, not even a leftover of writing."""
    names = {f"{t:05d}_{c:02d}.png" for t in range(3) for c in range(4)}
    assert {p.name for p in (capture / "images").iterdir()} == names
    assert {p.name for p in (capture / "fg_masks").iterdir()} == names
    assert {p.name for p in (capture / "flame_param").iterdir()} == {f"{t:05d}.npz" for t in range(3)}
    rest = {p.name for p in capture.iterdir()} - {"images", "fg_masks", "flame_param", "ground_truth"}
    assert rest == {"canonical_flame_param.npz", *(f"transforms{s}.json" for s in ("", "_train", "_val", "_test"))}
    assert [p.name for p in capture.parent.iterdir()] == [capture.name]


def test_the_transforms_name_the_head_model(capture: Path, head: HeadModel, tmp_path: Path) -> None:
    """``builtin``, or the file beside them into which any other head model is saved."""
    transforms = ("", *(f"_{split}" for split in SPLITS))
    assert {meta(capture, name)["head_model"] for name in transforms} == {"builtin"}
    few = {"shapedirs": head.shapedirs[:, :, 290:], "n_shape": 10}  # a small file
    other = replace(head, v_template=head.v_template * np.float32(1.05), name="mine.npz", **few)
    out = make_synthetic_capture(tmp_path / "other", cameras=2, timesteps=2, size=(8, 8), head=other)
    assert {meta(out, name)["head_model"] for name in transforms} == {"head_model.npz"}
    found = find_head_model(out)
    np.testing.assert_array_equal(found.v_template, other.v_template)
    np.testing.assert_array_equal(found.shapedirs, other.shapedirs)
    assert (found.expr_basis, found.expr_names) == (other.expr_basis, other.expr_names)


def test_frames_name_existing_files_and_hold_the_fields_keys(capture: Path) -> None:
    every = meta(capture, "")
    assert (every["w"], every["h"]) == SIZE
    assert every["timestep_indices"] == [0, 1, 2]
    assert every["camera_indices"] == [0, 1, 2, 3]
    for frame in every["frames"]:
        for key in ("file_path", "fg_mask_path", "flame_param_path"):
            assert (capture / frame[key]).is_file()
        assert frame["camera_angle_x"] == pytest.approx(2 * np.arctan(frame["w"] / (2 * frame["fl_x"])))
        rotation = np.array(frame["transform_matrix"])[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert rotation[1, 1] > 0.9  # OpenGL: the camera's y points up


def test_splits_are_disjoint_and_mean_what_they_say(capture: Path) -> None:
    train, val, test = (
        {(f["timestep_index"], f["camera_index"]) for f in meta(capture, split)["frames"]}
        for split in ("_train", "_val", "_test")
    )
    assert train | val | test == {(t, c) for t in range(3) for c in range(4)}
    assert len(train) + len(val) + len(test) == 12
    assert val == {(t, held_out_camera(4)) for t in range(2)}
    assert test == {(2, c) for c in range(4)}


def test_parameters_have_vhap_sizes_and_hide_the_identity(capture: Path, head: HeadModel) -> None:
    for path in (*sorted((capture / "flame_param").iterdir()), capture / "canonical_flame_param.npz"):
        values = arrays(path)
        assert set(values) == KEYS
        assert values["shape"].shape == (300,)
        assert not values["shape"].any()
        assert values["expr"].shape == (1, max(100, head.n_expr))
        assert all(values[key].shape == (1, 3) for key in ("rotation", "neck_pose", "jaw_pose", "translation"))
        assert values["eyes_pose"].shape == (1, 6)
    canonical = arrays(capture / "canonical_flame_param.npz")
    assert canonical["jaw_pose"].dtype == np.float64
    assert canonical["jaw_pose"].tolist() == [[0.3, 0.0, 0.0]]
    assert np.abs(arrays(capture / "ground_truth/truth.npz")["true_shape"]).max() > 0.5


def test_tracked_motion_is_a_little_wrong(capture: Path) -> None:
    """Jitter of 0.3 degrees, 0.5 mm and 0.03: there, but small."""
    truth = arrays(capture / "ground_truth/truth.npz")
    files = [arrays(p) for p in sorted((capture / "flame_param").iterdir())]
    for key, deviation in (("rotation", 0.0052), ("neck_pose", 0.0052), ("eyes_pose", 0.0052), ("translation", 5e-4)):
        error = np.concatenate([f[key] for f in files]) - truth[f"true_{key}"]
        assert 0.3 * deviation < error.std() < 2.0 * deviation, key
        assert np.abs(error).max() < 4.5 * deviation, key
    used = truth["true_expr"].any(0)
    error = np.concatenate([f["expr"] for f in files])[:, : len(used)] - truth["true_expr"]
    assert 0.01 < error[:, used].std() < 0.06
    assert not error[:, ~used].any()


def test_truth_lies_inside_the_masks(capture: Path) -> None:
    """Vertices of every timestep, projected with the written cameras, fall on the written masks."""
    truth = arrays(capture / "ground_truth/truth.npz")
    assert truth["vertices"].shape[0] == 3
    assert truth["vertices"].dtype == np.float32
    assert truth["faces"].max() == truth["vertices"].shape[1] - 1
    for frame in meta(capture, "")["frames"]:
        to_world = np.array(frame["transform_matrix"])
        to_world[:3, 1:3] *= -1
        local = (truth["vertices"][frame["timestep_index"]] - to_world[:3, 3]) @ to_world[:3, :3]
        x = frame["fl_x"] * local[:, 0] / local[:, 2] + frame["cx"]
        y = frame["fl_y"] * local[:, 1] / local[:, 2] + frame["cy"]
        inside = (x > 0) & (x < frame["w"]) & (y > 0) & (y < frame["h"])
        mask = pixels(capture / frame["fg_mask_path"])
        assert inside.mean() > 0.4
        assert (mask[y[inside].astype(int), x[inside].astype(int)] > 0).mean() > 0.98


def test_seen_counts_training_images(capture: Path) -> None:
    truth = arrays(capture / "ground_truth/truth.npz")
    assert truth["seen"].max() <= 6  # 2 timesteps x 3 cameras
    assert truth["seen"].max() >= 5
    assert (truth["seen"][truth["mask_teeth"]] == 0).mean() > 0.5
    assert 0.02 < (truth["seen"][truth["mask_face"]] > 0).mean() <= 1.0


def test_images_are_white_outside_and_antialiased_at_the_edge(capture: Path) -> None:
    for path in (capture / "images").iterdir():
        image, mask = pixels(path), pixels(capture / "fg_masks" / path.name)
        assert image.shape == (SIZE[1], SIZE[0], 3)
        assert mask.shape == (SIZE[1], SIZE[0])
        assert (image[mask == 0] == 255).all()
        assert 0.25 < (mask > 0).mean() < 0.9
        assert ((mask > 0) & (mask < 255)).sum() > 20
        assert image[mask == 255].std() > 20  # texture and light, not a silhouette


def test_same_seed_same_bytes_and_another_seed_another_person(head: HeadModel, tmp_path: Path) -> None:
    options = {"cameras": 2, "timesteps": 2, "size": (24, 24), "head": head}
    first = make_synthetic_capture(tmp_path / "a", seed=1, **options)
    (tmp_path / "b").mkdir()  # an empty folder is welcome
    again = make_synthetic_capture(tmp_path / "b", seed=1, **options)
    assert every_byte(first) == every_byte(again)
    other = make_synthetic_capture(tmp_path / "c", seed=2, **options)
    difference = pixels(first / "images/00000_00.png").astype(float) - pixels(other / "images/00000_00.png")
    assert np.abs(difference).mean() > 5


def test_monocular(head: HeadModel, tmp_path: Path) -> None:
    """Training and test are one camera's; val has two others, at some of the training timesteps."""
    calls: list[tuple[int, int]] = []
    out = make_synthetic_capture(
        tmp_path / "mono",
        cameras=7,
        timesteps=13,
        size=(24, 32),
        head=head,
        monocular=True,
        progress=lambda *at: calls.append(at),
    )
    splits = {s: [(f["timestep_index"], f["camera_index"]) for f in meta(out, f"_{s}")["frames"]] for s in SPLITS}
    assert splits["train"] == [(t, 0) for t in range(10)]
    assert splits["test"] == [(t, 0) for t in range(10, 13)]
    assert splits["val"] == [(t, c) for t in (0, 2, 4, 5, 7, 9) for c in (1, 2)]
    assert calls == [(i + 1, 25) for i in range(25)]
    assert len(list((out / "images").iterdir())) == len(list((out / "fg_masks").iterdir())) == 25
    assert arrays(out / "ground_truth/truth.npz")["seen"].max() <= 10  # side cameras are not counted
    assert len(meta(out, "")["frames"]) == 25
    few = make_synthetic_capture(tmp_path / "few", timesteps=2, size=(16, 16), head=head, monocular=True)
    assert [(f["timestep_index"], f["camera_index"]) for f in meta(few, "_val")["frames"]] == [(0, 1), (0, 2)]


def test_side_cameras_of_a_monocular_capture_are_no_training_cameras(head: HeadModel, tmp_path: Path) -> None:
    """What a fit remembers is the front camera alone; the sides see ears, the front camera's picture is another one."""
    out = make_synthetic_capture(tmp_path / "mono", timesteps=3, size=(48, 48), head=head, monocular=True)
    subject = read_capture(out)
    assert set(CaptureInfo.of(subject).cameras) == {0}
    yaws = [np.degrees(np.arctan2(*(f.camera.position - [0, 0, -0.02])[[0, 2]])) for f in subject.frames["val"]]
    np.testing.assert_allclose(yaws, [-60, 60, -60, 60], atol=1e-9)
    assert [f.camera.K.tolist() for f in subject.frames["val"]] == [front_camera((48, 48)).K.tolist()] * 4
    front, left, right = (pixels(out / f"images/00000_{c:02d}.png").astype(float) for c in range(3))
    assert min(np.abs(a - b).mean() for a, b in ((front, left), (front, right), (left, right))) > 5
    assert np.abs(left - right).mean() > np.abs(left - right[:, ::-1]).mean()  # mirror images, about


@pytest.mark.parametrize("options", [{"cameras": 2}, {"cameras": 16}, {"monocular": True}], ids=str)
@pytest.mark.parametrize("timesteps", [2, 7])
def test_splits_never_overlap(options: dict, timesteps: int, head: HeadModel, tmp_path: Path) -> None:
    """No image of training is held out, by camera and timestep, by file or by content."""
    out = make_synthetic_capture(tmp_path / "x", timesteps=timesteps, size=(16, 16), head=head, **options)
    frames = read_capture(out).frames
    every = [frame for split in SPLITS for frame in frames[split]]
    assert all(frames[split] for split in SPLITS)
    assert len({(frame.camera_id, frame.timestep) for frame in every}) == len(every)
    assert len({frame.image_path.resolve() for frame in every}) == len(every)
    held_out = {frame.image_path.read_bytes() for split in ("val", "test") for frame in frames[split]}
    assert not held_out & {frame.image_path.read_bytes() for frame in frames["train"]}
    assert not {f.timestep for f in frames["test"]} & {f.timestep for s in ("train", "val") for f in frames[s]}


def test_refusals(head: HeadModel, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for name in ("full", "file"):
        with pytest.raises(DataError, match=f"{name}: already exists"):
            make_synthetic_capture(tmp_path / name, head=head)
    with pytest.raises(DataError, match=r"inside: .* is a file, but a folder is needed there"):
        make_synthetic_capture(tmp_path / "file" / "inside", head=head, timesteps=2, cameras=2, size=(8, 8))
    for wrong in ({"cameras": 1}, {"timesteps": 1}, {"size": (4, 400)}):
        with pytest.raises(DataError, match="ask for"):
            make_synthetic_capture(tmp_path / "new", head=head, **wrong)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "full"]
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["thesis.txt"]


def test_an_interrupted_capture_leaves_nothing(head: HeadModel, tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_synthetic_capture(tmp_path / "x", head=head, timesteps=2, cameras=2, size=(8, 8), progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_the_person_is_not_in_the_model(person: Person, head: HeadModel) -> None:
    """Hair rises by about a centimetre, and the shoulders are clearly wider than the template's bust."""
    verts, _ = person.posed(HeadParams.neutral(n_frames=1, n_expr=head.n_expr), 0)
    thickness = np.linalg.norm(person.hair, axis=1)[person.masks["hair"][: len(person.hair)]]
    assert 0.005 < np.median(thickness) < 0.05
    assert np.ptp(verts[person.masks["shoulders"], 0]) > 1.4 * np.ptp(head.v_template[:, 0])
    assert not (person.masks["face"] & person.masks["hair"]).any()


def test_cloth_covers_the_bust(person: Person) -> None:
    """Seen from all sides, nothing below the collar is skin."""
    studio = Studio(person, make_look(person, np.random.default_rng(0)))
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    middle = person.garment.mean(0)
    away = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    starts = away + np.array([0.0, person.garment[:, 1].min() + 0.2, middle[2]])
    _, face_ids, _ = studio.mesh.cast(torch.tensor(starts).float(), torch.tensor(-away).float())
    assert (person.kinds[face_ids.numpy()] == 4).all()


def test_rest_pose_is_the_shaped_head_and_a_root_turn_is_rigid(person: Person, head: HeadModel) -> None:
    rest, _ = person.posed(HeadParams.neutral(n_frames=1, n_expr=head.n_expr), 0)
    betas = person.betas
    shaped = head.v_template + head.shapedirs[:, :, : head.n_shape].astype(np.float64) @ betas
    n = len(person.hair)
    np.testing.assert_allclose(rest[:n], person.fine @ shaped + person.hair, atol=1e-9)
    root = (head.J_regressor.astype(np.float64) @ shaped)[0]
    turn = np.array([0.0, np.pi / 2, 0.0])
    motion = replace(
        HeadParams.neutral(n_frames=1, n_expr=head.n_expr),
        rotation=turn[None],
        translation=np.array([[0.1, 0.0, 0.0]]),
    )
    turned, rotations = person.posed(motion, 0)
    x, y, z = (rest - root).T
    np.testing.assert_allclose(turned, np.column_stack([z, y, -x]) + root + [0.1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(rotations[0], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-6)


def test_muscles_and_hair_follow_the_neck_by_millimetres(person: Person, head: HeadModel) -> None:
    """What skinning alone does not give is there, is small, and is nothing at rest."""
    assert not person._correctives(np.zeros(3)).any()
    length = np.linalg.norm(person._correctives(np.array([0.1, 0.35, 0.1])), axis=1)
    assert 0.002 < length.max() < 0.02


def test_motion_is_smooth_and_uses_names(head: HeadModel) -> None:
    motion = perform(head, 60, np.random.default_rng(0), turn=0.35)
    neck = np.degrees(motion.neck_pose)
    assert 15 < np.abs(neck[:, 1]).max() < 21
    assert np.abs(np.diff(neck, axis=0)).max() < 4
    assert motion.jaw_pose[:, 0].max() > 0.1
    columns = action_columns(head)
    assert {"smile", "blink"} <= set(columns)
    assert all("blink" in head.expr_names[i].lower() for i in columns["blink"])


def test_unnamed_directions_are_chosen_by_the_region_that_they_move(head: HeadModel) -> None:
    columns = action_columns(replace(head, expr_names=()))
    chosen = [int(c[0]) for c in columns.values()]
    assert len(set(chosen)) == 3
    eyes = (head.J_regressor @ head.v_template)[3:].mean(0)
    motion = np.linalg.norm(head.shapedirs[:, :, head.n_shape + chosen[0]], axis=1)
    height = float(np.average(head.v_template[:, 1] - eyes[1], weights=motion**2))
    assert -0.09 < height < -0.03  # the mouth


def a_wall(x: float) -> tuple[RayMesh, tuple[torch.Tensor, ...]]:
    """A wall of cloth 1 m ahead of the origin that ends at ``x`` [m], and its surface."""
    verts = torch.tensor([[-9.0, -9, -1], [x, -9, -1], [x, 9, -1], [-9, 9, -1]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
    up = torch.tensor([[0.0, 0, 1]]).expand(4, 3).contiguous()
    return RayMesh(verts, faces), (faces, torch.full((2,), 4, dtype=torch.int32), verts, torch.ones(4, 4), up, up)


def test_cover_is_the_share_of_a_pixel(person: Person) -> None:
    """A wall that ends at 2.5 of 5 pixels covers two of them, half of the third and none of the others."""
    view = View()
    view.to_world = wp.mat33(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0)
    view.focal, view.center, view.columns = wp.vec2(10.0, 10.0), wp.vec2(2.5, 0.5), 5
    look = make_look(person, np.random.default_rng(0))
    mesh, surface = a_wall(0.0)
    samples = torch.tensor([[(i % 4 + 0.5) / 4, (i // 4 + 0.5) / 4] for i in range(16)])
    pixels = portrait(mesh, view, look, samples=samples, n_pixels=5, surface=surface)
    assert pixels[:, 3].tolist() == [1.0, 1.0, 0.5, 0.0, 0.0]
    assert not pixels[3:].any()
    assert (pixels[:2, :3] > 0.05).all()
    assert (pixels[:, :3] <= pixels[:, 3:]).all()
    with pytest.raises(ValueError, match="parts of lengths"):
        portrait(mesh, view, look, samples=samples, n_pixels=5, surface=(*surface[:5], surface[5][:3]))


def test_subdivision_keeps_the_surface() -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    fine, more = subdivision(faces, 4)
    verts = fine @ np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    assert len(more) == 32
    assert len(verts) == 25
    np.testing.assert_allclose(np.asarray(fine.sum(1)).ravel(), 1.0)
    corners = verts[more]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    np.testing.assert_allclose(areas, 1 / 32)
    np.testing.assert_allclose(vertex_normals(verts, more), np.tile([0.0, 0, 1], (25, 1)))


def test_subdivision_keeps_the_order_of_faces() -> None:
    """All first quarters, then all second ones: the bits of every capture depend on it."""
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    fine, more = subdivision(np.tile(faces, (5_000, 1)), 4)  # 10,000 faces are subdivided once
    assert fine.shape == (4 + 5, 4)
    ab, ac, bc, bd, cd = range(4, 9)
    quarters = [
        [0, ab, ac],
        [2, bc, cd],
        [ab, 1, bc],
        [bc, 1, bd],
        [ac, bc, 2],
        [cd, bd, 3],
        [ab, bc, ac],
        [bc, bd, cd],
    ]
    np.testing.assert_array_equal(more[[0, 1, 10_000, 10_001, 20_000, 20_001, 30_000, 30_001]], quarters)


def test_cameras_stand_around_the_face() -> None:
    views = frontal_arc(16, (64, 64))
    yaws = np.degrees([np.arctan2(v.position[0], v.position[2] + 0.02) for v in views])
    assert yaws.min() < -55
    assert yaws.max() > 55
    assert abs(yaws[held_out_camera(16)]) < 12
    assert sum(v.position[1] > 0 for v in views) == 8
    assert abs(front_camera((64, 64)).position[0]) < 1e-9
    assert len(frontal_arc(3, (64, 64))) == 3
    assert len(side_cameras((64, 64))) == 2
