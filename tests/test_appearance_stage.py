"""The appearance stage: face-bound Gaussians, ColorNet, OffsetNet and their loss (Eq. 8 to 11)."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from ball_head import ball_head
from scipy.spatial.transform import Rotation
from tiny import WHITE, run, tiny_config, tiny_personal_head
from torch import Tensor

from mgavatar.appearance import model
from mgavatar.appearance.color_net import ColorNet
from mgavatar.appearance.face_gaussians import PARAMETERS, FaceFrames, face_uvs
from mgavatar.appearance.model import Appearance, PosedMesh, build_appearance
from mgavatar.appearance.offset_net import N_THETA, OffsetNet, Upsample
from mgavatar.appearance.stage import AppearanceStage, binding_loss
from mgavatar.camera import Camera
from mgavatar.capture.subject import Subject
from mgavatar.config import AppearanceConfig, FitConfig, HeadTuningConfig, ShConfig
from mgavatar.gaussians import draw
from mgavatar.geometry.head import PersonalHead
from mgavatar.head.body import Body
from mgavatar.kernels.hash_grid import HashGridShape
from mgavatar.kernels.uv_map import position_map
from mgavatar.losses import image_loss

NO_DENSITY = replace(tiny_config().appearance.density, start=10**6)


def make_head(subject: Subject, config: FitConfig) -> PersonalHead:
    """A head with offsets of both kinds, as after the geometry stage."""
    head = tiny_personal_head(subject, config)
    torch.nn.init.normal_(head.refine.phi_id[-1].weight)
    torch.nn.init.normal_(head.refine.phi_pose[-1].weight)
    return head


def make_appearance(subject: Subject, config: FitConfig | None = None, *, seed: int = 0) -> Appearance:
    """An appearance at its start."""
    config = config or tiny_config()
    return build_appearance(make_head(subject, config), config, seed=seed)


def make_stage(subject: Subject, config: FitConfig | None = None) -> AppearanceStage:
    """A stage at its start."""
    config = config or tiny_config()
    return AppearanceStage(make_appearance(subject, config), config, seed=0)


def frame_by_hand(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """R, k and T of a triangle: edge, normal, their cross product; mean of edge and height; centre."""
    edge = (b - a) / np.linalg.norm(b - a)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    third = np.cross(edge, normal)
    height = abs((c - a) @ third)
    return np.stack([edge, normal, third], 1), (np.linalg.norm(b - a) + height) / 2, (a + b + c) / 3


def test_every_face_starts_with_one_gaussian_at_its_centre(subject, views):
    """At the start the Gaussians are the faces: their centres, their size, as they lie."""
    appearance = make_appearance(subject)
    config = appearance.config.appearance
    posed = appearance.frozen.at_timestep(0)
    gaussians, _ = appearance(posed, views.cameras[0])
    faces = appearance.frozen.body.faces.long()
    assert torch.equal(appearance.gaussians.face_ids, torch.arange(len(faces)))
    assert torch.allclose(gaussians.means, posed.verts[faces].mean(1), atol=1e-7)
    local = torch.tensor([config.initial_scale, config.initial_thickness, config.initial_scale])
    assert torch.allclose(gaussians.scales, posed.frames.scales[:, None] * local, rtol=1e-5)
    assert torch.allclose(gaussians.quats, posed.frames.quats, atol=1e-6)
    assert torch.allclose(gaussians.opacities, torch.full((len(faces),), config.initial_opacity))


def test_one_gaussian_by_hand(subject, views):
    """Eq. 8 with numbers: k R mu + T, R r, k s for one face of a posed mesh."""
    appearance = make_appearance(subject, tiny_config(appearance={"offset_net": replace(
        tiny_config().appearance.offset_net, enabled=False)}))  # fmt: skip
    g, face = appearance.gaussians, 7
    local_mean, local_scale = np.array([0.3, -0.2, 0.5]), np.array([0.5, 0.1, 0.7])
    local_turn = Rotation.from_rotvec([0.2, -0.4, 0.9])
    with torch.no_grad():
        g.local_means[face] = torch.tensor(local_mean)
        g.log_scales[face] = torch.tensor(local_scale).log()
        x, y, z, w = local_turn.as_quat()
        g.quats[face] = torch.tensor([w, x, y, z])
    posed = appearance.frozen.at_timestep(1)
    gaussians, maps = appearance(posed, views.cameras[0])
    assert maps is None
    corners = posed.verts[appearance.frozen.body.faces[face].long()].double().numpy()
    R, k, T = frame_by_hand(*corners)
    assert np.allclose(gaussians.means[face].detach().numpy(), k * R @ local_mean + T, atol=1e-7)
    assert np.allclose(gaussians.scales[face].detach().numpy(), k * local_scale, atol=1e-8)
    w, x, y, z = gaussians.quats[face].detach().numpy()
    assert np.allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), R @ local_turn.as_matrix(), atol=1e-5)


def test_offset_net_starts_at_zero(subject):
    """13 channels over the atlas, exactly nothing in them, so the Gaussians are drawn as they are."""
    torch.manual_seed(3)
    config = tiny_config().appearance.offset_net
    net = OffsetNet(config)
    maps = net(torch.rand(3, 32, 32), torch.rand(3, 32, 32), torch.rand(N_THETA))
    assert maps.shape == (13, 32, 32)
    assert not maps.any()


def test_offset_net_sees_all_of_its_inputs():
    """Canonical map, pose map, latent and pose each change the maps once the last layer is not zero."""
    torch.manual_seed(4)
    net = OffsetNet(tiny_config().appearance.offset_net)
    torch.nn.init.normal_(net.last.weight)
    inputs = [torch.rand(3, 32, 32), torch.rand(3, 32, 32), torch.rand(N_THETA)]
    with torch.no_grad():
        before = net(*inputs)
        for index in range(3):
            others = [*inputs[:index], inputs[index] + 0.5, *inputs[index + 1 :]]
            assert not torch.allclose(net(*others), before), index
        net.latent += 0.5
        assert not torch.allclose(net(*inputs), before)


class Recorder(torch.nn.Module):
    """Stands for OffsetNet and keeps what it was given."""

    def forward(self, *inputs: Tensor) -> Tensor:
        self.inputs = inputs
        return torch.zeros(13, 32, 32)


def test_offset_net_is_given_the_maps_and_the_pose(subject, views):
    """Eq. 10: M_cano, M_pose, and theta with all five rotations, that of the root too."""
    appearance = make_appearance(subject)
    appearance.offset_net = Recorder()
    frozen = appearance.frozen
    pose = frozen.head.pose(1)
    values = torch.linspace(0.01, 0.15, 15)
    root, neck, jaw, eyes = values.split([3, 3, 3, 6])
    posed = frozen.posed(replace(pose, rotation=root, neck_pose=neck, jaw_pose=jaw, eyes_pose=eyes))
    appearance(posed, views.cameras[0])
    canonical_map, pose_map, theta = appearance.offset_net.inputs
    assert torch.equal(canonical_map, frozen.canonical_map)
    assert torch.equal(pose_map, posed.pose_map)
    assert not torch.allclose(canonical_map, pose_map)
    assert torch.equal(theta, values)


def test_the_layers_of_offset_net():
    """Leaky activations between all layers, and a latent map that starts with texture of its own."""
    torch.manual_seed(0)
    net = OffsetNet(tiny_config().appearance.offset_net)
    kinds = [type(module).__name__ for module in net.modules()]
    assert kinds.count("Conv2d") == 1 + 8 + 5
    assert kinds.count("LeakyReLU") == 1 + 8 + 4 + 1
    assert "ReLU" not in kinds
    assert {module.negative_slope for module in net.modules() if hasattr(module, "negative_slope")} == {0.1}
    assert net.latent.std().item() == pytest.approx(0.1, rel=0.1)


def test_the_last_layer_of_offset_net_sees_the_maps_at_full_resolution():
    """A change of one texel arrives beside the decoder, only where it is: the embedding reaches one texel further."""
    torch.manual_seed(5)
    net = OffsetNet(tiny_config().appearance.offset_net)
    torch.nn.init.normal_(net.last.weight)
    maps = torch.rand(3, 32, 32)
    changed = maps.clone()
    changed[:, 9, 20] += 1.0
    with torch.no_grad():
        net.last.weight[:, : tiny_config().appearance.offset_net.channels // 2] = 0.0  # what the decoder adds
        differs = (net(changed, maps, torch.zeros(N_THETA)) != net(maps, maps, torch.zeros(N_THETA))).any(0)
    rows, columns = torch.nonzero(differs).unbind(1)
    assert (rows.min(), rows.max()) == (7, 11)
    assert (columns.min(), columns.max()) == (18, 22)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (5, 4), (16, 16)])
def test_upsampling_is_that_of_torch(size):
    """The values of ``nn.Upsample`` to the bit, and its adjoint in double precision."""
    rng = torch.Generator().manual_seed(size[0])
    maps = torch.randn(2, 3, *size, generator=rng, dtype=torch.float64, requires_grad=True)
    results = []
    for up in (Upsample(), torch.nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False)):
        out = up(maps)
        weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        results.append((out, *torch.autograd.grad((out * weights).sum(), maps)))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.allclose(results[0][1], results[1][1], rtol=1e-13, atol=1e-13)


def test_convolutions_are_deterministic_in_both_directions(subject, views, monkeypatch):
    """cuDNN is told so for the forward and the backward pass of a step, and gets its setting back."""
    stage = make_stage(subject)
    seen: list[bool] = []

    def note(*_: object) -> None:
        seen.append(torch.backends.cudnn.deterministic)

    stage.appearance.offset_net.last.register_forward_hook(note)
    stage.appearance.offset_net.latent.register_hook(note)
    run(stage, views, 1)
    assert seen == [True, True]
    assert torch.backends.cudnn.deterministic is False


def test_offsets_change_what_they_say(subject, views):
    """A constant offset map moves, colours, turns, scales and fades every Gaussian by its channels."""
    appearance = make_appearance(subject)
    local = Rotation.from_rotvec([0.9, -0.3, 0.4])
    with torch.no_grad():
        appearance.gaussians.quats.copy_(torch.tensor(local.as_quat()[[3, 0, 1, 2]]))
    posed, camera = appearance.frozen.at_timestep(0), views.cameras[0]
    before, _ = appearance(posed, camera)
    values = [0.1, -0.2, 0.3, 0.05, 0.06, -0.07, 0.02, 0.0, 0.0, 0.1, 0.2, -0.3, 0.5]
    with torch.no_grad():
        appearance.offset_net.last.bias.copy_(torch.tensor(values))
        after, maps = appearance(posed, camera)
        assert torch.allclose(maps, torch.tensor(values)[:, None, None].expand(13, 32, 32))
        R = torch.tensor(Rotation.from_quat(posed.frames.quats[:, [1, 2, 3, 0]].numpy()).as_matrix()).float()
        shift = posed.frames.scales[:, None] * (R @ torch.tensor(values[:3]))
        assert torch.allclose(after.means - before.means, shift, atol=1e-6)
        assert torch.allclose(after.scales, before.scales * torch.tensor(values[9:12]).exp(), rtol=1e-5)
        logits = torch.logit(after.opacities) - torch.logit(before.opacities)
        assert torch.allclose(logits, torch.tensor(0.5), atol=1e-4)
        turned = R @ torch.tensor((local * Rotation.from_rotvec(values[6:9])).as_matrix()).float()
        found = Rotation.from_quat(after.quats[:, [1, 2, 3, 0]].numpy()).as_matrix()
        assert np.allclose(found, turned.numpy(), atol=1e-4)
        plain = appearance.color_net(
            appearance.gaussians.canonical_means(appearance.frozen.frames),
            appearance._directions(after.means, posed, camera),
        )
        assert torch.allclose(after.colors - plain, torch.tensor(values[3:6]).expand_as(plain), atol=1e-6)


def test_offsets_are_read_where_the_gaussian_sits_in_the_atlas(subject):
    """A map that is its own u and v comes back as the texture coordinate under each Gaussian."""
    appearance = make_appearance(subject)
    frozen = appearance.frozen
    centres = frozen.face_vt.mean(1)
    assert torch.allclose(appearance.gaussians.uvs, centres, atol=1e-5)

    class Maps(torch.nn.Module):
        def forward(self, *_: Tensor) -> Tensor:
            at = (torch.arange(32) + 0.5) / 32
            maps = torch.zeros(13, 32, 32)
            maps[0], maps[1] = at[None, :], 1 - at[:, None]
            return maps

    appearance.offset_net = Maps()
    _, offsets = appearance.offsets(frozen.at_timestep(0))
    inside = ((centres > 1 / 64) & (centres < 1 - 1 / 64)).all(1)
    assert torch.allclose(offsets[inside, :2], centres[inside], atol=1e-5)


def test_texture_coordinates_follow_a_gaussian_over_its_face():
    """Dropped along the normal; outside the face, the nearest kind of place inside it."""
    verts = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])
    faces = torch.tensor([[0, 1, 2]], dtype=torch.int32)
    frames = FaceFrames.of(verts, faces)
    face_vt = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
    R, k, T = frame_by_hand(*verts.double().numpy())
    points = np.array([[0.5, 1.0, 0.7], [2.0, 0.0, -0.1], [-1.0, -1.0, 0.0], [3.0, -1.0, 0.0]])
    local = torch.tensor((points - T) @ R / k, dtype=torch.float32)
    uvs = face_uvs(local, torch.zeros(4, dtype=torch.long), frames, verts, faces, face_vt)
    assert torch.allclose(uvs[0], torch.tensor([0.25, 0.5]), atol=1e-6)
    assert torch.allclose(uvs[1], torch.tensor([1.0, 0.0]), atol=1e-6)
    assert torch.allclose(uvs[2], torch.tensor([0.0, 0.0]), atol=1e-6)
    assert (uvs >= 0).all()
    assert (uvs.sum(1) <= 1 + 1e-6).all()


def test_nothing_of_the_head_learns_any_more(subject, views):
    """Five steps leave every parameter of the geometry stage as it was, to the bit, and without a gradient."""
    stage = make_stage(subject)
    head = stage.appearance.frozen.head
    before = {name: value.detach().clone() for name, value in head.named_parameters()}
    gaussians = {name: getattr(stage.appearance.gaussians, name).detach().clone() for name in PARAMETERS}
    run(stage, views, 3)
    for name in PARAMETERS:
        assert not torch.equal(getattr(stage.appearance.gaussians, name), gaussians[name]), name
    run(stage, views, 2)
    for name, value in head.named_parameters():
        assert torch.equal(value, before[name]), name
        assert value.grad is None, name
        assert not value.requires_grad, name
    in_optimizer = {id(p) for group in stage.optimizer.param_groups for p in group["params"]}
    assert not in_optimizer & {id(p) for p in head.parameters()}


def test_gradients_reach_everything_that_is_learned(subject, views):
    """Gaussians, both of ColorNet's layers and its grid, and all of OffsetNet."""
    config = tiny_config(appearance={"density": NO_DENSITY})
    stage = make_stage(subject, config)
    table = stage.appearance.color_net.grid.table.detach().clone()
    run(stage, views, 2)
    for name, parameter in stage.appearance.named_parameters():
        if "grid.table" in name:
            continue
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name
    assert not torch.equal(stage.appearance.color_net.grid.table, table)
    in_optimizer = {id(p) for group in stage.optimizer.param_groups for p in group["params"]}
    learned = {id(p) for name, p in stage.appearance.named_parameters() if "grid.table" not in name}
    assert in_optimizer == learned


def test_the_loss_falls(subject, views):
    """Forty steps, with density control in between, bring the images nearer."""
    density = replace(NO_DENSITY, start=10, stop=20, every=10)
    stage = make_stage(subject, tiny_config(appearance={"iterations": 40, "density": density}))

    def score() -> float:
        losses = []
        with torch.no_grad():
            for image, camera, timestep in zip(views.images, views.cameras, views.timesteps, strict=True):
                gaussians, _ = stage.appearance(stage.appearance.frozen.at_timestep(timestep), camera)
                drawn = draw(gaussians, camera, background=WHITE, config=stage.config.raster)
                losses.append(image_loss(drawn.image, image.float() / 255.0, stage.config.loss))
        return float(torch.stack(losses).mean())

    before = score()
    run(stage, views, 40)
    assert score() < 0.6 * before
    assert len(stage.appearance.gaussians) > len(stage.appearance.frozen.body.faces)


def test_the_loss_is_the_weighted_sum(subject, views):
    """Eq. 11: image, position and scale hinges, and the squared offset maps, at the values before the step."""
    config = tiny_config(appearance={"density": NO_DENSITY})
    stage = make_stage(subject, config)
    a, appearance = config.appearance, stage.appearance
    with torch.no_grad():
        appearance.gaussians.local_means += 1.0
        appearance.gaussians.log_scales += 0.5
        appearance.offset_net.last.bias.fill_(0.03)
        gaussians, maps = appearance(appearance.frozen.at_timestep(views.timesteps[0]), views.cameras[0])
        drawn = draw(gaussians, views.cameras[0], background=WHITE, config=config.raster)
        target = views.images[0].float() / 255.0
        g = appearance.gaussians
        expected = {
            "image": image_loss(drawn.image, target, config.loss).item(),
            "binding": binding_loss(g.local_means, g.log_scales.exp(), drawn.visible, a).item(),
            "offset": a.offset_net.regularize * maps.square().mean().item(),
        }
    terms = stage.step(views.cameras[0], views.timesteps[0], target, WHITE)
    for name, value in expected.items():
        assert value > 0
        assert terms[name] == pytest.approx(value, rel=1e-5)
    assert terms["offset"] == pytest.approx(0.01 * 0.03**2, rel=1e-4)
    assert terms["loss"] == pytest.approx(sum(expected.values()), rel=1e-5)


def test_the_position_hinge_by_hand():
    """Nothing within epsilon of the centre; beyond it, the excess of the distance."""
    config = AppearanceConfig(lambda_position=2.0, epsilon_position=1.0)
    visible, small = torch.ones(2, dtype=torch.bool), torch.full((2, 3), 0.1)
    inside = torch.tensor([[0.9, 0.0, 0.0], [0.5, 0.5, 0.5]])
    assert binding_loss(inside, small, visible, config).item() == 0.0
    outside = torch.tensor([[0.0, 3.0, 4.0], [0.0, 0.0, 0.0]], requires_grad=True)
    loss = binding_loss(outside, small, visible, config)
    assert loss.item() == pytest.approx(2.0 * (5.0 - 1.0) / 2)
    loss.backward()
    assert torch.allclose(outside.grad[0], torch.tensor([0.0, 0.6, 0.8]))
    assert outside.grad[1].tolist() == [0.0, 0.0, 0.0]


def test_the_scale_hinge_by_hand():
    """Nothing while all axes are below epsilon; beyond it, the length of the excess over the axes."""
    config = AppearanceConfig(lambda_scale=3.0, epsilon_scale=0.6)
    visible, centre = torch.ones(2, dtype=torch.bool), torch.zeros(2, 3)
    assert binding_loss(centre, torch.full((2, 3), 0.6), visible, config).item() == 0.0
    scales = torch.tensor([[0.9, 1.0, 0.2], [0.1, 0.2, 0.3]], requires_grad=True)
    loss = binding_loss(centre, scales, visible, config)
    assert loss.item() == pytest.approx(3.0 * 0.5 / 2, rel=1e-4)
    loss.backward()
    assert torch.allclose(scales.grad[0], torch.tensor([0.9, 1.2, 0.0]), rtol=1e-4)
    assert scales.grad[1].tolist() == [0.0, 0.0, 0.0]


def test_hinges_have_finite_slopes_where_most_gaussians_are():
    """At the centre and at zero excess, where norms have none."""
    means, scales = torch.zeros(4, 3, requires_grad=True), torch.full((4, 3), 0.6, requires_grad=True)
    binding_loss(means, scales, torch.ones(4, dtype=torch.bool), AppearanceConfig()).backward()
    assert means.grad.tolist() == [[0.0] * 3] * 4
    assert scales.grad.tolist() == [[0.0] * 3] * 4


def test_only_visible_gaussians_are_held():
    """The mean runs over what the view touches; with nothing in view it is zero."""
    config = AppearanceConfig(lambda_position=1.0)
    means = torch.tensor([[3.0, 0, 0], [5.0, 0, 0], [0.0, 0, 0]], requires_grad=True)
    scales = torch.full((3, 3), 0.1)
    loss = binding_loss(means, scales, torch.tensor([True, False, True]), config)
    assert loss.item() == pytest.approx((3.0 - 1.0) / 2)
    loss.backward()
    assert not means.grad[1].any()
    assert binding_loss(means, scales, torch.zeros(3, dtype=torch.bool), config).item() == 0.0


@pytest.mark.parametrize("view_frame", ["canonical", "world"])
def test_directions_when_head_and_camera_move_together(subject, views, view_frame):
    """In the canonical frame they stay, so the colours do; in the world's they turn."""
    color_net = replace(tiny_config().appearance.color_net, view_frame=view_frame)
    appearance = make_appearance(subject, tiny_config(appearance={"color_net": color_net}))
    posed, camera = appearance.frozen.at_timestep(0), views.cameras[0]
    turn = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
    shift = np.array([0.3, -0.2, 0.5])
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = turn, shift
    moved_camera = Camera(camera.viewmat @ np.linalg.inv(move), camera.K, camera.width, camera.height)
    verts = posed.verts @ torch.tensor(turn, dtype=torch.float32).T + torch.tensor(shift, dtype=torch.float32)
    moved = PosedMesh(verts, FaceFrames.of(verts, appearance.frozen.body.faces), posed.pose_map, posed.theta)
    results = []
    for mesh, view in ((posed, camera), (moved, moved_camera)):
        means = mesh.frames.centers
        results.append(appearance._directions(means, mesh, view))
    assert torch.allclose(results[0].norm(dim=1), torch.ones(len(results[0])), atol=1e-5)
    same = torch.allclose(*results, atol=1e-5)
    assert same is (view_frame == "canonical")
    if view_frame == "world":
        direction = posed.frames.centers - torch.tensor(camera.position, dtype=torch.float32)
        assert torch.allclose(results[0], torch.nn.functional.normalize(direction, dim=1), atol=1e-6)
        turned = results[0] @ torch.tensor(turn, dtype=torch.float32).T
        assert torch.allclose(results[1], turned, atol=1e-5)


def test_in_the_canonical_pose_both_frames_agree(subject, views):
    """On the canonical mesh itself nothing is carried anywhere."""
    appearance = make_appearance(subject)
    frozen = appearance.frozen
    still = PosedMesh(frozen.canonical, frozen.frames, frozen.canonical_map, torch.zeros(N_THETA))
    found = appearance._directions(frozen.frames.centers, still, views.cameras[0])
    position = torch.tensor(views.cameras[0].position, dtype=torch.float32)
    assert torch.allclose(found, torch.nn.functional.normalize(frozen.frames.centers - position, dim=1), atol=1e-5)


def test_color_net_gives_colours():
    """Finite RGB wherever asked, also outside its box, near grey at first, and another colour from another side."""
    config = replace(tiny_config().appearance.color_net, levels=2)
    net = ColorNet(torch.tensor([-1.0, -1.0, -1.0]), torch.ones(3), config, seed=0)
    rng = torch.Generator().manual_seed(1)
    means = 3.0 * torch.randn(500, 3, generator=rng)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=rng), dim=1)
    assert (net(means, directions) - 0.5).abs().max() < 0.5
    with torch.no_grad():
        net.grid.table.uniform_(-5.0, 5.0, generator=torch.Generator().manual_seed(0))
    colors = net(means, directions)
    assert colors.shape == (500, 3)
    assert colors.isfinite().all()
    assert not torch.allclose(net(means, -directions), colors)
    assert not torch.allclose(net(means.roll(1, 0), directions), colors)


@pytest.mark.parametrize(("view_frame", "sees"), [("canonical", True), ("world", True), ("none", False)])
def test_color_net_sees_directions_unless_told_not_to(view_frame, sees):
    """Three more inputs, which change the colours, in both frames."""
    config = replace(tiny_config().appearance.color_net, view_frame=view_frame)
    net = ColorNet(torch.zeros(3), torch.ones(3), config, seed=0)
    assert net.mlp[0].in_features == net.grid.n_outputs + 3 * sees
    means, directions = torch.rand(20, 3), torch.nn.functional.normalize(torch.randn(20, 3), dim=1)
    assert torch.allclose(net(means, directions), net(means, -directions)) is not sees


def test_the_grid_of_color_net_is_that_of_the_configuration():
    """Every number of it, over a box whose sides all go from 0 to 1."""
    config = replace(
        tiny_config().appearance.color_net, levels=3, base_resolution=5, max_resolution=40, log2_table_size=9
    )
    low, high = torch.tensor([-1.0, 0.5, 2.0]), torch.tensor([1.0, 4.5, 2.5])
    net = ColorNet(low, high, config, seed=0)
    assert net.grid.shape == HashGridShape(levels=3, base_resolution=5, max_resolution=40, log2_table_size=9)
    given: list[Tensor] = []
    net.grid.register_forward_pre_hook(lambda module, inputs: given.append(inputs[0]))
    net(torch.stack([low, high, (low + high) / 2]), torch.zeros(3, 3))
    assert torch.allclose(given[0], torch.tensor([[0.0], [1.0], [0.5]]).expand(3, 3), atol=1e-6)


def test_color_net_encodes_places_on_the_canonical_head(subject, views):
    """Eq. 9's mu_c stays put while the head is posed, and its box holds the head."""
    appearance = make_appearance(subject)
    frozen, g = appearance.frozen, appearance.gaussians
    with torch.no_grad():
        g.local_means[3] = torch.tensor([0.2, 0.4, -0.1])
    means = g.canonical_means(frozen.frames)
    corners = frozen.canonical[frozen.body.faces[3].long()].double().numpy()
    R, k, T = frame_by_hand(*corners)
    assert np.allclose(means[3].numpy(), k * R @ np.array([0.2, 0.4, -0.1]) + T, atol=1e-7)
    assert not means.requires_grad
    place = (frozen.canonical - appearance.color_net.low) / appearance.color_net.size
    assert (place > 0).all()
    assert (place < 1).all()


def test_position_maps_show_the_face_without_its_root_motion(subject):
    """M_pose changes with neck and jaw, not with the root; values are of the order of 1."""
    frozen = make_appearance(subject).frozen
    pose = frozen.head.pose(0)
    base = frozen.posed(pose)
    rooted = frozen.posed(replace(pose, rotation=pose.rotation + 0.5, translation=pose.translation + 0.3))
    assert torch.equal(rooted.pose_map, base.pose_map)
    assert not torch.allclose(rooted.verts, base.verts)
    assert not torch.allclose(frozen.posed(replace(pose, jaw_pose=pose.jaw_pose + 0.5)).pose_map, base.pose_map)
    assert 0.5 < frozen.canonical_map.abs().max() <= 1.0
    assert base.theta.shape == (N_THETA,)


def test_position_maps_are_in_units_of_the_largest_side(subject):
    """Centred on the canonical head, its largest half side is 1 on every axis alike."""
    frozen = make_appearance(subject).frozen
    low, high = frozen.canonical.min(0).values, frozen.canonical.max(0).values
    rng = torch.Generator().manual_seed(0)
    verts = torch.randn(frozen.canonical.shape, generator=rng)
    expected = position_map(frozen._uv, (verts - 0.5 * (low + high)) / (0.5 * (high - low).max()))
    assert torch.allclose(frozen._map(verts), expected, atol=1e-6)
    assert torch.equal(frozen.canonical_map, frozen._map(frozen.canonical))


def test_the_box_of_the_colour_field(subject):
    """A twentieth of the head's size on every side: no cells are wasted on air."""
    appearance = make_appearance(subject)
    low, high = appearance.frozen.canonical.min(0).values, appearance.frozen.canonical.max(0).values
    assert torch.allclose(appearance.color_net.low, low - 0.05 * (high - low), atol=1e-7)
    assert torch.allclose(appearance.color_net.size, 1.1 * (high - low), atol=1e-6)


def test_colours_stay_with_the_canonical_place(subject, views):
    """Without view directions, a Gaussian has one colour in all poses."""
    color_net = replace(tiny_config().appearance.color_net, view_frame="none")
    appearance = make_appearance(subject, tiny_config(appearance={"color_net": color_net}))
    with torch.no_grad():
        appearance.color_net.grid.table.uniform_(-5.0, 5.0, generator=torch.Generator().manual_seed(0))
    first, second = (appearance(appearance.frozen.at_timestep(t), views.cameras[0])[0] for t in (0, 1))
    assert not torch.allclose(first.means, second.means)
    assert torch.equal(first.colors, second.colors)
    assert first.colors.std() > 0.01


def test_few_posed_meshes_are_kept(subject, monkeypatch):
    """Those used last; a long capture would fill the memory otherwise."""
    monkeypatch.setattr(model, "_CACHED_POSES", 2)
    frozen = make_appearance(subject).frozen
    first = frozen.at_timestep(0)
    frozen.at_timestep(1)
    assert frozen.at_timestep(0) is first
    frozen.at_timestep(2)
    assert list(frozen._posed) == [0, 2]
    assert frozen.at_timestep(0) is first


def test_a_head_whose_atlas_has_faces_without_area(subject):
    """Faces that collapse in UV space (as on a projected atlas) leave no NaN in the maps."""
    config = tiny_config()
    head = PersonalHead(Body(ball_head(), subdivisions=1), subject.params, config.geometry)
    appearance = build_appearance(head, config, seed=0)
    assert appearance.frozen.canonical_map.isfinite().all()
    assert appearance.gaussians.uvs.isfinite().all()


def test_without_offset_net(subject, views):
    """The ablation has no maps and no offset term, and still learns."""
    offset_net = replace(tiny_config().appearance.offset_net, enabled=False)
    stage = make_stage(subject, tiny_config(appearance={"offset_net": offset_net}))
    assert stage.appearance.offset_net is None
    terms = run(stage, views, 3)[-1]
    assert terms["offset"] == 0.0
    assert np.isfinite(terms["loss"])


def test_refinement_only_when_it_is_due(subject, views):
    """The number of Gaussians changes at 4 and 8, and at no other step; samples follow it."""
    stage = make_stage(subject, tiny_config(appearance={"iterations": 14}))
    counts = []
    for _ in range(14):
        run(stage, views, 1)
        counts.append(len(stage.appearance.gaussians))
        assert len(stage.appearance.gaussians.uvs) == counts[-1]
    changes = [i + 2 for i in range(13) if counts[i] != counts[i + 1]]
    assert changes
    assert set(changes) <= {4, 8}
    assert max(counts) <= stage.config.appearance.density.max_gaussians


def test_the_yardstick_is_the_mesh(subject):
    """Density control measures in diagonals of the canonical head."""
    stage = make_stage(subject)
    canonical = stage.appearance.frozen.canonical
    diagonal = (canonical.max(0).values - canonical.min(0).values).norm().item()
    assert stage.density.extent == pytest.approx(diagonal)


RATES = {
    "gaussians.local_means": 1.1e-3,
    "gaussians.log_scales": 1.3e-3,
    "gaussians.quats": 1.7e-3,
    "gaussians.opacity_logits": 1.9e-3,
    "gaussians.sh_constant": 2.3e-3,
    "gaussians.sh_others": 2.3e-3 / 20.0,
    "color_net.mlp": 2.9e-3,
    "offset_net": 3.1e-3,
    "expr": 3.7e-3,
    "rotation": 4.1e-3,
    "neck_pose": 4.1e-3,
    "jaw_pose": 4.1e-3,
    "eyes_pose": 4.1e-3,
    "translation": 4.3e-3,
}
"""A rate of its own for everything that learns, by the beginning of its name."""


@pytest.mark.parametrize("colors", ["color_net", "sh"])
def test_everything_learns_at_its_own_rate_and_all_rates_fall(subject, views, colors):
    """No two are exchanged, none is left out, and each ends at the stated share of itself."""
    tiny = tiny_config().appearance
    config = tiny_config(
        appearance={
            "iterations": 5, "lr_final_factor": 0.5, "density": NO_DENSITY, "colors": colors, "lr_means": 1.1e-3,
            "lr_scales": 1.3e-3, "lr_quats": 1.7e-3, "lr_opacities": 1.9e-3, "sh": ShConfig(lr=2.3e-3),
            "color_net": replace(tiny.color_net, lr=2.9e-3), "offset_net": replace(tiny.offset_net, lr=3.1e-3),
            "head_tuning": HeadTuningConfig(enabled=True, lr_expr=3.7e-3, lr_pose=4.1e-3, lr_translation=4.3e-3),
        }
    )  # fmt: skip
    stage = make_stage(subject, config)
    names = dict(stage.appearance.named_parameters()) | dict(stage.poses.items())
    names.pop("color_net.grid.table", None)  # has an optimizer of its own
    expected = {name: next(rate for start, rate in RATES.items() if name.startswith(start)) for name in names}

    def rates() -> dict[str, float]:
        of = {id(p): group["lr"] for group in stage.optimizer.param_groups for p in group["params"]}
        assert len(of) == len(names)
        return {name: of[id(parameter)] for name, parameter in names.items()}

    assert rates() == pytest.approx(expected, rel=1e-12)
    run(stage, views, 5)
    assert rates() == pytest.approx({name: 0.5 * rate for name, rate in expected.items()}, rel=1e-6)
    assert stage.optimizer.defaults["eps"] == 1e-15  # gradients of hidden Gaussians are as small as 1e-8


def test_the_hash_grid_follows_the_schedule(subject, views, monkeypatch):
    """Its own optimizer takes the rate of the place in the schedule, whatever the length of the steps."""
    color_net = replace(tiny_config().appearance.color_net, lr=0.02)
    config = tiny_config(
        appearance={"iterations": 8, "lr_final_factor": 0.1, "density": NO_DENSITY, "color_net": color_net}
    )
    stage = make_stage(subject, config)
    rates: list[float] = []
    monkeypatch.setattr(stage.appearance.color_net.grid, "adam_step", rates.append)
    target = views.target(0, WHITE, WHITE)
    for schedule_step in (1.0, 0.5, 2.5, 4.0):
        stage.step(views.cameras[0], views.timesteps[0], target, WHITE, schedule_step)
    assert rates == pytest.approx([0.02 * 0.1 ** (position / 8) for position in (0.0, 1.0, 1.5, 4.0)])
    assert stage.position == 8.0
    lr = {group["lr"] for group in stage.optimizer.param_groups}
    assert min(lr) == pytest.approx(0.1 * min(config.appearance.lr_quats, config.appearance.offset_net.lr))


@pytest.mark.parametrize("steps", [3, 6])
def test_a_stage_goes_on_from_its_state(subject, views, steps):
    """Saved before and after density control and loaded elsewhere, later steps are the same to the bit."""
    stage = make_stage(subject)
    run(stage, views, steps)
    state = copy.deepcopy(stage.state_dict())
    other = make_stage(subject)
    other.load_state_dict(state)
    steps = [run(each, views, 4) for each in (stage, other)]
    assert steps[0] == steps[1]
    for (name, a), b in zip(stage.appearance.named_parameters(), other.appearance.parameters(), strict=True):
        assert torch.equal(a, b), name


def test_loaded_poses_replace_the_meshes_that_are_kept(subject, views):
    """A state with other poses is drawn in them."""
    stage, other = make_stage(subject), make_stage(subject)
    before = other.appearance.frozen.at_timestep(0).verts
    with torch.no_grad():
        stage.poses["neck_pose"] += 0.3
    other.load_state_dict(copy.deepcopy(stage.state_dict()))
    assert torch.equal(other.poses["neck_pose"], stage.poses["neck_pose"])
    after = other.appearance.frozen.at_timestep(0).verts
    assert torch.equal(after, stage.appearance.frozen.at_timestep(0).verts)
    assert not torch.allclose(after, before)


def test_density_control_gets_canonical_sizes_and_ends(subject, views, monkeypatch):
    """Sizes are those of the canonical faces, not of a pose; after the last round nothing is collected."""
    stage = make_stage(subject)
    given: list[Tensor] = []
    monkeypatch.setattr(stage.density, "refine", lambda optimizer, scales: given.append(scales))
    run(stage, views, 8)
    assert len(given) == 2
    assert all(torch.equal(scales, stage.appearance.frozen.frames.scales) for scales in given)
    stage.density.reset()
    run(stage, views, 3)
    assert not stage.density.seen.any()


def test_a_loaded_state_of_the_same_size_replaces_what_was_prepared(subject, views):
    """Other faces and texture coordinates, as many Gaussians: the next view uses them."""
    appearance = make_appearance(subject)
    torch.nn.init.normal_(appearance.offset_net.last.weight)
    posed = appearance.frozen.at_timestep(0)
    appearance(posed, views.cameras[0])
    state = copy.deepcopy(appearance.state_dict())
    state["gaussians.face_ids"] = state["gaussians.face_ids"].flip(0)
    state["gaussians.uvs"] = state["gaussians.uvs"].flip(0)
    appearance.load_state_dict(state)
    fresh = make_appearance(subject)
    fresh.load_state_dict(state)
    found, expected = (model(posed, views.cameras[0])[0] for model in (appearance, fresh))
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
