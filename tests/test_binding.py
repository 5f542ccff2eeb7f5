"""Face-bound Gaussians carried to the world in one pass: values by hand, the float64 twin, refusals."""

from __future__ import annotations

import pytest
import torch
from checks import assert_gradcheck, assert_matches_twin, assert_same_bits
from torch.nn.functional import normalize
from twins import mesh as twins

from mgavatar.kernels.binding import bind_to_faces, directions_on_faces, place_on_faces


def scene(rng, n, n_faces=40):
    """Frames, faces and local parameters with offsets, all of which want gradients."""

    def draw(*shape, scale=1.0):
        return scale * torch.randn(*shape, generator=rng)

    frames = normalize(draw(n_faces, 4), dim=1), 0.01 + 0.02 * draw(n_faces).abs(), draw(n_faces, 3)
    face_ids = torch.randint(n_faces, (n,), generator=rng)
    local = draw(n, 3), draw(n, 4), draw(n, 3, scale=0.5), draw(n), draw(n, 13, scale=0.3)
    return (*(t.requires_grad_() for t in frames), face_ids, *(t.requires_grad_() for t in local))


def bound(q, k, t, face_ids, *local):
    """The op with its arguments in the twin's order."""
    return bind_to_faces((q, k, t), face_ids.to(q.device), *local[:4], offsets=local[4])


def test_a_gaussian_by_hand(device):
    """A quarter turn about z, twice the size, an offset of each kind."""
    half = 0.5**0.5
    frames = (
        torch.tensor([[1.0, 0, 0, 0], [half, 0, 0, half]], device=device),
        torch.tensor([1.0, 2.0], device=device),
        torch.tensor([[0.0, 0, 0], [10, 20, 30]], device=device),
    )
    face_ids = torch.tensor([1], device=device)
    offsets = torch.zeros(1, 13, device=device)
    offsets[0, 0], offsets[0, 4], offsets[0, 8], offsets[0, 9], offsets[0, 12] = 1.0, 0.25, 0.2, 0.5, 1.0
    local = torch.tensor([[1.0, 0, 0]], device=device), torch.tensor([[1.0, 0, 0, 0]], device=device)
    more = torch.zeros(1, 3, device=device), torch.zeros(1, device=device)
    means, quats, scales, opacities, colors = bind_to_faces(frames, face_ids, *local, *more, offsets=offsets)
    assert means[0].tolist() == pytest.approx([10.0, 24.0, 30.0], abs=1e-5)
    assert quats[0].tolist() == pytest.approx([half * 0.9, 0.0, 0.0, half * 1.1])
    assert scales[0].tolist() == pytest.approx([2 * 2.718281828**0.5, 2.0, 2.0])
    assert float(opacities) == pytest.approx(1 / (1 + 2.718281828**-1))
    assert colors[0].tolist() == [0.0, 0.25, 0.0]
    plain = bind_to_faces(frames, face_ids, *local, *more)
    assert plain[0][0].tolist() == pytest.approx([10.0, 22.0, 30.0], abs=1e-5)
    assert plain[2][0].tolist() == [2.0, 2.0, 2.0]
    assert float(plain[3]) == 0.5
    assert not plain[4].any()
    assert place_on_faces(frames, face_ids, local[0])[0].tolist() == pytest.approx([10.0, 22.0, 30.0], abs=1e-5)


def test_the_length_of_a_local_quaternion_is_carried_through(device):
    """A quarter turn about z, twice as large, moved by one along x; the local length of 3 stays."""
    half = 0.5**0.5
    frames = (
        torch.tensor([[half, 0.0, 0.0, half]], device=device),
        torch.tensor([2.0], device=device),
        torch.tensor([[1.0, 0.0, 0.0]], device=device),
    )
    local = (
        torch.tensor([[1.0, 0.0, 0.0]], device=device),
        torch.tensor([[3.0, 0.0, 0.0, 0.0]], device=device),
        torch.tensor([[0.1, 0.2, 0.3]], device=device).log(),
        torch.zeros(1, device=device),
    )
    means, quats, scales, *_ = bind_to_faces(frames, torch.zeros(1, dtype=torch.long, device=device), *local)
    assert means[0].tolist() == pytest.approx([1.0, 2.0, 0.0], abs=1e-6)
    assert quats[0].tolist() == pytest.approx([3 * half, 0.0, 0.0, 3 * half])
    assert scales[0].tolist() == pytest.approx([0.2, 0.4, 0.6])


def test_outputs_and_gradients_match_the_float64_twin(device, rng):
    """Five outputs; eight gradients, those of the frames along the unit sphere only and summed over their Gaussians."""

    def on_sphere(op):
        return lambda q, *others: op(normalize(q, dim=1), *others)

    assert_matches_twin(on_sphere(bound), on_sphere(twins.bind_to_faces), scene(rng, 700), device=device)


def test_float64_gradients_match_finite_differences(rng):
    """Also of quaternions that are not of unit length, which both directions take as they are."""
    q, k, t, face_ids, *local = scene(rng, 6, n_faces=3)
    assert_gradcheck(lambda q, k, t, *local: bound(q, k, t, face_ids, *local), q, k, t, *local)
    assert_gradcheck(lambda *local: bind_to_faces((q.double(), k.double(), t.double()), face_ids, *local), *local[:4])


def test_frames_without_gradient_get_none(device, rng):
    """A frozen mesh, as in the appearance stage."""
    q, k, t, face_ids, *local = (x.detach().to(device) for x in scene(rng, 50))
    local = [x.requires_grad_() for x in local]
    sum(out.sum() for out in bound(q, k, t, face_ids, *local)).backward()
    assert q.grad is None
    assert all(x.grad.isfinite().all() for x in local)


def test_directions_match_rotation_matrices(device, rng):
    """Carried out of one frame and into the other."""
    q, _, _, face_ids, means, *_ = (x.detach().to(device) for x in scene(rng, 300))
    to = normalize(torch.randn(40, 4, generator=rng), dim=1).to(device)
    position = torch.tensor([0.3, -2.0, 5.0], device=device)
    found = directions_on_faces(means, position, face_ids, q, to)
    along = normalize((means - position).double(), dim=1)[:, :, None]
    turn = twins.quat_matrix(to.double())[face_ids] @ twins.quat_matrix(q.double())[face_ids].mT
    assert torch.allclose(found.double(), (turn @ along)[:, :, 0], atol=1e-6)
    assert not directions_on_faces(position[None], position, face_ids[:1], q, to).any()


def test_extreme_parameters_stay_where_they_are(device, rng):
    """NaN and infinity reach their own Gaussian alone; a scale that overflows is infinite, an opacity is 0 or 1."""
    q, k, t, face_ids, *local = (x.detach().to(device) for x in scene(rng, 6))
    local[0][0], local[1][1], local[2][2] = torch.nan, torch.inf, 200.0
    local[3][3], local[3][4] = 200.0, -200.0
    local = [x.requires_grad_() for x in local]
    outputs = bound(q, k, t, face_ids, *local)
    assert outputs[0][0].isnan().all()
    assert outputs[2][2].isinf().all()
    assert outputs[3][3:5].tolist() == [1.0, 0.0]
    sum(out[3:].sum() for out in outputs).backward()
    for out in outputs:
        assert out[3:].isfinite().all()
    for x in local:
        assert x.grad[3:].isfinite().all()


def test_same_bits_for_any_number_of_threads(device, rng):
    """The frames' gradient adds up Gaussians in their order."""
    assert_same_bits(bound, scene(rng, 3000), device=device)


def test_nothing_is_bound_to_nothing(rng):
    """No Gaussians."""
    q, k, t, face_ids, *local = scene(rng, 0)
    means, *_, colors = bound(q, k, t, face_ids, *local)
    assert (means.shape, colors.shape) == ((0, 3), (0, 3))
    assert place_on_faces((q, k, t), face_ids, local[0]).shape == (0, 3)


def test_bad_input_is_refused(rng):
    """Shapes and dtypes."""
    q, k, t, face_ids, *local = scene(rng, 5)
    with pytest.raises(ValueError, match="local_quats has shape"):
        bind_to_faces((q, k, t), face_ids, local[0], local[0], *local[2:4])
    with pytest.raises(ValueError, match="offsets has shape"):
        bind_to_faces((q, k, t), face_ids, *local[:4], offsets=local[4][:3])
    with pytest.raises(ValueError, match="face_quats has shape"):
        bind_to_faces((q[:7], k, t), face_ids, *local[:4])
    with pytest.raises(ValueError, match="face_centers has shape"):
        bind_to_faces((q, k, t[:7]), face_ids, *local[:4])
    with pytest.raises(ValueError, match="log_scales is torch"):
        bind_to_faces((q, k, t), face_ids, *local[:2], local[2].double(), local[3])
