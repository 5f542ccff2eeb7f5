"""Blend shapes, joints and skinning."""

import math

import pytest
import torch
from checks import assert_gradcheck, assert_matches_twin, assert_same_bits
from twins import mesh as twins

from mgavatar.kernels.lbs import blend_shapes, joint_transforms, skin

PARENTS = [-1, 0, 1, 1, 1]


def directions(rng, n_dirs, n_verts):
    """Template, directions and coefficients, the last of which is zero."""
    coeffs = torch.randn(n_dirs, generator=rng)
    coeffs[-1] = 0.0
    template = torch.randn(n_verts, 3, generator=rng)
    return template.requires_grad_(), torch.randn(n_dirs, n_verts, 3, generator=rng), coeffs.requires_grad_()


def chain(rng, angle):
    """Joints and rotation vectors of one length."""
    poses = torch.nn.functional.normalize(torch.randn(5, 3, generator=rng).double(), dim=1) * angle
    return torch.randn(5, 3, generator=rng).requires_grad_(), poses.float().requires_grad_()


def skinned(rng, n_verts, scale=1.0):
    """Vertices, weights that do not sum to 1, and transforms."""
    transforms = torch.eye(4) + 0.3 * torch.randn(5, 4, 4, generator=rng)
    transforms[:, 3] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    verts = (scale * torch.randn(n_verts, 3, generator=rng)).requires_grad_()
    return verts, torch.rand(n_verts, 5, generator=rng), transforms.requires_grad_()


def joints_op(joints, poses):
    return joint_transforms(joints, poses, torch.tensor(PARENTS))


def joints_twin(joints, poses):
    return twins.joint_transforms(joints, poses, PARENTS)


@pytest.mark.parametrize(("n_dirs", "n_verts"), [(1, 1), (3, 5), (7, 700), (60, 2001), (9, 3000)])
def test_blend_shapes_match_the_float64_twin(device, rng, n_dirs, n_verts):
    """Any number of directions, in and out of whole passes and blocks."""
    assert_matches_twin(blend_shapes, twins.blend_shapes, directions(rng, n_dirs, n_verts), device=device)


def test_directions_with_zero_coefficient_are_not_read(device, rng):
    """Not even where they hold NaN; their coefficients still get a gradient where they hold numbers."""
    template, dirs, coeffs = directions(rng, 9, 50)
    dirs[-1] = torch.nan
    out = blend_shapes(template.to(device), dirs.to(device), coeffs.to(device))
    assert out.isfinite().all()
    template, dirs, coeffs = directions(rng, 9, 50)
    blend_shapes(template, dirs, coeffs).sum().backward()
    assert torch.allclose(coeffs.grad[-1], dirs[-1].sum(), rtol=1e-5)


def test_no_directions(rng):
    """The template comes back, with its gradient."""
    template = torch.randn(4, 3, generator=rng).requires_grad_()
    out = blend_shapes(template, torch.zeros(0, 4, 3), torch.zeros(0))
    out.sum().backward()
    assert torch.equal(out, template)
    assert torch.equal(template.grad, torch.ones(4, 3))


def test_quarter_turn_known_by_hand():
    """The jaw turns 90 degrees about x through its joint; the root's turn is about the root joint."""
    joints = torch.tensor([[0.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 2.0, 1.0]])
    poses = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [math.pi / 2, 0.0, 0.0]])
    transforms, feature = joint_transforms(joints, poses, torch.tensor([-1, 0, 1]))
    point = transforms[2] @ torch.tensor([0.0, 2.0, 2.0, 1.0])
    assert torch.allclose(point, torch.tensor([0.0, 1.0, 1.0, 1.0]), atol=1e-6)
    assert torch.allclose(feature[9:], torch.tensor([0.0, 0.0, 0.0, 0.0, -1.0, -1.0, 0.0, 1.0, -1.0]), atol=1e-6)
    transforms, _ = joint_transforms(joints, poses.flip(0), torch.tensor([-1, 0, 1]))
    assert torch.allclose(
        transforms[0] @ torch.tensor([0.0, 1.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.0, 1.0]), atol=1e-6
    )


ANGLES = [0.0, 1e-20, 1e-4, 0.1, 0.999, 1.001, math.pi - 1e-7, math.pi, math.pi + 1e-7, 2 * math.pi, 100.0, 1e4]


@pytest.mark.parametrize("angle", ANGLES)
def test_joint_transforms_match_the_float64_twin(device, rng, angle):
    """Rotations from none to 1e4 rad; the exponential that the twin squares loses digits at 1e4, in float64."""
    assert_matches_twin(joints_op, joints_twin, chain(rng, angle), device=device)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.9, 3.14, 20.0])
def test_joint_gradients_match_finite_differences(rng, angle):
    """Both sides of the series, and the half turn."""
    assert_gradcheck(joints_op, *chain(rng, angle))


def test_far_joints(device, rng):
    """Joints at 1e6: the errors are relative to the size of the coordinates."""
    joints, poses = chain(rng, 1.0)
    assert_matches_twin(joints_op, joints_twin, ((joints.detach() + 1e6).requires_grad_(), poses), device=device)


@pytest.mark.parametrize("n_verts", [1, 127, 128, 3000])
def test_skinning_matches_the_float64_twin(device, rng, n_verts):
    """Weights that do not sum to 1 are used as they are."""
    verts, weights, transforms = skinned(rng, n_verts)
    top = transforms.detach()[:, :3].clone().requires_grad_()

    def whole(top):
        return torch.cat([top, torch.tensor([0.0, 0.0, 0.0, 1.0]).to(top).expand(len(top), 1, 4)], 1)

    assert_matches_twin(
        lambda v, w, t: skin(v, w, whole(t)),
        lambda v, w, t: twins.skin(v, w, whole(t)),
        (verts, weights, top),
        device=device,
    )


def test_skinning_far_away(device, rng):
    """Coordinates of 1e6."""
    verts, weights, transforms = skinned(rng, 500, scale=1e6)
    assert_matches_twin(skin, twins.skin, (verts, weights, transforms), device=device)


def test_float64_gradients_match_finite_differences(rng):
    """Skinning and blend shapes."""
    verts, weights, transforms = skinned(rng, 6)
    last = transforms.detach()[:, 3:].double()

    def op(v, top):
        return skin(v, weights.double(), torch.cat([top, last], 1))

    assert_gradcheck(op, verts, transforms[:, :3])
    template, dirs, coeffs = directions(rng, 6, 4)
    assert_gradcheck(lambda t, c: blend_shapes(t, dirs.double(), c), template, coeffs)


def test_same_bits_for_any_number_of_threads(device, rng):
    """Blocks, chunks and lanes are fixed."""
    assert_same_bits(blend_shapes, directions(rng, 40, 3001), device=device)
    assert_same_bits(skin, skinned(rng, 3001), device=device)


def test_numbers_that_are_not_finite_do_not_spread(rng):
    """A NaN vertex stays alone in the output; a NaN rotation gives NaN, not a crash."""
    verts, weights, transforms = skinned(rng, 10)
    bad = verts.detach().clone()
    bad[3] = torch.nan
    out = skin(bad, weights, transforms.detach())
    assert out[3].isnan().all()
    assert out[torch.arange(10) != 3].isfinite().all()
    joints, poses = chain(rng, 1.0)
    turned, _ = joints_op(joints.detach(), torch.full_like(poses, torch.nan))
    assert turned[0, :3].isnan().any()


def test_bad_input_is_refused(rng):
    """Shapes, dtypes, parents out of order, and gradients that do not exist."""
    template, dirs, coeffs = directions(rng, 3, 5)
    with pytest.raises(ValueError, match="blend shapes need"):
        blend_shapes(template, dirs[:, :4], coeffs)
    with pytest.raises(ValueError, match="coeffs is torch"):
        blend_shapes(template, dirs, coeffs.double())
    with pytest.raises(ValueError, match="dirs must be contiguous"):
        blend_shapes(template, torch.stack([*dirs], 2).movedim(2, 0), coeffs)
    with pytest.raises(ValueError, match="dirs requires a gradient"):
        blend_shapes(template, dirs.requires_grad_(), coeffs)
    joints, poses = chain(rng, 1.0)
    with pytest.raises(ValueError, match="come before"):
        joint_transforms(joints, poses, torch.tensor([-1, 2, 1, 1, 1]))
    with pytest.raises(ValueError, match="a chain needs"):
        joint_transforms(joints, poses[:4], torch.tensor(PARENTS))
    verts, weights, transforms = skinned(rng, 5)
    with pytest.raises(ValueError, match="skinning needs"):
        skin(verts, weights[:, :4], transforms)
    with pytest.raises(ValueError, match=r"\[J, 4, 4\]"):
        skin(verts, weights, transforms[:, :3])
    with pytest.raises(ValueError, match="weights requires a gradient"):
        skin(verts, weights.requires_grad_(), transforms)
