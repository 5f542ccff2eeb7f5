"""Face frames, and rows gathered in a fixed order."""

import pytest
import torch
from checks import assert_gradcheck, assert_matches_twin, assert_same_bits
from twins import mesh as twins

from mgavatar.kernels.face_frames import SMALLEST_SCALE, face_frames, gather_matrix, gather_rows


def triangles(rng, n, *, scale=1.0, at=0.0):
    """A soup of triangles, all of a decent shape, as vertices and faces."""
    base = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.3, 1.0, 0.2]])
    turns = twins.rotations(2.0 * torch.randn(n, 3, generator=rng).double()).float()
    verts = (base + 0.1 * torch.randn(n, 3, 3, generator=rng)) @ turns.mT + torch.randn(n, 1, 3, generator=rng)
    return (scale * verts.reshape(-1, 3) + at).requires_grad_(), torch.arange(3 * n).reshape(n, 3)


def frames_as_matrices(verts, faces):
    """Face frames with the quaternion turned into a matrix, whose sign has no meaning."""
    quats, scales, centers = face_frames(verts, faces)
    return twins.quat_matrix(quats), scales, centers


def test_right_triangle_known_by_hand():
    """Edge along x, normal along z: columns x, z, x times z; k the mean of 2 and 1."""
    verts = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    quats, scales, centers = face_frames(verts, torch.tensor([[0, 1, 2]]))
    expected = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    assert torch.allclose(twins.quat_matrix(quats)[0], expected, atol=1e-6)
    assert scales.item() == pytest.approx(1.5)
    assert torch.allclose(centers[0], torch.tensor([2 / 3, 1 / 3, 0.0]))


@pytest.mark.parametrize(("scale", "at"), [(1.0, 0.0), (1e-3, 0.0), (1e6, 0.0)])
def test_frames_match_the_float64_twin(device, rng, scale, at):
    """Random rotations reach all four branches of the quaternion; sizes from a millimetre to 1e6."""
    verts, faces = triangles(rng, 400, scale=scale, at=at)
    assert_matches_twin(
        lambda v: frames_as_matrices(v, faces.to(v.device)),
        lambda v: twins.face_frames(v, faces),
        (verts,),
        device=device,
    )


def test_frames_of_shared_and_flipped_faces(device, rng):
    """Vertices of many faces collect their gradients; a face inside out has the normal that its order says."""
    verts = torch.randn(30, 3, generator=rng).requires_grad_()
    faces = torch.stack([torch.randperm(30, generator=rng)[:3] for _ in range(200)])
    faces = torch.cat([faces, faces[:50, [0, 2, 1]]])
    assert_matches_twin(
        lambda v: frames_as_matrices(v, faces.to(v.device)),
        lambda v: twins.face_frames(v, faces),
        (verts,),
        device=device,
        gradient_tolerance=2e-5,  # slim random triangles
    )


def test_collapsed_faces_stay_finite(device):
    """Coincident vertices, no edge, no area, needles, far away: a rotation, a positive scale, finite gradients."""
    e = torch.tensor([1.0, 0.0, 0.0])
    soup = torch.stack(
        [
            torch.zeros(3, 3),
            torch.stack([0 * e, 0 * e, e]),
            torch.stack([0 * e, e, e]),
            torch.stack([0 * e, e, 2 * e]),
            torch.stack([0 * e, e, torch.tensor([0.5, 1e-7, 0.0])]),
            torch.stack([0 * e, e, torch.tensor([0.5, 1.1e-5, 0.0])]),
            torch.stack([0 * e, 1e-20 * e, 1e-20 * e.roll(1)]),
            torch.stack([0 * e, 1e-12 * e, 1e-12 * e.roll(1)]),
            torch.stack([1e6 + e, 1e6 + 2 * e, 1e6 + e.roll(1)]),
            torch.stack([0 * e, 1e15 * e, 1e15 * e.roll(1)]),
        ]
    )
    verts = soup.reshape(-1, 3).to(device).requires_grad_()
    quats, scales, centers = face_frames(verts, torch.arange(30, device=device).reshape(10, 3))
    (quats.sum() + scales.sum() + centers.sum()).backward()
    assert torch.allclose(quats.norm(dim=1), torch.ones(10, device=device))
    assert (scales >= SMALLEST_SCALE).all()
    for tensor in (scales, centers, verts.grad):
        assert tensor.isfinite().all()
    assert torch.equal(scales[:2], torch.full((2,), SMALLEST_SCALE, device=device))
    assert scales[2:4].tolist() == pytest.approx([0.5, 0.5])


def test_needles_do_not_throw_their_vertices(device):
    """The normal's gradient grows as 1 / height; a height that is only rounding passes none."""
    weights = torch.tensor([1.0, 2.0, 3.0, 4.0], device=device)
    for height, least, most in ((1e-2, 20.0, 60.0), (1e-4, 2e3, 6e3), (1e-7, 0.1, 10.0)):
        verts = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, height, 0.0]], device=device).requires_grad_()
        quats, scales, centers = face_frames(verts, torch.tensor([[0, 1, 2]], device=device))
        ((quats * weights).sum() + scales.sum() + centers.sum()).backward()
        assert least < float(verts.grad.abs().max()) < most


def test_nan_vertices_spoil_only_their_faces(device):
    """One vertex of a diverged fit does not reach the faces that do not use it."""
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [torch.nan] * 3], device=device)
    quats, scales, centers = face_frames(verts, torch.tensor([[0, 1, 2], [1, 2, 4], [1, 3, 2]], device=device))
    assert centers[1].isnan().all()
    for tensor in (quats, scales, centers):
        assert tensor[[0, 2]].isfinite().all()


def test_gathered_rows_match_the_float64_twin(device, rng):
    """Rows that are taken often, once and never."""
    index = torch.cat([torch.zeros(5000, dtype=torch.long), torch.randint(1, 90, (300,), generator=rng)])
    x = torch.randn(100, 4, generator=rng).requires_grad_()
    order = gather_matrix(index, 100).to(device)
    assert_matches_twin(lambda x: gather_rows(x, index, order=order), lambda x: x[index], (x,), device=device)
    assert torch.equal(gather_rows(x.detach(), index), x.detach()[index])


def test_float64_gradients_match_finite_differences(rng):
    """The adjoint of the float64 build."""
    verts, faces = triangles(rng, 5)
    assert_gradcheck(lambda v: face_frames(v, faces), verts)


def test_same_bits_for_any_number_of_threads(device, rng):
    """Corner gathers add up in a fixed order."""
    faces = torch.randint(50, (2000, 3), generator=rng).to(device)
    verts = torch.randn(50, 3, generator=rng).requires_grad_()
    assert_same_bits(lambda v: face_frames(v, faces), (verts,), device=device)


def test_no_faces_have_no_frames():
    """Empty in, empty out."""
    quats, scales, _ = face_frames(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long))
    assert (quats.shape, scales.shape) == ((0, 4), (0,))


def test_bad_input_is_refused(rng):
    """Shapes and index ranges."""
    verts, faces = triangles(rng, 2)
    with pytest.raises(ValueError, match="index"):
        face_frames(verts, faces + 4)
    with pytest.raises(ValueError, match=r"faces \[F, 3\]"):
        face_frames(verts, faces[:, :2])
    with pytest.raises(ValueError, match="order has shape"):
        face_frames(verts, faces, order=gather_matrix(faces, 7))
