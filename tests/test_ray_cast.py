"""Rays against triangle meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import warp as wp

import mgavatar.kernels.ray_cast as module
from mgavatar.camera import look_at
from mgavatar.kernels.bridge import num_threads, set_num_threads
from mgavatar.kernels.ray_cast import RayMesh, camera_rays, ray_cast


def brute_force(verts: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray):
    """Möller and Trumbore (1997) for every ray and face in float64.

    Returns depth [N], face [N], barycentrics [N, 3], and how far each ray stays from any edge (barycentric) [N].
    """
    a, b, c = (verts[faces[:, i]].astype(np.float64)[None] for i in range(3))
    o, d = origins.astype(np.float64)[:, None], directions.astype(np.float64)[:, None]
    p = np.cross(d, c - a)
    det = ((b - a) * p).sum(-1)
    u = ((o - a) * p).sum(-1) / det
    q = np.cross(o - a, b - a)
    v = (d * q).sum(-1) / det
    t = ((c - a) * q).sum(-1) / det
    inner = np.minimum(np.minimum(u, v), 1 - u - v)  # [N, F]
    depth = np.where((inner >= 0) & (t > 0), t, np.inf)
    face = depth.argmin(1)
    rows = np.arange(len(origins))
    nearest = depth[rows, face]
    weights = np.stack([1 - u - v, u, v], axis=-1)[rows, face]
    margin = np.where(t > 0, np.abs(inner), np.inf).min(1)
    return nearest, np.where(np.isfinite(nearest), face, -1), weights, margin


def soup(rng: torch.Generator, device: torch.device, n_faces: int = 150):
    """Triangles of a hand's size in a room, on a device."""
    centers = torch.rand(n_faces, 1, 3, generator=rng) * 2 - 1
    verts = (centers + 0.3 * torch.randn(n_faces, 3, 3, generator=rng)).reshape(-1, 3)
    return verts.to(device), torch.arange(3 * n_faces, dtype=torch.int32).reshape(-1, 3).to(device)


def test_a_triangle_known_by_hand(device: torch.device) -> None:
    verts = torch.tensor([[0.0, 0, 2], [1, 0, 2], [0, 1, 2]], device=device)
    faces = torch.tensor([[0, 1, 2]], dtype=torch.int32, device=device)
    origins = torch.tensor([[0.25, 0.5, 0.0], [0.25, 0.5, 3.0], [0.25, 0.5, 3.0], [0.9, 0.9, 0.0]], device=device)
    directions = torch.tensor([[0.0, 0, 1], [0, 0, -4], [0, 0, 1], [0, 0, 1]], device=device)
    depths, face_ids, barycentrics = ray_cast(verts, faces, origins, directions)
    # From both sides; a depth counts lengths of the direction; behind the origin and beside the triangle are misses.
    assert face_ids.tolist() == [0, 0, -1, -1]
    assert depths.tolist() == [2.0, 0.25, torch.inf, torch.inf]
    torch.testing.assert_close(barycentrics[:2].cpu(), torch.tensor([[0.25, 0.25, 0.5]]).expand(2, 3))
    assert not barycentrics[2:].any()


def test_matches_the_float64_twin(device: torch.device, rng: torch.Generator) -> None:
    verts, faces = soup(rng, device)
    origins = 3 * (torch.rand(3000, 3, generator=rng) - 0.5)
    directions = torch.randn(3000, 3, generator=rng) * torch.logspace(-4, 4, 3000)[:, None]
    depths, face_ids, barycentrics = ray_cast(verts, faces, origins.to(device), directions.to(device))
    depth, face, weights, margin = brute_force(*(x.cpu().numpy() for x in (verts, faces, origins, directions)))
    clear = margin > 1e-5  # closer to an edge, float32 may fall on the other side
    hit = clear & (face >= 0)
    assert clear.mean() > 0.95
    assert 0.2 < hit.mean() < 0.95
    np.testing.assert_array_equal(face_ids.cpu().numpy()[clear], face[clear])
    np.testing.assert_allclose(depths.cpu().numpy()[hit], depth[hit], rtol=2e-4)
    np.testing.assert_allclose(barycentrics.cpu().numpy()[hit], weights[hit], atol=2e-4)


def test_rays_through_edges_and_vertices_of_a_closed_mesh_hit(device: torch.device) -> None:
    """Nothing leaks: a ray from the centre to any vertex or edge of a sphere ends there."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    verts = torch.tensor(sphere.vertices, dtype=torch.float32, device=device)
    faces = torch.tensor(sphere.faces, dtype=torch.int32, device=device)
    middles = verts[torch.tensor(sphere.edges_unique, device=device)].mean(1)
    directions = torch.cat([verts, middles])
    depths, face_ids, barycentrics = ray_cast(verts, faces, torch.zeros_like(directions), directions)
    assert (face_ids >= 0).all()
    torch.testing.assert_close(depths, torch.ones_like(depths), rtol=1e-5, atol=0.0)
    assert barycentrics.min() > -1e-4


def test_rays_that_are_none_miss(device: torch.device) -> None:
    verts = torch.tensor([[-9.0, -9, 1], [9, -9, 1], [0, 9, 1]], device=device)
    faces = torch.tensor([[0, 1, 2]], dtype=torch.int32, device=device)
    nan, inf = float("nan"), float("inf")
    directions = torch.tensor([[0.0, 0, 1], [nan, 0, 1], [0, 0, inf], [0, 0, 0], [0, 0, 1], [0, 0, 1]], device=device)
    origins = torch.zeros(6, 3, device=device)
    origins[4, 0], origins[5, 2] = nan, -inf
    depths, face_ids, _ = ray_cast(verts, faces, origins, directions)
    assert face_ids.tolist() == [0, -1, -1, -1, -1, -1]
    assert depths.tolist() == [1.0] + [inf] * 5


def test_an_empty_mesh_and_no_rays(device: torch.device) -> None:
    rays = torch.ones(4, 3, device=device)
    nothing = torch.zeros(0, 3, device=device)
    depths, face_ids, barycentrics = ray_cast(nothing, nothing.int(), rays, rays)
    assert depths.isinf().all()
    assert (face_ids == -1).all()
    assert not barycentrics.any()
    triangle = torch.eye(3, device=device), torch.tensor([[0, 1, 2]], dtype=torch.int32, device=device)
    assert [len(x) for x in ray_cast(*triangle, nothing, nothing)] == [0, 0, 0]


def test_a_moved_mesh_answers_like_a_new_one(device: torch.device, rng: torch.Generator) -> None:
    verts, faces = soup(rng, device)
    rays = torch.randn(500, 3, generator=rng).to(device), torch.randn(500, 3, generator=rng).to(device)
    mesh = RayMesh(verts, faces)
    moved = verts * 1.3 + 0.2
    mesh.move(moved)
    for kept, new in zip(mesh.cast(*rays), ray_cast(moved, faces, *rays), strict=True):
        torch.testing.assert_close(kept, new, rtol=0, atol=0)
    verts.zero_()  # the mesh has its own copy
    torch.testing.assert_close(mesh.cast(*rays)[0], ray_cast(moved, faces, *rays)[0], rtol=0, atol=0)


def test_threads_do_not_change_the_answer(rng: torch.Generator) -> None:
    verts, faces = soup(rng, torch.device("cpu"))
    rays = torch.randn(1001, 3, generator=rng), torch.randn(1001, 3, generator=rng)
    before, results = num_threads(), []
    try:
        for threads in (1, 3):
            set_num_threads(threads)
            results.append(ray_cast(verts, faces, *rays))
    finally:
        set_num_threads(before)
    for one, three in zip(*results, strict=True):
        assert torch.equal(one, three)


def test_camera_rays_end_where_their_pixels_are(device: torch.device) -> None:
    """A point at depth t along a pixel's ray projects onto the pixel's centre and has camera depth t."""
    camera = look_at(np.array([0.4, 0.3, 1.0]), np.array([0.0, 0.0, 0.1]), focal=70.0, width=9, height=7)
    viewmat, K = torch.tensor(camera.viewmat, device=device), torch.tensor(camera.K, device=device)
    origins, directions = camera_rays(viewmat, K, 9, 7)
    points = (origins + 2.5 * directions).double()
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixels = (local @ K.T)[:, :2] / local[:, 2:]
    columns, rows = torch.meshgrid(torch.arange(9) + 0.5, torch.arange(7) + 0.5, indexing="xy")
    expected = torch.stack([columns, rows], -1).reshape(-1, 2).to(pixels)
    torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(local[:, 2], torch.full_like(local[:, 2], 2.5), rtol=1e-6, atol=0)
    corners = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
    _, more = camera_rays(viewmat, K, 9, 7, offsets=corners)
    assert more.shape == (9 * 7 * 2, 3)
    torch.testing.assert_close(more.reshape(-1, 2, 3).mean(1), directions)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f, o, d: (v.double(), f, o, d), "verts must be float32"),
        (lambda v, f, o, d: (v, f.long(), o, d), "faces must be int32"),
        (lambda v, f, o, d: (v, f + 1, o, d), "indices outside 0..2"),
        (lambda v, f, o, d: (v, f - 1, o, d), "indices outside 0..2"),
        (lambda v, f, o, d: (v * torch.nan, f, o, d), "not finite"),
        (lambda v, f, o, d: (v, f, o[:, :2], d), "origins must be float32"),
        (lambda v, f, o, d: (v, f, o, d.double()), "directions must be float32"),
        (lambda v, f, o, d: (v, f, o[:1], d), "1 origins but 2 directions"),
    ],
)
def test_refusals(change, message: str) -> None:
    faces = torch.tensor([[0, 1, 2]], dtype=torch.int32)
    with pytest.raises(ValueError, match=message):
        ray_cast(*change(torch.eye(3), faces, torch.zeros(2, 3), torch.ones(2, 3)))


def test_moving_refuses_another_number_of_vertices() -> None:
    mesh = RayMesh(torch.eye(3), torch.tensor([[0, 1, 2]], dtype=torch.int32))
    with pytest.raises(ValueError, match="the new ones are"):
        mesh.move(torch.eye(3)[:2])
    with pytest.raises(ValueError, match="not finite"):
        mesh.move(torch.eye(3) / 0)


def test_compiles_for_cuda(tmp_path: Path) -> None:
    """The kernels are CUDA kernels too, with or without a GPU here."""
    wp.compile_aot_module(module, arch=80, module_dir=str(tmp_path))
    assert list(tmp_path.rglob("*.sm80.*"))
