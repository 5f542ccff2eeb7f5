"""Files for other programs: what an independent reader finds in them, and what is refused."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y
from tiny_avatar import COLOR, tiny_avatar

from mgavatar import cli
from mgavatar.appearance.spherical_harmonics import sh_basis
from mgavatar.avatar import Avatar
from mgavatar.camera import look_at
from mgavatar.driving.expression_map import ExpressionMap
from mgavatar.driving.motion import Driving
from mgavatar.driving.read import read_driving
from mgavatar.driving.retarget import poses_of
from mgavatar.errors import DataError
from mgavatar.export.bake import (
    Splats,
    bake_mesh,
    bake_splats,
    baking_costs,
    cameras_around,
    view_directions,
)
from mgavatar.export.export import export, export_pose
from mgavatar.export.glb import Glb
from mgavatar.export.mesh_glb import split_at_seams
from mgavatar.export.ply import write_splats_ply
from mgavatar.export.rig import bake_rig, rig_error
from mgavatar.gaussians import draw
from mgavatar.head.params import HeadParams

DATA = Path(__file__).parent / "data"
SPLAT_COLUMNS = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    """An avatar with ColorNet, OffsetNet and some hundred Gaussians."""
    return Avatar.load(DATA / "format2_color_net.pt")


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Avatar:
    """An avatar without an appearance: a Gaussian of one colour at each vertex."""
    return tiny_avatar(tmp_path_factory.mktemp("plain"))[0]


@pytest.fixture(scope="module")
def baked(avatar: Avatar) -> list[Splats]:
    return bake_splats(avatar, avatar.mean_pose())


@pytest.fixture
def driving(tmp_path: Path) -> Driving:
    """Three frames in which the jaw opens."""
    jaw = np.zeros((3, 3), np.float32)
    jaw[:, 0] = [0.0, 0.1, 0.2]
    np.savez(tmp_path / "motion.npz", jaw_pose=jaw)
    return read_driving(tmp_path / "motion.npz")


def read_ply(path: Path) -> tuple[np.ndarray, list[str]]:
    """Read a PLY of floats without the writer's code: rows by name, and its comments."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    assert len(names) == sum(line.startswith("property") for line in lines)
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element"))
    rows = np.frombuffer(body, np.dtype([(name, "<f4") for name in names]))
    assert len(rows) == count
    return rows, [line.removeprefix("comment ") for line in lines if line.startswith("comment ")]


def columns(rows: np.ndarray, *names: str) -> np.ndarray:
    return np.stack([rows[name] for name in names], axis=1)


def splats_of_ply(rows: np.ndarray) -> Splats:
    """Return the splats that a viewer makes of the rows."""
    rest = columns(rows, *(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15).transpose(0, 2, 1)
    dc = columns(rows, "f_dc_0", "f_dc_1", "f_dc_2")
    arrays = (
        columns(rows, "x", "y", "z"),
        columns(rows, "rot_0", "rot_1", "rot_2", "rot_3"),
        np.exp(columns(rows, "scale_0", "scale_1", "scale_2")),
        1.0 / (1.0 + np.exp(-rows["opacity"])),
        np.concatenate([dc[:, None], rest], axis=1),
    )
    return Splats(*(torch.from_numpy(np.ascontiguousarray(array)) for array in arrays))


COMPONENTS = {5126: "<f4", 5125: "<u4", 5121: "<u1"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def read_glb(path: Path) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Read a GLB without the writer's code, and check what glTF requires: lengths, alignment and bounds."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    tree = json.loads(data[20 : 20 + size])
    assert tree["asset"]["version"] == "2.0"
    if 20 + size == len(data):
        assert "buffers" not in tree
        return tree, []
    n_bytes, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert n_bytes % 4 == 0
    binary = data[28 + size :]
    assert len(binary) == n_bytes == tree["buffers"][0]["byteLength"]
    arrays = []
    for accessor in tree["accessors"]:
        view = tree["bufferViews"][accessor["bufferView"]]
        dtype, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= n_bytes
        assert view["byteLength"] == accessor["count"] * width * dtype.itemsize
        chunk = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        array = np.frombuffer(chunk, dtype).reshape(-1, width)
        assert accessor["count"] >= 1
        assert np.isfinite(array).all()
        if "min" in accessor:
            assert isinstance(accessor["min"], list)
            assert np.array_equal(np.float32(accessor["min"]), array.min(0))
            assert np.array_equal(np.float32(accessor["max"]), array.max(0))
        arrays.append(array)
    return tree, arrays


# ---- the bake ----


def test_the_baked_colours_are_those_of_the_avatar(avatar, baked):
    """From the training cameras the splats look like the avatar, and higher degrees look more like it."""
    costs = baking_costs(avatar, avatar.mean_pose(), baked)
    assert [s.degree for s in baked] == [0, 1, 2, 3]
    assert costs[3] > 55.0
    assert costs[3] > costs[0] + 6.0
    for camera in avatar.capture.cameras.values():
        own = avatar.gaussians(avatar.mean_pose(), camera)
        found = baked[3].gaussians(camera)
        assert torch.equal(found.means, own.means)
        assert torch.allclose(found.scales, own.scales)
        weights = own.opacities / own.opacities.sum()
        error = (found.colors - own.colors.clamp(min=0.0)).abs().mean(1)
        assert float((weights * error).sum()) < 0.004


def test_baked_harmonics_of_an_avatar_with_harmonics_are_its_own():
    """Colours that already are spherical harmonics of the world's directions come back."""
    avatar = Avatar.load(DATA / "format2_sh.pt")
    appearance = avatar.appearance
    assert appearance is not None
    appearance.view_frame = "world"
    appearance.offset_net = None
    appearance.gaussians.sh_constant.fill_(0.4)  # far above the clamp at zero
    degree = math.isqrt(appearance.gaussians.sh_others.shape[1] + 1) - 1
    appearance.gaussians.sh_others.mul_(0.1 / appearance.gaussians.sh_others.abs().max().clamp(min=1e-6))
    found = bake_splats(avatar, avatar.mean_pose(), degree=degree)[-1].sh
    assert torch.allclose(found[:, 0], appearance.gaussians.sh_constant, atol=1e-4)
    assert torch.allclose(found[:, 1:], appearance.gaussians.sh_others, atol=1e-4)


def test_directions_fill_the_cone_of_the_cameras(avatar):
    """Half of them lie around the cameras' mean direction, with nearly all the weight; the others are everywhere."""
    pose = avatar.mean_pose()
    directions, weights = view_directions(avatar, pose)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0)
    inside = weights > weights.mean()
    assert weights[inside].sum() == pytest.approx(1.0)
    assert weights[~inside].sum() < 0.05
    assert np.abs(directions[~inside].mean(0)).max() < 0.05
    center = avatar.verts(pose).mean(0).numpy()
    for camera in avatar.capture.cameras.values():
        seen = center - camera.position
        cosines = directions[inside] @ (seen / np.linalg.norm(seen))
        assert cosines.max() > math.cos(math.radians(15.0))


def test_cameras_follow_the_head(avatar):
    """A head that is turned and moved as a whole looks the same from cameras that are moved with it."""
    mean = avatar.mean_pose()
    moved = replace(
        mean,
        rotation=mean.rotation + torch.tensor([0.0, 0.9, 0.0]),
        translation=mean.translation + torch.tensor([0.3, -0.2, 0.5]),
    )
    seen = []
    for pose in (mean, moved):
        camera = cameras_around(avatar, pose)[0]
        verts = avatar.verts(pose).double().numpy()
        seen.append(verts @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])
    assert np.abs(seen[0] - seen[1]).max() < 1e-5


def test_half_a_turn_shows_the_same_from_the_other_side(avatar, baked):
    """Splats whose y points down look to a camera that is turned with them as before."""
    pose = avatar.mean_pose()
    camera = cameras_around(avatar, pose)[0]
    turned = replace(camera, viewmat=camera.viewmat @ np.diag([1.0, -1.0, -1.0, 1.0]))
    for splats in baked:
        own, found = (
            draw(s.gaussians(view), view, background=torch.ones(3), config=avatar.config.raster).image
            for s, view in ((splats, camera), (splats.upside_down(), turned))
        )
        assert float((own - found).abs().max()) < 1e-4


def test_signs_and_order_of_the_harmonics_are_those_of_the_files():
    """The basis is the real one with the Condon-Shortley phase, by order from -l to l, as scipy has it."""
    direction = np.array([0.48, -0.6, 0.64])
    theta, phi = math.acos(direction[2]), math.atan2(direction[1], direction[0])
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi)
            part = value.imag if order < 0 else value.real
            expected.append(part if order == 0 else math.sqrt(2.0) * part)
    found = sh_basis(torch.tensor(direction[None]), 3)[0]
    assert np.allclose(found.numpy(), expected, atol=1e-6)


# ---- splats ----


def test_a_ply_of_splats_read_back_draws_the_avatar(avatar, tmp_path):
    """62 finite floats per splat, in the usual order and encoding; positions to 1e-6 m."""
    notes = export(avatar, tmp_path / "a.ply", pose="mean")
    rows, comments = read_ply(tmp_path / "a.ply")
    assert list(rows.dtype.names or ()) == SPLAT_COLUMNS
    assert len(rows) == avatar.n_gaussians
    table = columns(rows, *SPLAT_COLUMNS)
    assert np.isfinite(table).all()
    assert not table[:, 3:6].any()
    splats = splats_of_ply(rows)
    assert torch.allclose(splats.quats.norm(dim=1), torch.ones(len(rows)), atol=1e-6)
    camera = avatar.capture.mean_camera()
    own = avatar.gaussians(avatar.mean_pose(), camera)
    assert float((splats.means - own.means).abs().max()) < 1e-6
    assert torch.allclose(splats.scales, own.scales, rtol=1e-5)
    background = torch.tensor(avatar.capture.background)
    image = draw(splats.gaussians(camera), camera, background=background, config=avatar.config.raster).image
    error = (image - avatar.render(avatar.mean_pose(), camera).image).square().mean()
    assert -10.0 * math.log10(float(error)) > 55.0
    assert "pose: mean" in comments
    assert any(line.startswith("psnr_against_the_avatar_by_sh_degree: [") for line in comments)
    assert any("degree 3" in note for note in notes)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_leave_zeros(degree, avatar, tmp_path):
    """By channel: the first columns of each channel are used, the others are zero."""
    export(avatar, tmp_path / "a.ply", degree=degree)
    rows, _ = read_ply(tmp_path / "a.ply")
    used = (degree + 1) ** 2 - 1
    rest = columns(rows, *(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15)
    assert not rest[:, :, used:].any()
    assert used == 0 or rest[:, :, :used].any(axis=(0, 1)).all()


def test_splats_with_y_down(avatar, tmp_path):
    export(avatar, tmp_path / "up.ply")
    export(avatar, tmp_path / "down.ply", up="-y")
    (up, _), (down, comments) = read_ply(tmp_path / "up.ply"), read_ply(tmp_path / "down.ply")
    assert np.array_equal(columns(down, "x", "y", "z"), columns(up, "x", "y", "z") * [1.0, -1.0, -1.0])
    assert "up: -y" in comments


def test_a_glb_of_splats(avatar, tmp_path):
    """KHR_gaussian_splatting: attributes with their types and ranges, and colours for programs that show points."""
    export(avatar, tmp_path / "a.glb", to="splats", pose="mean", degree=2)
    tree, arrays = read_glb(tmp_path / "a.glb")
    assert tree["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert "extensionsRequired" not in tree
    (mesh,) = tree["meshes"]
    (primitive,) = mesh["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    values = {name.removeprefix("KHR_gaussian_splatting:"): arrays[i] for name, i in primitive["attributes"].items()}
    harmonics = {f"SH_DEGREE_{degree}_COEF_{n}" for degree in range(3) for n in range(2 * degree + 1)}
    assert set(values) == {"POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY"} | harmonics
    assert "min" in tree["accessors"][primitive["attributes"]["POSITION"]]
    expected = bake_splats(avatar, avatar.mean_pose(), degree=2)[2]
    assert np.array_equal(values["POSITION"], expected.means.numpy())
    assert np.array_equal(values["SCALE"], expected.scales.numpy())
    assert np.allclose(values["ROTATION"], expected.quats.numpy()[:, [1, 2, 3, 0]], atol=1e-6)
    assert np.allclose(np.linalg.norm(values["ROTATION"], axis=1), 1.0, atol=1e-6)
    assert values["OPACITY"].shape == (len(expected), 1)
    assert 0.0 <= values["OPACITY"].min() <= values["OPACITY"].max() <= 1.0
    assert np.array_equal(values["SH_DEGREE_2_COEF_3"], expected.sh[:, 7].numpy())
    display = np.clip(0.5 + 0.28209479177387814 * expected.sh[:, 0].numpy(), 0.0, 1.0)
    linear = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    assert np.allclose(values["COLOR_0"][:, :3], linear, atol=1e-5)
    assert np.array_equal(values["COLOR_0"][:, 3:], values["OPACITY"])
    assert tree["asset"]["extras"]["pose"] == "mean"


@pytest.mark.parametrize("n", [0, 1])
@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_an_avatar_with_hardly_any_gaussians(n, suffix, tmp_path):
    """No Gaussian and one Gaussian are exported like many."""
    avatar = Avatar.load(DATA / "format2_color_net.pt")
    assert avatar.appearance is not None
    avatar.appearance.resize(n)
    path = tmp_path / f"a{suffix}"
    export(avatar, path, to="mesh" if suffix == ".obj" else "splats")
    if suffix == ".ply":
        assert len(read_ply(path)[0]) == n
    elif suffix == ".glb":
        tree, arrays = read_glb(path)
        assert ("meshes" in tree) == ("extensionsUsed" in tree) == bool(n)
        assert all(len(array) == 1 for array in arrays)


def test_an_avatar_without_appearance_gives_its_vertex_gaussians(plain, tmp_path):
    """One opaque splat per vertex, of the same colour from everywhere, and a line that says so."""
    notes = export(plain, tmp_path / "a.ply", pose="mean")
    rows, _ = read_ply(tmp_path / "a.ply")
    splats = splats_of_ply(rows)
    assert len(rows) == plain.head.body.n_verts
    assert np.isfinite(rows["opacity"]).all()
    assert float(splats.opacities.min()) > 0.99999
    view = splats.gaussians(look_at((0.3, 0.2, 1.0), (0.0, 0.0, 0.0), focal=100.0, width=8, height=8))
    assert torch.allclose(view.colors, torch.tensor(COLOR).expand_as(view.colors), atol=1e-5)
    assert any("no appearance" in note for note in notes)


def test_extreme_numbers_stay_finite(tmp_path):
    """Opacities of 0 and 1 have no logit, and a scale of 0 has no logarithm."""
    ends = torch.tensor([0.0, 1.0])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1)
    splats = Splats(torch.zeros(2, 3), quats, ends[:, None].repeat(1, 3), ends, torch.zeros(2, 1, 3))
    write_splats_ply(tmp_path / "a.ply", splats, comments=["two\nlines and a letter: ä"])
    rows, comments = read_ply(tmp_path / "a.ply")
    assert all(np.isfinite(rows[name]).all() for name in rows.dtype.names or ())
    assert np.all(np.diff(rows["opacity"]) > 20.0)
    assert comments == ["two lines and a letter: ?"]


# ---- meshes ----


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".glb"])
def test_meshes_are_read_by_trimesh(suffix, avatar, tmp_path):
    """The same surface to 1e-6 m, facing outwards; in a PLY also the same vertices, with their colours."""
    path = tmp_path / f"a{suffix}"
    export(avatar, path, to="mesh", pose="mean")
    found = trimesh.load(path, force="mesh", process=False)
    expected = bake_mesh(avatar, avatar.mean_pose())
    assert np.abs(found.vertices[found.faces] - expected.verts[expected.faces]).max() < 1e-6
    assert found.volume == pytest.approx(trimesh.Trimesh(expected.verts, expected.faces).volume, rel=1e-4)
    assert found.volume > 0.0
    if suffix == ".ply":
        assert np.array_equal(found.faces, expected.faces)
        colors = found.visual.vertex_colors[:, :3] / 255.0
        assert np.abs(colors - expected.colors).max() < 0.5 / 255.0 + 1e-6


def test_an_obj_has_colours_and_seams(avatar, tmp_path):
    """Vertices keep the order of the head model; each corner of a face has its own texture coordinate."""
    export(avatar, tmp_path / "a.obj", pose="mean")
    lines = [line.split() for line in (tmp_path / "a.obj").read_text("utf-8").splitlines()]
    vertices = np.array([line[1:] for line in lines if line[0] == "v"], float)
    texture = np.array([line[1:] for line in lines if line[0] == "vt"], float)
    faces = np.array([[corner.split("/") for corner in line[1:]] for line in lines if line[0] == "f"], int) - 1
    expected = bake_mesh(avatar, avatar.mean_pose())
    assert np.abs(vertices[:, :3] - expected.verts).max() < 1e-6
    assert np.abs(vertices[:, 3:] - expected.colors).max() < 1e-4
    assert np.abs(texture - expected.vt).max() < 1e-6
    assert np.array_equal(faces[:, :, 0], expected.faces)
    assert np.array_equal(faces[:, :, 1], expected.ft)
    assert ["#", "pose:", "mean"] in lines


def test_a_glb_of_the_mesh(avatar, tmp_path):
    """Split at the seams of the texture, with linear colours, unit normals and v that points down."""
    export(avatar, tmp_path / "a.glb", pose="mean")
    tree, arrays = read_glb(tmp_path / "a.glb")
    primitive = tree["meshes"][0]["primitives"][0]
    values = {name: arrays[index] for name, index in primitive["attributes"].items()}
    faces = arrays[primitive["indices"]].reshape(-1, 3)
    expected = bake_mesh(avatar, avatar.mean_pose())
    assert np.array_equal(values["POSITION"][faces], expected.verts[expected.faces])
    assert np.allclose(values["TEXCOORD_0"][faces] * [1.0, -1.0] + [0.0, 1.0], expected.vt[expected.ft], atol=1e-6)
    assert np.allclose(np.linalg.norm(values["NORMAL"], axis=1), 1.0, atol=1e-5)
    display = expected.colors[expected.faces]
    linear = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    assert np.allclose(values["COLOR_0"][faces], linear, atol=1e-5)


def test_splitting_at_seams_splits_nothing_else(avatar):
    """As many vertices as there are different pairs, and none that no face uses."""
    mesh = bake_mesh(avatar, avatar.mean_pose())
    corners, faces = split_at_seams(mesh)
    pairs = set(zip(mesh.faces.reshape(-1).tolist(), mesh.ft.reshape(-1).tolist(), strict=True))
    assert set(map(tuple, corners.tolist())) == pairs
    assert len(corners) == len(pairs)
    assert np.array_equal(corners[faces][:, :, 0], mesh.faces)


def test_the_colours_of_a_mesh_are_those_of_its_vertices(avatar, plain):
    """With an appearance and without."""
    assert np.allclose(bake_mesh(plain, plain.mean_pose()).colors, COLOR, atol=1e-5)
    expected = (0.5 + 0.28209479177387814 * avatar.vertex_gaussians.colors).clamp(0.0, 1.0)
    assert np.allclose(bake_mesh(avatar, avatar.mean_pose()).colors, expected.numpy(), atol=1e-6)


def test_the_colours_of_a_mesh_without_a_geometry_stage():
    """They are those of the Gaussians around: all of one colour give that colour."""
    own = Avatar.load(DATA / "format2_sh.pt")
    assert own.appearance is not None
    own.appearance.offset_net = None
    own.vertex_gaussians.colors.zero_()
    own.appearance.gaussians.sh_others.zero_()
    own.appearance.gaussians.sh_constant.copy_(
        torch.tensor([0.5, -0.5, 0.1]).expand_as(own.appearance.gaussians.sh_constant)
    )
    colors = bake_mesh(own, own.mean_pose()).colors
    assert np.allclose(colors, 0.5 + 0.28209479177387814 * np.array([0.5, -0.5, 0.1]), atol=1e-4)


# ---- rigs ----


def gltf_pose(path: Path, *, frame: int | None = None) -> np.ndarray:
    """Pose the mesh of a GLB as glTF says, at rest or at a frame of its animation, and return its vertices."""
    tree, arrays = read_glb(path)
    nodes = [dict(node) for node in tree["nodes"]]
    mesh, (primitive,) = tree["meshes"][0], tree["meshes"][0]["primitives"]
    weights = np.array(mesh.get("weights", ()))
    if frame is not None:
        animation = tree["animations"][0]
        for channel in animation["channels"]:
            sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
            times = arrays[sampler["input"]]
            values = arrays[sampler["output"]].reshape(len(times), -1)[frame]
            nodes[target["node"]][target["path"]] = values
            weights = values if target["path"] == "weights" else weights
    attributes = {name: arrays[index].astype(float) for name, index in primitive["attributes"].items()}
    verts = attributes["POSITION"].copy()
    for weight, morph in zip(weights, primitive.get("targets", ()), strict=True):
        verts += weight * arrays[morph["POSITION"]]
    world: dict[int, np.ndarray] = {}

    def place(index: int, above: np.ndarray) -> None:
        local = np.eye(4)
        local[:3, :3] = Rotation.from_quat(nodes[index].get("rotation", (0, 0, 0, 1))).as_matrix()
        local[:3, 3] = nodes[index].get("translation", (0, 0, 0))
        world[index] = above @ local
        for child in nodes[index].get("children", ()):
            place(child, world[index])

    for root in tree["scenes"][0]["nodes"]:
        place(root, np.eye(4))
    skin = tree["skins"][0]
    inverse = arrays[skin["inverseBindMatrices"]].reshape(-1, 4, 4).transpose(0, 2, 1)
    matrices = np.stack([world[joint] for joint in skin["joints"]]) @ inverse
    joints, shares = attributes["JOINTS_0"].astype(int), attributes["WEIGHTS_0"]
    assert np.allclose(shares.sum(1), 1.0, atol=1e-6)
    assert not joints[shares == 0.0].any()
    blended = np.einsum("vk,vkij->vij", shares, matrices[joints])
    return np.einsum("vij,vj->vi", blended[:, :3, :3], verts) + blended[:, :3, 3]


@pytest.fixture
def moving(avatar: Avatar, tmp_path: Path) -> Driving:
    """Four frames in which everything moves; neck and jaw turn beyond half a turn of their quaternions' sign."""
    rng = np.random.default_rng(5)
    widths = {"expr": avatar.head_model.n_expr, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6}
    rows = {name: rng.normal(0.0, 0.4, (4, width)).astype(np.float32) for name, width in widths.items()}
    rows["rotation"][:, 1] = [2.9, 3.1, 3.3, 3.5]
    rows["translation"] = rng.normal(0.0, 0.2, (4, 3)).astype(np.float32)
    np.savez(tmp_path / "moving.npz", **rows, fps=10.0, expr_basis=avatar.head_model.expr_basis)
    return read_driving(tmp_path / "moving.npz")


def test_a_rig_is_the_avatar_where_that_is_linear(moving, tmp_path):
    """Posed as glTF says, it is the head: at every frame, and in the pose of its nodes."""
    avatar = tiny_avatar(tmp_path)[0]
    body = avatar.head.body
    body.has_pose_dirs = False  # a rig cannot hold correctives by pose, and no more than four weights per vertex
    body.lbs_weights[:, 4] = 0.0
    body.lbs_weights /= body.lbs_weights.sum(1, keepdim=True)
    notes = export(avatar, tmp_path / "a.glb", to="rig", driving=moving, pose="mean")
    corners, _ = split_at_seams(bake_mesh(avatar, avatar.mean_pose()))
    poses = poses_of(avatar, moving)
    for frame, pose in [(None, avatar.mean_pose()), *enumerate(poses)]:
        found = gltf_pose(tmp_path / "a.glb", frame=frame)
        assert np.abs(found - avatar.verts(pose).numpy()[corners[:, 0]]).max() < 1e-5
    assert any("rig with 3 expressions: 0.00 mm from the avatar over poses of the motion" in note for note in notes)


def test_a_rig_in_a_file_is_the_baked_one(plain, moving, tmp_path):
    """Also where a vertex has more weights than a file may hold."""
    export(plain, tmp_path / "a.glb", to="rig", driving=moving)
    rig = bake_rig(plain, n_expr=50)
    assert int((rig.weights > 0.0).sum(1).max()) <= 4
    corners, _ = split_at_seams(bake_mesh(plain, plain.mean_pose()))
    for frame, pose in enumerate(poses_of(plain, moving)):
        found = gltf_pose(tmp_path / "a.glb", frame=frame)
        assert np.abs(found - rig.posed(pose).numpy()[corners[:, 0]]).max() < 1e-5


def test_the_error_of_a_rig_is_that_of_its_correctives(plain):
    """In millimetres, over vertices and poses."""
    rig = bake_rig(plain, n_expr=50)
    pose = plain.head.pose(0)
    distances = 1000.0 * (rig.posed(pose) - plain.verts(pose)).norm(dim=1)
    mean, largest = rig_error(plain, rig, [pose])
    assert mean == pytest.approx(float(distances.mean()))
    assert largest == pytest.approx(float(distances.max()))
    assert mean > 0.0


def test_the_animation_of_a_rig(avatar, moving, tmp_path):
    """One sampler per joint, one for the place and one for the expression; times in seconds; no jump of a sign."""
    export(avatar, tmp_path / "a.glb", to="rig", driving=moving)
    tree, arrays = read_glb(tmp_path / "a.glb")
    (animation,) = tree["animations"]
    assert len(animation["channels"]) == len(animation["samplers"]) == 7
    times = arrays[animation["samplers"][0]["input"]]
    assert np.allclose(times[:, 0], [0.0, 0.1, 0.2, 0.3])
    turns = arrays[animation["samplers"][0]["output"]]
    assert (turns[1:] * turns[:-1]).sum(1).min() > 0.9
    names = tree["meshes"][0]["extras"]["targetNames"]
    assert len(names) == len(tree["meshes"][0]["weights"]) == min(50, avatar.head_model.n_expr)
    assert [tree["nodes"][joint]["name"] for joint in tree["skins"][0]["joints"]] == [
        "root", "neck", "jaw", "left_eye", "right_eye",
    ]  # fmt: skip


def test_a_rig_with_fewer_expressions(avatar, tmp_path):
    """The first ones; none at all leaves a skin alone, and without a motion there is no animation."""
    for n in (0, 2):
        export(avatar, tmp_path / f"{n}.glb", to="rig", morphs=n)
        tree, _ = read_glb(tmp_path / f"{n}.glb")
        assert len(tree["meshes"][0].get("weights", ())) == n
        assert "animations" not in tree
    with pytest.raises(DataError, match="--morphs -1"):
        export(avatar, tmp_path / "a.glb", to="rig", morphs=-1)


# ---- poses ----


def test_poses_by_their_names(avatar, driving):
    """Neutral is upright at the origin; frames are those of the motion, or of the capture."""
    neutral, _ = export_pose(avatar, "neutral")
    assert all(not bool(value.any()) for value in vars(neutral).values())
    frame, name = export_pose(avatar, "2", driving)
    assert float(frame.jaw_pose[0]) == pytest.approx(0.2)
    assert torch.equal(frame.translation, poses_of(avatar, driving)[2].translation)
    assert name == "frame 2 of motion.npz"
    own, _ = export_pose(avatar, "1")
    assert torch.equal(own.rotation, avatar.head.poses["rotation"][1])


def test_blendshapes_need_a_map_and_take_it(avatar, tmp_path):
    """As in a rendering: a frame of ARKit's blendshapes goes through the map that is given."""
    motion = Driving(
        **vars(HeadParams.neutral(n_frames=2, n_expr=1)) | {"expr": np.array([[0.0], [0.5]], np.float32)},
        expr_basis="arkit",
        expr_names=("jawOpen",),
        path=tmp_path / "phone.csv",
    )
    zeros = np.zeros((1, avatar.head_model.n_expr), np.float32)
    given = ExpressionMap(("jawOpen",), zeros, np.array([[0.4, 0.0, 0.0]], np.float32), np.zeros((1, 6)), np.zeros(1))
    pose, _ = export_pose(avatar, "1", motion, expression_map=given)
    assert float(pose.jaw_pose[0]) == pytest.approx(0.2)
    export(avatar, tmp_path / "a.glb", to="rig", driving=motion, expression_map=given)
    assert len(read_glb(tmp_path / "a.glb")[0]["animations"]) == 1


@pytest.mark.parametrize(
    ("pose", "driven", "words"),
    [
        ("3", True, "has 3 frames, 0 to 2"),
        ("99999", False, "the capture has"),
        ("smile", False, "give neutral, mean or the number of a frame"),
        ("-1", False, "give neutral, mean or the number of a frame"),
        ("neutral", True, "is no frame of"),
    ],
)
def test_poses_that_do_not_exist(pose, driven, words, avatar, driving):
    with pytest.raises(DataError, match=words):
        export_pose(avatar, pose, driving if driven else None)


# ---- what is refused ----


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("a.fbx", {}, "unknown suffix; give a name ending in .ply, .glb, .obj or .stl"),
        ("a", {}, "unknown suffix"),
        ("a.spz", {}, "npx @playcanvas/splat-transform a.ply a.spz"),
        ("a.obj", {"to": "splats"}, "a .obj file cannot have splats; give a name ending in .ply or .glb"),
        ("a.glb", {"up": "-y"}, "y points up"),
        ("there.ply", {}, "already exists; give --out another name, or --overwrite"),
        ("folder.ply", {"overwrite": True}, "is a folder"),
        ("none/a.ply", {}, "does not exist; make it first"),
    ],
)
def test_files_that_are_refused(name, options, words, plain, tmp_path):
    """Before any work, in one line, and nothing is left behind or changed."""
    (tmp_path / "there.ply").write_bytes(b"precious")
    (tmp_path / "folder.ply").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DataError, match=words.replace(".", r"\.")):
        export(plain, tmp_path / name, **options)
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "there.ply").read_bytes() == b"precious"


def test_a_file_is_replaced_if_it_may_be(plain, tmp_path):
    (tmp_path / "a.ply").write_bytes(b"old")
    export(plain, tmp_path / "a.ply", overwrite=True)
    assert (tmp_path / "a.ply").read_bytes().startswith(b"ply")


def test_arrays_that_gltf_does_not_have():
    """Another type, another shape, nothing at all."""
    for values in (np.zeros((2, 3)), np.zeros((2, 5), np.float32), np.zeros((0, 3), np.float32)):
        with pytest.raises(ValueError, match="no accessor"):
            Glb().add(values)


# ---- the command ----


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr("sys.argv", ["mgavatar", *map(str, words)])
    try:
        cli.main()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def test_the_command(monkeypatch, capsys, driving, tmp_path):
    """It prints the file on stdout and what is lost on stderr; a second time it refuses."""
    words = ("export", "--avatar", DATA / "format2_color_net.pt", "--out", tmp_path / "a.ply")
    more = ("--pose", "1", "--driving", driving.path, "--degree", "1")
    assert run(monkeypatch, *words, *more) == 0
    said = capsys.readouterr()
    assert said.out.strip() == str(tmp_path / "a.ply")
    assert "degree 1 " in said.err
    assert "pose: frame 1 of motion.npz" in read_ply(tmp_path / "a.ply")[1]
    assert run(monkeypatch, *words) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert run(monkeypatch, *words, "--degree", "4") == 2


@pytest.mark.parametrize("suffix", [".obj", ".PLY", ".glb"])
def test_render_does_not_write_meshes(suffix, monkeypatch, capsys, driving, tmp_path):
    """A name like that is refused with the command for it; no folder of pictures gets the name."""
    out = tmp_path / f"x{suffix}"
    words = ("render", "--avatar", DATA / "format2_color_net.pt", "--driving", driving.path, "--out", out)
    assert run(monkeypatch, *words) == 1
    assert "`mgavatar export`" in capsys.readouterr().err
    assert not out.exists()
