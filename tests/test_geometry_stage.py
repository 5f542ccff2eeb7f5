"""The geometry stage: personal head, RefineNet, vertex-bound Gaussians and their loss (Eq. 1 to 7)."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tiny import WHITE, run, tiny_config, tiny_head, tiny_personal_head

from mgavatar.avatar import Avatar
from mgavatar.capture.info import CaptureInfo
from mgavatar.capture.subject import Subject
from mgavatar.config import FitConfig
from mgavatar.gaussians import SH_C0
from mgavatar.geometry.head import PersonalHead, PosedHead
from mgavatar.geometry.refine_net import N_POSE, RefineNet
from mgavatar.geometry.stage import GeometryStage, laplacian_loss, offset_loss
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.head.body import Body
from mgavatar.kernels.laplacian import laplacian_matrix
from mgavatar.losses import image_loss


def make_stage(subject: Subject, config: FitConfig) -> GeometryStage:
    """A stage at its start."""
    return GeometryStage(VertexGaussians(tiny_personal_head(subject, config), config), config)


def random_posed(n: int, *, seed: int = 0) -> PosedHead:
    """Offsets as a fit might have them."""
    rng = torch.Generator().manual_seed(seed)
    return PosedHead(*(0.1 * torch.randn(n, 3, generator=rng) for _ in range(4)))


def small_mesh() -> tuple[SimpleNamespace, list[list[int]]]:
    """Two triangles over four vertices as the loss sees them, and the neighbours of each vertex."""
    matrix = laplacian_matrix(torch.tensor([[0, 1, 2], [0, 2, 3]]), 4)
    gaussians = SimpleNamespace(head=SimpleNamespace(body=SimpleNamespace(laplacian=matrix)))
    return gaussians, [[1, 2, 3], [0, 2], [0, 1, 3], [0, 2]]


def test_the_stage_starts_at_the_template(subject):
    """Before the first step no vertex is off the parametric head, in any pose."""
    head = make_stage(subject, tiny_config()).gaussians.head
    for timestep in range(len(subject.params)):
        pose = head.pose(timestep)
        posed = head.posed(pose)
        assert not posed.identity_offsets.any()
        assert not posed.pose_offsets.any()
        shaped = head.body.shaped(torch.tensor(subject.params.shape))
        assert torch.equal(posed.shaped, shaped)
        assert torch.equal(posed.verts, head.body.posed(shaped, pose, joints=head.body.joints(shaped)))
    assert torch.equal(head.canonical(), shaped)


@pytest.mark.parametrize("tracked", [True, False])
def test_where_identity_starts(subject, tracked):
    """At the capture's shape, or at the neutral template by option."""
    head = make_stage(subject, tiny_config(geometry={"start_from_tracked_shape": tracked})).gaussians.head
    expected = subject.params.shape if tracked else np.zeros_like(subject.params.shape)
    assert np.array_equal(head.betas.detach().numpy(), expected)


def test_poses_start_as_tracked(subject):
    """Every parameter of every timestep."""
    head = make_stage(subject, tiny_config()).gaussians.head
    for name, value in head.poses.items():
        assert np.array_equal(value.detach().numpy(), getattr(subject.params, name))


def test_the_triplane_is_read_bilinearly():
    """Features are those of torch's own sampler on three planes over the bounding box (Eq. 1)."""
    torch.manual_seed(1)
    verts = torch.rand(40, 3) * torch.tensor([0.2, 0.3, 0.1])
    net = RefineNet(verts, tiny_config().geometry, mean_pose=torch.zeros(N_POSE))
    features = net.encode()
    low, high = verts.min(0).values, verts.max(0).values
    place = (verts - low) / (high - low).max()
    expected = []
    for plane, (a, b) in zip(net.planes, ((0, 1), (1, 2), (2, 0)), strict=True):
        maps = plane.reshape(1, 16, 16, 4).permute(0, 3, 1, 2)
        grid = torch.stack([2 * place[:, a] - 1, 1 - 2 * place[:, b]], 1)[None, None]
        sampled = torch.nn.functional.grid_sample(maps, grid, align_corners=False, padding_mode="border")
        expected.append(sampled[0, :, 0].T)
    assert torch.allclose(features, torch.cat(expected, 1), atol=1e-6)


def test_pose_offsets_are_the_network_of_features_and_pose():
    """Eq. 2: splitting the first layer into a vertex's and the pose's share changes nothing."""
    torch.manual_seed(2)
    config = tiny_config().geometry
    pose, mean_pose = torch.randn(2, N_POSE)
    net = RefineNet(torch.rand(30, 3), config, mean_pose=mean_pose)
    torch.nn.init.normal_(net.phi_pose[-1].weight)
    features = net.encode()
    plain, at_mean = (net.phi_pose(torch.cat([features, p.expand(30, N_POSE)], 1)) for p in (pose, mean_pose))
    assert (plain - at_mean).abs().max() > 0.1
    assert torch.allclose(net.pose_offsets(features, pose), config.offset_unit * (plain - at_mean), atol=1e-7)
    assert not net.pose_offsets(features, mean_pose).any()
    net.centered = False
    assert torch.allclose(net.pose_offsets(features, pose), config.offset_unit * plain, atol=1e-7)


def test_identity_offsets_are_the_network_of_features():
    """Eq. 1 in units of ``offset_unit``."""
    torch.manual_seed(3)
    config = tiny_config(geometry={"offset_unit": 0.02}).geometry
    net = RefineNet(torch.rand(30, 3), config, mean_pose=torch.zeros(N_POSE))
    torch.nn.init.normal_(net.phi_id[-1].weight)
    features = net.encode()
    assert features.std().item() == pytest.approx(0.1, rel=0.5)
    plain = net.phi_id(features)
    assert plain.abs().max() > 0.1
    assert torch.allclose(net.identity_offsets(features), 0.02 * plain, atol=1e-7)


def test_pose_offsets_are_given_neck_jaw_and_eyes(subject, monkeypatch):
    """Eq. 2: all twelve numbers, in this order, in radians, and nothing of the root or the expression."""
    head = make_stage(subject, tiny_config()).gaussians.head
    given: list[torch.Tensor] = []

    def record(features: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
        given.append(pose)
        return torch.zeros(len(features), 3)

    monkeypatch.setattr(head.refine, "pose_offsets", record)
    values = torch.linspace(0.01, 0.12, N_POSE)
    neck, jaw, eyes = values.split([3, 3, 6])
    head.posed(replace(head.pose(0), neck_pose=neck, jaw_pose=jaw, eyes_pose=eyes))
    assert torch.equal(given[0], values)


def test_the_mean_pose_is_that_of_the_training_timesteps(subject):
    """What all training poses have in common is identity, whatever held-out timesteps do; it stays in the state."""
    config = tiny_config()
    rows = sorted({frame.timestep for frame in subject.frames["train"]})
    head = PersonalHead(Body(tiny_head(), subdivisions=1), subject.params, config.geometry, train_rows=rows)
    p = subject.params
    expected = np.concatenate([p.neck_pose, p.jaw_pose, p.eyes_pose], axis=1)[rows].mean(axis=0)
    assert np.allclose(head.refine.mean_pose.numpy(), expected, atol=1e-7)
    assert len(rows) < len(p)
    assert "refine.mean_pose" in head.state_dict()


def test_offsets_add_up_before_posing(subject):
    """Eq. 3: the posed head is the parametric one plus both offsets, on joints that only identity moves."""
    head = make_stage(subject, tiny_config()).gaussians.head
    torch.nn.init.normal_(head.refine.phi_id[-1].weight)
    torch.nn.init.normal_(head.refine.phi_pose[-1].weight)
    pose = replace(head.pose(1), jaw_pose=torch.tensor([0.3, 0.0, 0.0]))
    posed = head.posed(pose)
    assert posed.identity_offsets.abs().max() > 1e-4
    assert posed.pose_offsets.abs().max() > 1e-4
    canonical = posed.shaped + posed.identity_offsets
    assert torch.allclose(head.canonical(), canonical, atol=1e-8)
    verts = head.body.posed(canonical + posed.pose_offsets, pose, joints=head.body.joints(canonical))
    assert torch.allclose(posed.verts, verts, atol=1e-8)
    neck = replace(pose, neck_pose=pose.neck_pose + 0.3)
    assert torch.equal(head.posed(neck).identity_offsets, posed.identity_offsets)
    assert not torch.allclose(head.posed(neck).pose_offsets, posed.pose_offsets)
    root = replace(pose, rotation=pose.rotation + 0.3, translation=pose.translation + 1.0)
    assert torch.equal(head.posed(root).pose_offsets, posed.pose_offsets)


def test_without_pose_offsets_there_is_no_network(subject, views):
    """The ablation has no Phi_pose, and still learns."""
    stage = make_stage(subject, tiny_config(geometry={"pose_offsets": False}))
    assert stage.gaussians.head.refine.phi_pose is None
    assert not any("phi_pose" in name for name, _ in stage.gaussians.named_parameters())
    terms = run(stage, views, 3)[-1]
    assert np.isfinite(terms["loss"])
    assert not stage.gaussians.head.posed(stage.gaussians.head.pose(0)).pose_offsets.any()


def test_vertex_gaussians_have_reduced_freedom(subject, views):
    """Opacity 1, no rotation, one scale, colour of the constant harmonic; also after learning."""
    stage = make_stage(subject, tiny_config())
    run(stage, views, 4)
    gaussians = stage.gaussians
    posed = gaussians.head.posed(gaussians.head.pose(0))
    bound = gaussians.bound(posed, views.cameras[0])
    assert torch.equal(bound.opacities, torch.ones(gaussians.head.body.n_verts))
    assert torch.equal(bound.quats, torch.tensor([1.0, 0, 0, 0]).expand(len(bound.means), 4))
    assert torch.equal(bound.scales, gaussians.scales(posed)[:, None].expand(-1, 3))
    assert torch.equal(bound.colors, 0.5 + SH_C0 * gaussians.colors)
    assert pytest.approx(0.5 / np.sqrt(np.pi)) == SH_C0


def test_gaussians_start_at_a_share_of_the_edges(subject):
    """The scale at the start goes by the mesh, and the colour is grey."""
    config = tiny_config(geometry={"initial_scale": 0.5})
    gaussians = make_stage(subject, config).gaussians
    edges = gaussians.head.body.edge_lengths(gaussians.head.body.shaped(gaussians.head.betas))
    assert torch.allclose(gaussians.log_scales.exp(), 0.5 * edges, rtol=1e-5)
    assert not gaussians.colors.any()


def test_no_gaussian_starts_without_size(subject, monkeypatch):
    """Where vertices meet in a point, edges count as a fifth of the median edge; they do so when the mesh moves too."""
    head = make_stage(subject, tiny_config()).gaussians.head
    edges = torch.full((head.body.n_verts,), 0.01)
    edges[:3] = torch.tensor([0.0, 0.001, 0.02])
    monkeypatch.setattr(head.body, "edge_lengths", lambda verts: edges)
    config = tiny_config(geometry={"initial_scale": 0.5, "scales_follow_mesh": True})
    gaussians = VertexGaussians(head, config)
    assert torch.allclose(gaussians.log_scales[:4].exp(), 0.5 * torch.tensor([0.002, 0.002, 0.02, 0.01]))
    assert torch.allclose(gaussians.scales(head.posed(head.pose(0))), gaussians.log_scales.exp())


def test_gaussians_are_drawn_behind_the_surface(subject, views):
    """A shift of 0 draws at the vertices, as in the paper; another one behind them, in the fit as in the avatar."""
    config = tiny_config(geometry={"surface_shift": 1.0})
    at, behind = (make_stage(subject, c).gaussians for c in (tiny_config(geometry={"surface_shift": 0.0}), config))
    pose, camera = at.head.pose(0), views.cameras[0]
    posed = at.head.posed(pose)
    assert torch.equal(at.bound(posed, camera).means, posed.verts)
    drawn = behind.bound(posed, camera)
    moved = drawn.means - posed.verts
    assert (moved * (posed.verts.mean(0) - posed.verts)).sum(1).min() >= 0
    assert moved.norm(dim=1).mean() > 0.5 * behind.scales(posed).mean()
    avatar = Avatar(behind, None, CaptureInfo.of(subject), config)
    assert torch.equal(avatar.gaussians(pose, camera).means, drawn.means)


def test_the_shift_is_in_sigmas_as_the_camera_sees_them(subject, views):
    """In an image of a quarter of the size a pixel is four times as large, and so is its share of the blur.

    The shift falls with the sine of the angle between line of sight and normal.
    """
    gaussians = make_stage(subject, tiny_config(geometry={"surface_shift": 1.5})).gaussians
    posed = gaussians.head.posed(gaussians.head.pose(0))
    sigmas, camera = gaussians.scales(posed).double(), views.cameras[0]
    verts, normals = posed.verts.detach().double(), gaussians.head.body.normals(posed.verts).detach().double()
    depths = (verts @ torch.tensor(camera.viewmat[:3, :3]).T + torch.tensor(camera.viewmat[:3, 3]))[:, 2]
    sight = torch.nn.functional.normalize(verts - torch.tensor(camera.position), dim=1)
    sines = torch.sin(torch.acos((sight * normals).sum(1).clamp(-1.0, 1.0)))
    assert sines.min() < 0.3
    assert sines.max() > 0.99
    for factor in (1, 4):
        smaller = camera.scaled(camera.width // factor, camera.height // factor)
        pixels = depths / smaller.K[0, 0]
        expected = 1.5 * (sigmas**2 + 0.3 * pixels**2).sqrt()
        moved = gaussians.bound(posed, smaller).means - posed.verts
        assert torch.allclose(moved.norm(dim=1).double(), expected * sines, rtol=1e-3, atol=1e-6)
        assert expected.mean() > 1.05 * 1.5 * sigmas.mean() * factor**0.5


@pytest.mark.parametrize("follow", [False, True])
def test_scales_that_follow_the_mesh(subject, views, follow):
    """Where the canonical mesh is stretched to twice its size, its Gaussians grow with it; without the switch not."""
    gaussians = make_stage(subject, tiny_config(geometry={"scales_follow_mesh": follow})).gaussians
    posed = gaussians.head.posed(gaussians.head.pose(0))
    assert torch.allclose(gaussians.scales(posed), gaussians.log_scales.exp(), rtol=1e-5)
    stretched = replace(posed, identity_offsets=posed.shaped)
    factor = 2.0 if follow else 1.0
    assert torch.allclose(gaussians.scales(stretched), factor * gaussians.log_scales.exp(), rtol=1e-5)
    bound = gaussians.bound(stretched, views.cameras[0])
    assert torch.allclose(bound.scales[:, 0], gaussians.scales(stretched))


def test_the_shift_passes_no_gradient(subject, views):
    """Drawn behind, the gradient of a vertex is that of its Gaussian, and scales get none from the shift."""
    gaussians = make_stage(subject, tiny_config(geometry={"surface_shift": 1.5})).gaussians
    posed = gaussians.head.posed(gaussians.head.pose(0))
    weights = torch.randn_like(posed.verts)
    verts = posed.verts.detach().requires_grad_()
    (gaussians.bound(replace(posed, verts=verts), views.cameras[0]).means * weights).sum().backward()
    assert torch.equal(verts.grad, weights)
    assert gaussians.log_scales.grad is None


def test_offset_loss_by_hand():
    """Eq. 5 with the norms as squared lengths averaged over vertices."""
    posed = random_posed(4)
    scales = torch.tensor([0.1, 0.2, 0.3, 0.4])
    identity, by_pose = posed.identity_offsets.numpy(), posed.pose_offsets.numpy()
    expected = ((identity**2).sum() + (by_pose**2).sum() + (scales.numpy() ** 2).sum()) / 4
    assert offset_loss(posed, scales).item() == pytest.approx(expected, rel=1e-6)
    assert offset_loss(replace(posed, pose_offsets=torch.zeros(4, 3)), 0 * scales).item() == pytest.approx(
        (identity**2).sum() / 4, rel=1e-6
    )


def test_laplacian_loss_by_hand():
    """Eq. 6 as it reads: Laplacians of mu_c, mu and mu_bar, vertex minus mean of its neighbours."""
    gaussians, neighbours = small_mesh()
    posed, scales = random_posed(4, seed=1), torch.tensor([0.3, 0.1, 0.5, 0.2])

    def lap(x: np.ndarray) -> np.ndarray:
        return np.stack([x[i] - x[near].mean(0) for i, near in enumerate(neighbours)])

    bar = posed.shaped.double().numpy()
    canonical = bar + posed.identity_offsets.double().numpy()
    animated = canonical + posed.pose_offsets.double().numpy()
    expected = (
        ((lap(canonical) - lap(bar)) ** 2).sum()
        + ((lap(animated) - lap(bar)) ** 2).sum()
        + (lap(scales.double().numpy()) ** 2).sum()
    ) / 4
    assert laplacian_loss(gaussians, posed, scales).item() == pytest.approx(expected, rel=1e-5)


def test_laplacian_loss_does_not_see_a_translation():
    """Offsets that are the same everywhere, and equal scales, cost nothing."""
    gaussians, _ = small_mesh()
    moved = replace(
        random_posed(4),
        identity_offsets=torch.tensor([0.1, -0.2, 0.3]).expand(4, 3),
        pose_offsets=torch.tensor([-0.5, 0.0, 0.25]).expand(4, 3),
    )
    assert laplacian_loss(gaussians, moved, torch.full((4,), 0.7)).item() < 1e-13
    assert laplacian_loss(gaussians, random_posed(4), torch.full((4,), 0.7)).item() > 1e-4


def test_the_loss_is_the_weighted_sum(subject, views):
    """Eq. 7: every term with its weight from the config, at the values before the step."""
    config = tiny_config(geometry={"lambda_offset": 3.0, "lambda_laplacian": 50.0})
    stage = make_stage(subject, config)
    run(stage, views, 3)
    gaussians = stage.gaussians
    target = views.images[0].float() / 255.0
    with torch.no_grad():
        posed = gaussians.head.posed(gaussians.head.pose(views.timesteps[0]))
        scales = gaussians.log_scales.exp()
        image = gaussians.render(posed, views.cameras[0], WHITE).image
        expected = {
            "image": image_loss(image, target, config.loss).item(),
            "offset": 3.0 * offset_loss(posed, scales).item(),
            "laplacian": 50.0 * laplacian_loss(gaussians, posed, scales).item(),
        }
    terms = stage.step(views.cameras[0], views.timesteps[0], target, WHITE)
    for name, value in expected.items():
        assert value > 0
        assert terms[name] == pytest.approx(value, rel=1e-5)
    assert terms["loss"] == pytest.approx(sum(expected.values()), rel=1e-5)
    assert terms["gaussians"] == gaussians.head.body.n_verts


def test_ssim_takes_over_in_the_course_of_the_stage(subject, views):
    """Steadily from the weights of the loss to its own, and the same from a saved state; without one, not at all."""
    config = tiny_config(geometry={"iterations": 8, "ssim": 0.7})
    stage = make_stage(subject, config)
    assert stage.image_weights() == config.loss
    run(stage, views, 4)
    half = stage.image_weights()
    assert (half.color, half.ssim) == pytest.approx((0.55, 0.45))
    gaussians, target = stage.gaussians, views.images[0].float() / 255.0
    with torch.no_grad():
        posed = gaussians.head.posed(gaussians.head.pose(views.timesteps[0]))
        image = gaussians.render(posed, views.cameras[0], WHITE).image
    other = make_stage(subject, config)
    other.load_state_dict(copy.deepcopy(stage.state_dict()))
    for each in (stage, other):
        terms = each.step(views.cameras[0], views.timesteps[0], target, WHITE)
        assert terms["image"] == pytest.approx(image_loss(image, target, half).item(), rel=1e-5)
    run(stage, views, 5)
    assert (stage.image_weights().color, stage.image_weights().ssim) == pytest.approx((0.3, 0.7))
    plain = make_stage(subject, tiny_config(geometry={"iterations": 2}))
    run(plain, views, 2)
    assert plain.image_weights() == plain.config.loss


def test_the_loss_falls_and_the_mesh_grows_towards_the_truth(subject, views):
    """Thirty steps bring the images nearer, and the ball takes on some of the stretch that it lacked."""
    geometry = {"iterations": 30, "lambda_laplacian": 100.0, "lr_refine": 3e-2, "lr_triplane": 3e-2, "hidden": 32}
    stage = make_stage(subject, tiny_config(geometry=geometry))
    gaussians = stage.gaussians

    def score() -> float:
        with torch.no_grad():
            losses = [
                image_loss(
                    gaussians.render(gaussians.head.posed(gaussians.head.pose(timestep)), camera, WHITE).image,
                    image.float() / 255.0,
                    stage.config.loss,
                )
                for image, camera, timestep in zip(views.images, views.cameras, views.timesteps, strict=True)
            ]
        return float(torch.stack(losses).mean())

    def width() -> float:
        canonical = gaussians.head.canonical().detach()
        return float(canonical[:, 0].max() - canonical[:, 0].min())

    before, width_before = score(), width()
    run(stage, views, 30)
    assert score() < 0.85 * before
    assert width() > 1.02 * width_before


def test_the_laplacian_keeps_faces_from_turning(subject, views):
    """Without it single faces turn by tens of degrees, the start of the paper's folds; with it none does."""
    turns = {}
    for weight in (0.0, 1e5):
        geometry = {"iterations": 40, "lambda_laplacian": weight, "lr_refine": 3e-2, "lr_triplane": 3e-2, "hidden": 32}
        stage = make_stage(subject, tiny_config(geometry=geometry))
        run(stage, views, 40)
        head = stage.gaussians.head
        with torch.no_grad():
            fitted, parametric = (normals(verts, head.body.faces) for verts in (head.canonical(), head.shaped()))
        turns[weight] = torch.rad2deg((fitted * parametric).sum(1).clamp(-1.0, 1.0).acos()).max().item()
    assert turns[0.0] > 15.0
    assert turns[1e5] < 1.0


def normals(verts: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Of faces."""
    a, b, c = verts[faces.long()].unbind(1)
    return torch.nn.functional.normalize(torch.cross(b - a, c - a, dim=1), dim=1)


def test_gradients_reach_everything_that_is_learned(subject, views):
    """Identity, expression, pose, translation, planes, both networks, scales and colours."""
    stage = make_stage(subject, tiny_config())
    run(stage, views, 2)
    for name, parameter in stage.gaussians.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        # A constant of Phi_pose is the same in all poses: centred offsets do not have it.
        assert parameter.grad.any() != (name == "head.refine.phi_pose.6.bias"), name
    in_optimizer = {id(p) for group in stage.optimizer.param_groups for p in group["params"]}
    assert in_optimizer == {id(p) for p in stage.gaussians.parameters()}


def test_a_timestep_that_is_not_trained_stays_as_tracked(subject, views):
    """Held-out timesteps keep the tracker's parameters, to the bit."""
    trained = set(views.timesteps)
    held_out = [t for t in range(len(subject.params)) if t not in trained]
    assert held_out
    stage = make_stage(subject, tiny_config())
    before = {name: value.detach().clone() for name, value in stage.gaussians.head.poses.items()}
    run(stage, views, 6)
    for name, value in stage.gaussians.head.poses.items():
        assert torch.equal(value[held_out], before[name][held_out]), name
        assert not torch.equal(value[sorted(trained)], before[name][sorted(trained)]), name


RATES = {
    "head.refine.phi": ("lr_refine", 1.1e-3),
    "head.refine.planes": ("lr_triplane", 1.3e-3),
    "head.betas": ("lr_shape", 1.7e-3),
    "head.poses.expr": ("lr_expr", 1.9e-3),
    "head.poses.translation": ("lr_translation", 2.3e-3),
    "head.poses": ("lr_pose", 2.9e-3),
    "log_scales": ("lr_scale", 3.1e-3),
    "colors": ("lr_color", 3.7e-3),
}
"""A rate of its own for everything that learns, by the beginning of its name; the first that fits counts."""


def test_everything_learns_at_its_own_rate_and_all_rates_fall(subject, views):
    """No two are exchanged, none is left out, and each ends at the stated share of itself."""
    config = tiny_config(geometry={"iterations": 10, "lr_final_factor": 0.25} | dict(RATES.values()))
    stage = make_stage(subject, config)
    names = dict(stage.gaussians.named_parameters())
    expected = {name: next(rate for start, (_, rate) in RATES.items() if name.startswith(start)) for name in names}

    def rates() -> dict[str, float]:
        of = {id(p): group["lr"] for group in stage.optimizer.param_groups for p in group["params"]}
        assert len(of) == len(names)
        return {name: of[id(parameter)] for name, parameter in names.items()}

    assert rates() == pytest.approx(expected, rel=1e-12)
    target = views.target(0, WHITE, WHITE)
    for schedule_step in (1.0, 0.5, 4.5, 4.0):  # as a budget has it
        stage.step(views.cameras[0], views.timesteps[0], target, WHITE, schedule_step)
    assert stage.position == 10.0
    assert rates() == pytest.approx({name: 0.25 * rate for name, rate in expected.items()}, rel=1e-6)
    assert stage.optimizer.defaults["eps"] == 1e-15  # the Gaussians' gradients are as small as 1e-8


def test_a_mesh_that_is_not_finite_is_noticed(subject, views):
    """Its Gaussians are not drawn, so the images alone would not show it."""
    stage = make_stage(subject, tiny_config())
    with torch.no_grad():
        stage.gaussians.head.poses["translation"][views.timesteps[0], 1] = torch.nan
    assert np.isnan(run(stage, views, 1)[0]["loss"])


def test_a_stage_goes_on_from_its_state(subject, views):
    """Saved after three steps and loaded elsewhere, the fourth step is the same to the bit."""
    stage = make_stage(subject, tiny_config())
    run(stage, views, 3)
    state = copy.deepcopy(stage.state_dict())
    other = make_stage(subject, tiny_config())
    other.load_state_dict(state)
    steps = [run(each, views, 1) for each in (stage, other)]
    assert steps[0] == steps[1]
    for a, b in zip(stage.gaussians.parameters(), other.gaussians.parameters(), strict=True):
        assert torch.equal(a, b)
