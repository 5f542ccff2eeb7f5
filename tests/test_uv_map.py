"""Position maps and samples in UV space."""

import pytest
import torch
from checks import assert_gradcheck, assert_matches_twin, assert_same_bits
from twins import mesh as twins

from mgavatar.kernels.uv_map import position_map, sample_map, uv_map, uv_sampler

CORNERS = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
SQUARE = torch.tensor([[0, 1, 2], [0, 2, 3]])


def soup(rng):
    """Overlapping charts, mirrored ones, one without area, one outside, one across the border."""
    vt = torch.rand(24, 2, generator=rng)
    vt[3:6] = 0.5
    vt[6:9] += 3.0
    vt[9:12] = torch.tensor([[-0.5, -0.5], [0.7, -0.4], [0.2, 1.7]])
    ft = torch.arange(24).reshape(8, 3)
    faces = torch.randint(10, (8, 3), generator=rng)
    return vt, ft, faces


def test_row_zero_is_the_top():
    """u runs along columns, v up; a square of two faces covers every texel, the diagonal too, once."""
    uv = uv_map(CORNERS, SQUARE, SQUARE, 4, 4, 8)
    drawn = position_map(uv, CORNERS)
    assert torch.allclose(drawn[0, 0], (torch.arange(8) + 0.5) / 8)
    assert torch.allclose(drawn[1, :, 0], 1 - (torch.arange(4) + 0.5) / 4)
    assert (uv.face_ids >= 0).all()
    assert uv.face_ids.dtype == torch.int32


def test_the_smallest_face_wins_where_faces_meet():
    """Centres on the shared diagonal of a square map belong to face 0; so does everything under both copies of it."""
    doubled = torch.cat([SQUARE, SQUARE.flip(1)])
    uv = uv_map(CORNERS, doubled, doubled, 4, 5, 5)
    assert uv.face_ids.flip(0).diagonal().tolist() == [0] * 5
    assert int(uv.face_ids.max()) == 1


def test_cover_matches_the_float64_twin(device, rng):
    """Every texel against every face, weights by solving for them."""
    vt, ft, faces = soup(rng)
    uv = uv_map(vt.to(device), ft.to(device), faces.to(device), 10, 13, 17)
    ids, weights = twins.uv_cover(vt, ft, 13, 17)
    assert torch.equal(uv.face_ids.cpu(), ids)
    assert (ids == -1).any()
    verts = torch.randn(10, 3, generator=rng).requires_grad_()

    def twin(verts):
        corners = verts[faces[ids.clamp(min=0).long()]]
        return (weights[..., None].to(verts) * corners).sum(2).permute(2, 0, 1)

    assert_matches_twin(lambda v: position_map(uv, v), twin, (verts,), device=device)


def test_a_real_atlas(real_data):
    """All covered texels have weights that sum to 1, and a mirrored chart is covered too."""
    import numpy as np

    with np.load(real_data / "head_models" / "ict_head.npz") as head:
        vt, ft, faces, verts = (torch.from_numpy(head[k]) for k in ("vt", "ft", "f", "v_template"))
    uv = uv_map(vt, ft, faces, len(verts), 256, 256)
    covered = position_map(uv, torch.ones(len(verts), 1))[0]
    assert torch.allclose(covered, (uv.face_ids >= 0).float(), atol=1e-6)
    assert 0.6 < float(covered.mean()) < 0.8
    drawn = position_map(uv, verts)[:, uv.face_ids >= 0]
    assert (drawn.amin(1) >= verts.amin(0) - 1e-6).all()
    assert (drawn.amax(1) <= verts.amax(0) + 1e-6).all()


def test_numbers_that_are_not_finite_cover_nothing(rng):
    """NaN, infinite and huge texture coordinates index no texel outside the map."""
    vt = torch.tensor(
        [[torch.nan, 0], [1, 0], [1, 1], [torch.inf, 0], [-torch.inf, 1], [1e30, -1e30], [-1e30, 0], [0, 1e30]]
    )
    ft = torch.tensor([[0, 1, 2], [3, 1, 2], [3, 4, 2], [5, 6, 7]])
    uv = uv_map(vt, ft, ft, 8, 6, 6)
    assert set(uv.face_ids.flatten().tolist()) <= {-1, 3}


@pytest.mark.parametrize(("height", "width"), [(8, 8), (5, 9), (1, 7), (1, 1)])
def test_samples_match_the_float64_twin(device, rng, height, width):
    """Inside, on the border and outside, for maps down to one texel."""
    inside = torch.rand(200, 2, generator=rng)
    border = torch.cat(
        [CORNERS, CORNERS * 1e-7, 1 - CORNERS * 1e-7, torch.tensor([[0.5, 1.0], [-3.0, 0.3], [1e6, -1e6]])]
    )
    uv = torch.cat([inside, border])
    maps = torch.randn(3, height, width, generator=rng).requires_grad_()

    def twin(maps):
        return twins.sample_map(maps, uv.double().clamp(-9, 9))

    assert_matches_twin(lambda m: sample_map(m, uv.to(m.device)), twin, (maps,), device=device)


def test_a_sample_at_a_texel_centre_is_the_texel():
    """The two conventions are one: what position_map draws, sample_map reads at the same place."""
    uv = uv_map(CORNERS, SQUARE, SQUARE, 4, 6, 6)
    drawn = position_map(uv, CORNERS)
    centres = drawn.reshape(2, -1).T.contiguous()
    assert torch.allclose(sample_map(drawn, centres), centres, atol=1e-6)


def test_nan_coordinates_read_the_first_texels():
    """A sample without a place does not index outside the map."""
    maps = torch.arange(6.0).reshape(1, 2, 3)
    assert sample_map(maps, torch.tensor([[torch.nan, torch.nan]])).item() == 0.0


def test_float64_gradients_match_finite_differences(rng):
    """Both directions."""
    vt, ft, faces = soup(rng)
    uv = uv_map(vt, ft, faces, 10, 4, 5)
    assert_gradcheck(lambda v: position_map(uv, v), torch.randn(10, 3, generator=rng))
    places = torch.rand(6, 2, generator=rng)
    assert_gradcheck(lambda m: sample_map(m, places), torch.randn(2, 4, 5, generator=rng))


def test_same_bits_for_any_number_of_threads(device, rng):
    """Many samples of one texel add up in a fixed order."""
    places = (0.1 * torch.rand(5000, 2, generator=rng)).to(device)
    maps = torch.randn(4, 16, 16, generator=rng).requires_grad_()
    assert_same_bits(lambda m: sample_map(m, places), (maps,), device=device)


def test_bad_input_is_refused():
    """Shapes and ranges."""
    with pytest.raises(ValueError, match="a UV map needs vt"):
        uv_map(CORNERS, SQUARE, SQUARE[:1], 4, 4, 4)
    with pytest.raises(ValueError, match="but there are 3 texture coordinates"):
        uv_map(CORNERS[:3], SQUARE, SQUARE, 4, 4, 4)
    with pytest.raises(ValueError, match="at least one texel"):
        uv_map(CORNERS, SQUARE, SQUARE, 4, 0, 4)
    with pytest.raises(ValueError, match="column index"):
        uv_map(CORNERS, SQUARE, SQUARE, 3, 4, 4)
    with pytest.raises(ValueError, match=r"uv must have shape \[N, 2\]"):
        uv_sampler(torch.zeros(3, 3), 4, 4)
    with pytest.raises(ValueError, match=r"\[C, H, W\]"):
        sample_map(torch.zeros(4, 4), torch.zeros(1, 2))
    with pytest.raises(ValueError, match="sparse matrix of shape"):
        sample_map(torch.zeros(1, 4, 4), torch.zeros(1, 2), sampler=uv_sampler(torch.zeros(1, 2), 5, 4))
