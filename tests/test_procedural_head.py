"""The built-in head: a sound mesh and atlas, a rig, and directions that do what their names say."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mgavatar.head.model import HeadModel
from mgavatar.head.procedural.build import build_head

EYES = {"left_eyeball": (0.031, 0.023, 0.024), "right_eyeball": (-0.031, 0.023, 0.024)}
EYE_RADIUS = 0.0118
ARRAYS = ("v_template", "faces", "shapedirs", "posedirs", "J_regressor", "lbs_weights", "parents", "vt", "ft")


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return build_head()


@pytest.fixture(scope="module")
def surface(head: HeadModel) -> trimesh.Trimesh:
    return trimesh.Trimesh(head.v_template, head.faces, process=False)


def shaped(head: HeadModel, **expr: float) -> np.ndarray:
    """The template with named expressions, [V, 3] [m]."""
    columns = [head.n_shape + head.expr_names.index(name) for name in expr]
    return head.v_template + head.shapedirs[:, :, columns].astype(float) @ np.array(list(expr.values()))


def posed(head: HeadModel, joint: str, rotvec: tuple[float, float, float]) -> np.ndarray:
    """Linear blend skinning of the template with one joint turned, [V, 3] [m]."""
    names = ("root", "neck", "jaw", "left_eye", "right_eye")
    rotations = np.tile(np.eye(3), (5, 1, 1))
    rotations[names.index(joint)] = Rotation.from_rotvec(rotvec).as_matrix()
    joints = head.J_regressor.astype(float) @ head.v_template
    verts = head.v_template + head.posedirs @ (rotations[1:] - np.eye(3)).ravel()
    world: list[np.ndarray] = []
    for j, parent in enumerate(head.parents):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0.0)
        world.append(local if parent < 0 else world[parent] @ local)
    chain = np.stack(world)
    chain[:, :3, 3] -= np.einsum("jab,jb->ja", chain[:, :3, :3], joints)
    blended = np.einsum("vj,jab->vab", head.lbs_weights, chain)
    return np.einsum("vab,vb->va", blended[:, :3, :3], verts) + blended[:, :3, 3]


def lip(head: HeadModel, *, upper: bool) -> np.ndarray:
    """Vertices of the middle of one lip."""
    x, y, _ = head.v_template.T
    side = y > -0.0465 if upper else y < -0.0490
    return np.flatnonzero(head.masks["lips"] & side & (np.abs(x) < 0.008))


def lid_edges(head: HeadModel) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that the left blink moves down and up by more than 0.8 mm and that bound the opening."""
    blink = shaped(head, blink_L=1.0) - head.v_template
    near = np.linalg.norm(head.v_template - EYES["left_eyeball"], axis=1) < 0.0142
    near &= head.masks["face"] & (np.abs(head.v_template[:, 0] - 0.031) < 0.009)
    upper, lower = near & (blink[:, 1] < -2e-3), near & (blink[:, 1] > 8e-4)
    return np.flatnonzero(upper), np.flatnonzero(lower)


def test_schema_shapes_and_types(head: HeadModel) -> None:
    n_verts, n_faces = len(head.v_template), len(head.faces)
    assert 4500 <= n_verts <= 5600
    assert 9000 <= n_faces <= 11500
    assert (head.n_shape, head.n_expr, len(head.expr_names), len(set(head.expr_names))) == (300, 100, 100, 100)
    shapes = {
        "v_template": (n_verts, 3), "faces": (n_faces, 3), "shapedirs": (n_verts, 3, 400), "posedirs": (n_verts, 3, 36),
        "J_regressor": (5, n_verts), "lbs_weights": (n_verts, 5), "parents": (5,), "vt": (len(head.vt), 2),
        "ft": (n_faces, 3),
    }  # fmt: skip
    for name in ARRAYS:
        array = getattr(head, name)
        assert array.shape == shapes[name], name
        assert array.dtype == (np.int32 if name in ("faces", "ft", "parents") else np.float32), name
        assert np.isfinite(array).all(), name
    assert head.parents.tolist() == [-1, 0, 1, 1, 1]
    assert head.expr_basis == "procedural"
    assert head.faces.min() == 0
    assert np.array_equal(np.unique(head.faces), np.arange(n_verts))
    assert np.array_equal(np.unique(head.ft), np.arange(len(head.vt)))


def test_masks_cover_what_they_name(head: HeadModel) -> None:
    masks, verts = head.masks, head.v_template
    for name, mask in masks.items():
        assert mask.shape == (len(verts),), name
        assert mask.dtype == bool, name
        assert mask.any(), name
    assert np.array_equal(masks["eyeballs"], masks["left_eyeball"] | masks["right_eyeball"])
    assert np.array_equal(masks["teeth"], masks["upper_teeth"] | masks["lower_teeth"])
    assert not (masks["face"] & (masks["scalp"] | masks["neck"] | masks["ears"] | masks["eyeballs"])).any()
    skin_regions = np.sum([masks[name] for name in ("face", "scalp", "neck", "ears", "shoulders")], axis=0)
    inside = masks["eyeballs"] | masks["teeth"] | masks["mouth_socket"]
    np.testing.assert_array_equal(skin_regions + inside, 1)
    assert (masks["face"] & masks["lips"]).sum() == masks["lips"].sum()
    assert verts[masks["boundary"], 1].max() < -0.16
    assert verts[masks["scalp"], 1].max() == verts[:, 1].max()
    assert np.argmax(np.where(masks["nose"], verts[:, 2], -1)) == np.argmax(verts[:, 2])


def test_weights_and_regressor_rows_sum_to_one(head: HeadModel) -> None:
    np.testing.assert_allclose(head.lbs_weights.sum(axis=1), 1.0, atol=1e-6)
    assert head.lbs_weights.min() >= 0.0
    np.testing.assert_allclose(head.J_regressor.sum(axis=1), 1.0, atol=1e-5)
    np.testing.assert_array_equal(head.lbs_weights[head.masks["upper_teeth"], 1], 1.0)
    np.testing.assert_array_equal(head.lbs_weights[head.masks["lower_teeth"], 2], 1.0)
    np.testing.assert_array_equal(head.lbs_weights[head.masks["boundary"], 0], 1.0)
    for column, name in ((3, "left_eyeball"), (4, "right_eyeball")):
        np.testing.assert_array_equal(head.lbs_weights[:, column], head.masks[name].astype(np.float32))


def test_joints_are_inside_the_head_and_regress_locally(head: HeadModel) -> None:
    joints = head.J_regressor @ head.v_template
    wanted = [(0, -0.165, -0.045), (0, -0.12, -0.035), (0, -0.002, -0.03), *EYES.values()]
    np.testing.assert_allclose(joints, wanted, atol=2e-5)
    for joint, row in zip(joints, head.J_regressor, strict=True):
        assert np.linalg.norm(head.v_template[row != 0] - joint, axis=1).max() < 0.14
        assert row.min() >= 0.0


def test_two_builds_give_the_same_bits(head: HeadModel) -> None:
    def digest(model: HeadModel) -> str:
        arrays = [getattr(model, name) for name in ARRAYS] + [model.masks[name] for name in sorted(model.masks)]
        return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()

    assert digest(build_head.__wrapped__()) == digest(head)
    assert build_head() is head


def test_mesh_is_manifold_and_faces_outwards(head: HeadModel, surface: trimesh.Trimesh) -> None:
    edges = np.sort(head.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2
    assert surface.is_winding_consistent
    parts = surface.split(only_watertight=False)
    assert len(parts) == 5  # skin, two eyeballs, two rows of teeth
    balls = [part for part in parts if part.is_watertight]
    assert len(balls) == 2
    for ball in balls:
        assert ball.volume == pytest.approx(4 / 3 * np.pi * EYE_RADIUS**3, rel=0.06)
    assert surface.area_faces.min() > 1e-9
    tip = np.argmax(head.v_template[:, 2])
    assert surface.vertex_normals[tip] @ [0.0, 0.0, 1.0] > 0.9
    crown, back = np.argmax(head.v_template[:, 1]), np.argmin(head.v_template[:, 2])
    assert surface.vertex_normals[crown] @ [0.0, 1.0, 0.0] > 0.9
    assert surface.vertex_normals[back] @ [0.0, 0.0, -1.0] > 0.8


def test_skin_has_three_openings(head: HeadModel) -> None:
    """The bust rim and the edges inside the two pairs of lids; the mouth is closed by its socket."""
    skin = ~(head.masks["eyeballs"] | head.masks["teeth"])
    faces = head.faces[skin[head.faces].all(axis=1)]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    outline = trimesh.graph.connected_components(unique[count == 1])
    heights = sorted(round(float(head.v_template[loop, 1].mean()), 2) for loop in outline)
    assert heights == [-0.2, 0.02, 0.02]


def test_size_is_that_of_flame(head: HeadModel) -> None:
    verts = head.v_template
    skull = head.masks["scalp"] | head.masks["face"]
    assert np.ptp(verts[skull, 0]) == pytest.approx(0.152, abs=0.006)
    assert verts[:, 1].max() - verts[head.masks["face"], 1].min() == pytest.approx(0.235, abs=0.012)
    rim = head.masks["boundary"]
    assert np.abs(verts[rim, 0]).max() == pytest.approx(0.122, abs=0.004)
    assert verts[:, 1].min() == pytest.approx(-0.204, abs=0.006)


def test_mirror_symmetry(head: HeadModel) -> None:
    key = np.round(head.v_template * [1e6, 1e6, 1e6]).astype(np.int64)
    flipped = key * [-1, 1, 1]
    assert np.array_equal(np.unique(key, axis=0), np.unique(flipped, axis=0))


def test_atlas_covers_no_texel_twice(head: HeadModel) -> None:
    a, b, c = (head.vt[head.ft[:, k]].astype(float) for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert head.vt.min() > 0.0
    assert head.vt.max() < 1.0
    assert area.min() > 1e-8
    size = 1024
    count = np.zeros((size, size), np.int32)
    for triangle in np.stack([a, b, c], axis=1) * size:
        low = np.floor(triangle.min(axis=0) - 0.5).astype(int)
        high = np.ceil(triangle.max(axis=0) + 0.5).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        inside = np.ones_like(x, bool)
        for start, end in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
            inside &= (end[0] - start[0]) * (y - start[1]) - (end[1] - start[1]) * (x - start[0]) > 1e-6
        count[low[1] : high[1], low[0] : high[0]] += inside
    assert count.max() == 1
    assert (count > 0).mean() > 0.75


def test_face_gets_the_largest_share_of_the_atlas(head: HeadModel) -> None:
    a, b, c = (head.vt[head.ft[:, k]].astype(float) for k in range(3))
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    share = {name: area[mask[head.faces].all(axis=1)].sum() for name, mask in head.masks.items()}
    largest = max((n for n in share if n not in ("forehead", "nose")), key=share.__getitem__)
    assert largest == "face"


def test_jaw_lowers_the_lower_lip_alone(head: HeadModel) -> None:
    moved = posed(head, "jaw", (0.3, 0.0, 0.0)) - head.v_template
    assert moved[lip(head, upper=False), 1].max() < -0.008
    assert np.abs(moved[lip(head, upper=True)]).max() < 0.0015
    assert np.abs(moved[head.masks["upper_teeth"]]).max() < 1e-6
    assert np.abs(moved[head.masks["eyeballs"]]).max() < 1e-6
    assert np.abs(moved[head.masks["boundary"]]).max() < 1e-6


def test_neck_turns_the_head_and_leaves_the_bust(head: HeadModel) -> None:
    turn = Rotation.from_rotvec((0.0, 0.4, 0.0)).as_matrix()
    moved = posed(head, "neck", (0.0, 0.4, 0.0))
    joint = (head.J_regressor @ head.v_template)[1]
    skull = head.masks["scalp"] & (head.lbs_weights[:, 1] == 1.0)
    np.testing.assert_allclose(moved[skull], (head.v_template[skull] - joint) @ turn.T + joint, atol=1e-5)
    np.testing.assert_allclose(moved[head.masks["boundary"]], head.v_template[head.masks["boundary"]], atol=1e-5)


def test_gaze_turns_the_eyeballs_about_their_centres(head: HeadModel) -> None:
    moved = posed(head, "left_eye", (0.0, 0.4, 0.0))
    ball = head.masks["left_eyeball"]
    radius = np.linalg.norm(moved[ball] - EYES["left_eyeball"], axis=1)
    np.testing.assert_allclose(radius, EYE_RADIUS, rtol=2e-3)
    assert np.abs(moved - head.v_template)[head.masks["right_eyeball"]].max() < 1e-6


def test_pose_correctives_are_small_and_local(head: HeadModel) -> None:
    for joint, axis in (("neck", 0), ("neck", 1), ("neck", 2), ("jaw", 0), ("jaw", 1)):
        rotation = Rotation.from_rotvec(0.5 * np.eye(3)[axis]).as_matrix() - np.eye(3)
        first = 9 * ("neck", "jaw").index(joint)
        offset = np.linalg.norm(head.posedirs[:, :, first : first + 9] @ rotation.ravel(), axis=1)
        assert 5e-4 < offset.max() < 6e-3, (joint, axis)
        assert offset[head.masks["eyeballs"] | head.masks["teeth"] | head.masks["boundary"]].max() < 1e-4


def test_blink_closes_the_lids_outside_the_eyeball(head: HeadModel) -> None:
    upper, lower = lid_edges(head)
    assert len(upper) >= 7
    assert len(lower) >= 7
    for amount in (0.25, 0.5, 0.75, 1.0):
        verts = shaped(head, blink_L=amount, blink_R=amount)
        for centre in EYES.values():
            distance = np.linalg.norm(verts[~head.masks["eyeballs"]] - centre, axis=1)
            assert distance.min() > EYE_RADIUS, amount
    closed = shaped(head, blink_L=1.0)
    for x in np.linspace(0.0245, 0.0375, 8):
        edge_above = closed[upper][np.abs(closed[upper, 0] - x) < 0.002, 1].min()
        edge_below = closed[lower][np.abs(closed[lower, 0] - x) < 0.002, 1].max()
        assert edge_above - edge_below < 0.0015
        opened_above = head.v_template[upper][np.abs(head.v_template[upper, 0] - x) < 0.002, 1].min()
        opened_below = head.v_template[lower][np.abs(head.v_template[lower, 0] - x) < 0.002, 1].max()
        assert opened_above - opened_below > 0.004


def test_expressions_leave_eyeballs_and_upper_teeth(head: HeadModel) -> None:
    expr = head.shapedirs[:, :, head.n_shape :]
    assert np.abs(expr[head.masks["eyeballs"] | head.masks["upper_teeth"]]).max() == 0.0
    assert np.abs(expr[head.masks["boundary"]]).max() == 0.0
    largest = np.linalg.norm(expr, axis=1).max(axis=0)
    assert largest.min() > 5e-4
    assert largest.max() < 0.03


def test_expression_pairs_mirror_each_other_and_keep_their_side(head: HeadModel) -> None:
    x = head.v_template[:, 0]
    on_right, on_left = x < -0.008, x > 0.008
    pairs = [name[:-2] for name in head.expr_names if name.endswith("_L")]
    assert len(pairs) >= 40
    for name in pairs:
        left = head.shapedirs[:, :, head.n_shape + head.expr_names.index(f"{name}_L")]
        right = head.shapedirs[:, :, head.n_shape + head.expr_names.index(f"{name}_R")]
        assert np.abs(left[on_right]).max() < 1e-5, name
        assert np.abs(right[on_left]).max() < 1e-5, name
        np.testing.assert_allclose(left.sum(axis=0) * [-1, 1, 1], right.sum(axis=0), atol=1e-5, err_msg=name)


@pytest.mark.parametrize(
    ("name", "region", "axis", "sign"),
    [
        ("smile_L", "lips", 1, 1),
        ("frown_L", "lips", 1, -1),
        ("pucker", "lips", 2, 1),
        ("jaw_open", "lower_teeth", 1, -1),
        ("brow_inner_up_L", "face", 1, 1),
        ("brow_down_L", "face", 1, -1),
        ("mouth_left", "lips", 0, 1),
        ("nose_sneer_L", "nose", 1, 1),
        ("upper_lip_raise_L", "lips", 1, 1),
        ("lower_lip_depress_L", "lips", 1, -1),
    ],
)
def test_expressions_move_what_they_name(head: HeadModel, name: str, region: str, axis: int, sign: int) -> None:
    moved = (shaped(head, **{name: 1.0}) - head.v_template)[head.masks[region]]
    strongest = moved[np.argmax(np.abs(moved[:, axis])), axis]
    assert sign * strongest > 0.002


def test_identity_keeps_the_eyeballs_round_and_in_their_sockets(head: HeadModel) -> None:
    rng = np.random.default_rng(3)
    for _ in range(8):
        betas = rng.normal(size=head.n_shape)
        verts = head.v_template + head.shapedirs[:, :, : head.n_shape].astype(float) @ betas
        for name in EYES:
            centre = head.J_regressor[3 + list(EYES).index(name)] @ verts
            radius = np.linalg.norm(verts[head.masks[name]] - centre, axis=1)
            assert np.ptp(radius) / radius.mean() < 0.02
            skin = ~(head.masks["eyeballs"] | head.masks["teeth"] | head.masks["mouth_socket"])
            assert np.linalg.norm(verts[skin] - centre, axis=1).min() > 0.97 * EYE_RADIUS


def test_identity_has_the_spread_of_people(head: HeadModel) -> None:
    directions = head.shapedirs[:, :, : head.n_shape].astype(float).reshape(-1, head.n_shape)
    rms = np.sqrt((directions**2).sum(axis=0) / len(head.v_template)) * 1000
    assert rms[:10].min() > 0.7
    assert rms[0] > 1.9
    assert np.all(rms[:10][:-1] >= rms[1:10] - 1e-6)
    assert 3.0 < np.sqrt((rms**2).sum()) < 5.5
    gram = directions.T @ directions / np.outer(*[np.linalg.norm(directions, axis=0)] * 2)
    assert np.abs(gram - np.eye(head.n_shape)).max() < 1e-3


def test_people_and_expressions_do_not_fold_the_mesh(head: HeadModel) -> None:
    """No face turns over for a random person; a few tiny ones in the corners of lids and lips may for an expression."""

    def normals(verts: np.ndarray) -> np.ndarray:
        a, b, c = (verts[head.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    at_rest = normals(head.v_template.astype(float))
    rng = np.random.default_rng(5)
    for _ in range(5):
        verts = head.v_template + head.shapedirs[:, :, : head.n_shape].astype(float) @ rng.normal(size=head.n_shape)
        assert np.sum(normals(verts) * at_rest, axis=1).min() > 0.0
    for name in head.expr_names:
        moved = normals(shaped(head, **{name: 1.0}))
        turned = np.sum(moved * at_rest, axis=1) <= 0.0
        assert turned.sum() <= 10, name
        assert 0.5 * np.linalg.norm(at_rest[turned], axis=1).sum() < 1.5e-5, name
