"""The head as tensors: FLAME's forward pass, subdivision, normals and edge lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from ball_head import ball_head
from scipy.spatial.transform import Rotation

from mgavatar.head.body import Body
from mgavatar.head.model import HeadModel
from mgavatar.head.params import HeadParams, Pose, pad_or_truncate
from mgavatar.head.procedural.build import build_head
from mgavatar.head.subdivide import subdivide

ROTATIONS = ("rotation", "neck_pose", "jaw_pose", "eyes_pose")


@pytest.fixture(scope="module", params=["ball", "built"])
def model(request) -> HeadModel:
    """A head of noise, in which every part of the pass shows, and the one that the program builds."""
    return ball_head() if request.param == "ball" else build_head()


def random_pose(model: HeadModel, *, seed: int, angle: float = 0.5) -> Pose:
    """Large rotations of all joints, a strong expression and a translation."""
    rng = np.random.default_rng(seed)
    widths = {"expr": model.n_expr, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
    values = {name: rng.normal(0.0, angle if name in ROTATIONS else 0.7, width) for name, width in widths.items()}
    return Pose(**{name: torch.tensor(value, dtype=torch.float32) for name, value in values.items()})


def pose_at_rest(model: HeadModel) -> Pose:
    """Nothing moves."""
    return Pose(*(torch.zeros(width) for width in (model.n_expr, 3, 3, 3, 6, 3)))


def flame(model: HeadModel, betas: np.ndarray, pose: Pose, offsets: np.ndarray | None = None) -> np.ndarray:
    """FLAME's forward pass in float64, one joint after the other, as the formulas read."""
    n_shape = model.n_shape
    shaped = model.v_template.astype(np.float64) + model.shapedirs[:, :, :n_shape].astype(np.float64) @ betas
    shaped = shaped + (0.0 if offsets is None else offsets)
    joints = model.J_regressor.astype(np.float64) @ shaped
    rotvecs = pose.joint_rotations().double().numpy()
    turns = Rotation.from_rotvec(rotvecs).as_matrix()
    feature = (turns[1:] - np.eye(3)).reshape(-1)
    expressed = shaped + model.shapedirs[:, :, n_shape:].astype(np.float64) @ pose.expr.double().numpy()
    rest = expressed + model.posedirs.astype(np.float64) @ feature
    chain: list[np.ndarray] = []
    for joint, parent in enumerate(model.parents):
        local = np.eye(4)
        local[:3, :3] = turns[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0.0)
        chain.append(chain[parent] @ local if parent >= 0 else local)
    posed = np.zeros_like(rest)
    for joint, transform in enumerate(chain):
        image = (rest - joints[joint]) @ transform[:3, :3].T + transform[:3, 3]
        posed += model.lbs_weights[:, joint : joint + 1].astype(np.float64) * image
    return posed + pose.translation.double().numpy()


def posed(body: Body, betas: np.ndarray, pose: Pose, offsets: torch.Tensor | None = None) -> np.ndarray:
    """The body's own pass: shape, offsets, joints, pose."""
    canonical = body.shaped(torch.tensor(betas, dtype=torch.float32))
    canonical = canonical if offsets is None else canonical + offsets
    return body.posed(canonical, pose, joints=body.joints(canonical)).double().numpy()


@pytest.mark.parametrize("seed", range(3))
def test_the_forward_pass_is_flames(model, seed):
    """Identity, expression, pose correctives, joints, skinning and translation agree with plain float64."""
    rng = np.random.default_rng(seed)
    betas = rng.normal(0.0, 1.0, model.n_shape).astype(np.float32).astype(np.float64)
    pose = random_pose(model, seed=seed)
    expected = flame(model, betas, pose)
    assert np.abs(posed(Body(model, subdivisions=0), betas, pose) - expected).max() < 5e-6


def test_pose_correctives_count():
    """The ball's correctives move it, so the agreement above is not about zeros."""
    model = ball_head()
    pose = random_pose(model, seed=0)
    still = flame(replace(model, posedirs=np.zeros_like(model.posedirs)), np.zeros(4), pose)
    assert np.abs(flame(model, np.zeros(4), pose) - still).max() > 1e-3


def test_at_rest_the_head_is_its_template(model):
    """No rotation, no coefficient: the template, to rounding."""
    body = Body(model, subdivisions=0)
    at_rest = posed(body, np.zeros(model.n_shape), pose_at_rest(model))
    assert np.abs(at_rest - model.v_template).max() < 1e-6


def test_offsets_move_the_joints():
    """Joints are regressed from the head with its offsets; a head moved as a whole takes them along."""
    model = ball_head()
    body = Body(model, subdivisions=0)
    offsets = torch.randn(body.n_verts, 3, generator=torch.Generator().manual_seed(0)) * 0.01
    pose, betas = random_pose(model, seed=4), np.ones(4)
    expected = flame(model, betas, pose, offsets.double().numpy())
    assert np.abs(posed(body, betas, pose, offsets) - expected).max() < 5e-6
    shift = torch.tensor([0.1, -0.2, 0.3])
    moved = body.joints(body.v_template + shift) - body.joints(body.v_template)
    assert torch.allclose(moved, shift.expand(5, 3), atol=1e-6)


def test_the_root_turns_about_its_joint(model):
    """Distances to the root joint stay, and the root joint itself does not move."""
    body = Body(model, subdivisions=0)
    pose = replace(pose_at_rest(model), rotation=torch.tensor([0.4, -1.2, 0.3]))
    joint = (model.J_regressor.astype(np.float64) @ model.v_template)[0]
    turned = posed(body, np.zeros(model.n_shape), pose)
    about = Rotation.from_rotvec(pose.rotation.double().numpy()).apply(model.v_template - joint) + joint
    assert np.abs(turned - about).max() < 1e-6


def test_the_translation_comes_last(model):
    """A turned head moves along the world's axes, not its own."""
    body = Body(model, subdivisions=0)
    pose = replace(random_pose(model, seed=1), translation=torch.zeros(3))
    shift = torch.tensor([0.3, -0.1, 0.2])
    betas = np.zeros(model.n_shape)
    moved = posed(body, betas, replace(pose, translation=shift)) - posed(body, betas, pose)
    assert np.abs(moved - shift.double().numpy()).max() < 1e-6


def test_a_centered_pose_keeps_the_face():
    """Without root motion the head stays in place, and neck, jaw, eyes and expression remain."""
    pose = random_pose(ball_head(), seed=2)
    centered = pose.without_root()
    assert not centered.rotation.any()
    assert not centered.translation.any()
    for name in ("expr", "neck_pose", "jaw_pose", "eyes_pose"):
        assert torch.equal(getattr(centered, name), getattr(pose, name))


def test_the_finer_shaped_head_is_the_shaped_head_subdivided(model):
    """Identity directions are linear, so they may be evaluated on the base mesh and carried over."""
    betas = torch.randn(model.n_shape, generator=torch.Generator().manual_seed(5))
    coarse = Body(model, subdivisions=0).shaped(betas).numpy()
    fine, _ = subdivide(replace(model, v_template=coarse))
    assert np.abs(Body(model, subdivisions=1).shaped(betas).numpy() - fine.v_template).max() < 1e-6


def test_the_finer_posed_head_is_the_posed_finer_model(model):
    """Carrying directions over equals a head model that was subdivided with all of its directions."""
    if model.n_shape > 10:
        model = replace(model, shapedirs=model.shapedirs[:, :, 295:310], n_shape=5, n_expr=10, expr_names=())
    pose, betas = random_pose(model, seed=6), np.ones(model.n_shape)
    expected = flame(subdivide(model)[0], betas, pose)
    assert np.abs(posed(Body(model, subdivisions=1), betas, pose) - expected).max() < 5e-6


def test_twice_subdivided_is_subdivided_twice():
    """Every step quarters the faces, and values are carried through all of them."""
    model = ball_head()
    body = Body(model, subdivisions=2)
    fine = subdivide(subdivide(model)[0])[0]
    assert len(body.faces) == 16 * len(model.faces)
    assert np.abs(body.carry(body.v_template).numpy() - fine.v_template).max() < 1e-7


@pytest.mark.parametrize("n", [2, 3, 5])
def test_coefficients_are_cut_or_padded(n):
    """Any number of them fits any head: the rest is zero, or is left out."""
    values = np.arange(1.0, 7.0).reshape(2, 3)
    out = pad_or_truncate(values, n)
    assert out.dtype == np.float32
    assert out.shape == (2, n)
    assert np.array_equal(out[:, : min(n, 3)], values[:, : min(n, 3)])
    assert not out[:, 3:].any()


def test_the_pose_of_a_timestep():
    """Row by row, with as many expression coefficients as the head has; the capture is not shared."""
    rng = np.random.default_rng(0)
    names = {"expr": 4, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
    rows = {name: rng.normal(size=(5, width)).astype(np.float32) for name, width in names.items()}
    params = HeadParams(shape=np.zeros(2, np.float32), **rows)
    pose = params.pose(3, n_expr=6)
    assert pose.expr.tolist() == pytest.approx([*rows["expr"][3], 0.0, 0.0])
    joints = np.concatenate([rows[name][3] for name in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")])
    assert torch.equal(pose.joint_rotations(), torch.tensor(joints).reshape(5, 3))
    pose.translation.zero_()
    assert rows["translation"][3].any()


def test_normals_of_a_sphere_point_outwards():
    """Unit length, and along the radius."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    body = Body(ball_head(ball), subdivisions=0)
    normals = body.normals(body.v_template)
    assert torch.allclose(normals.norm(dim=1), torch.ones(len(normals)), atol=1e-6)
    assert (normals * body.v_template / 0.1).sum(1).min() > 0.999


def test_a_vertex_without_faces_has_no_normal():
    """Zero, not NaN; so the shift along it is none."""
    model = ball_head()
    faces = model.faces[(model.faces != 0).all(1)]
    body = Body(replace(model, faces=faces, ft=model.ft[: len(faces)]), subdivisions=0)
    assert body.normals(body.v_template)[0].tolist() == [0.0, 0.0, 0.0]
    assert body.edge_lengths(body.v_template)[0].item() == 0.0


def test_edge_lengths_by_hand():
    """Each vertex gets the mean over its faces of their mean edge."""
    model = ball_head()
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    body = Body(replace(model, faces=faces, ft=faces), subdivisions=0)
    verts = torch.zeros(body.n_verts, 3)
    verts[:4] = torch.tensor([[0.0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0]])
    assert body.edge_lengths(verts)[:4].tolist() == pytest.approx([4.0, 4.0, 4.0, 4.0])
    verts[3] = torch.tensor([3.0, 4, 12])
    second = (5 + 12 + 13) / 3
    expected = [(4 + second) / 2, 4.0, (4 + second) / 2, second]
    assert body.edge_lengths(verts)[:4].tolist() == pytest.approx(expected)


def test_gradients_reach_identity_expression_and_every_joint():
    """What the geometry stage learns has a slope."""
    model = ball_head()
    body = Body(model, subdivisions=1)
    pose = random_pose(model, seed=8)
    leaves = {name: value.requires_grad_() for name, value in vars(pose).items()}
    betas = torch.ones(model.n_shape, requires_grad=True)
    canonical = body.shaped(betas)
    weights = torch.randn(body.n_verts, 3, generator=torch.Generator().manual_seed(1))
    (body.posed(canonical, pose, joints=body.joints(canonical)) * weights).sum().backward()
    for name, leaf in {**leaves, "betas": betas}.items():
        assert leaf.grad is not None, name
        assert leaf.grad.abs().min() > 0, name


@pytest.mark.parametrize("name", ["rotation", "eyes_pose", "expr", "shape", "static_offset", "translation"])
def test_parameters_of_a_wrong_shape_or_not_finite_are_refused(name):
    """FLAME's row has one type, and it checks itself wherever it is made."""
    good = replace(
        HeadParams.neutral(n_frames=2, n_expr=3),
        shape=np.zeros(4, np.float32),
        static_offset=np.zeros((5, 3), np.float32),
    )
    values = getattr(good, name)
    with pytest.raises(ValueError, match=name):
        replace(good, **{name: np.full_like(values, np.nan)})
    with pytest.raises(ValueError, match=name):
        replace(good, **{name: np.zeros((*values.shape, 2), np.float32)})
