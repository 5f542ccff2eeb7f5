"""Jobs of ``mgavatar bench kernels``: each kernel on a stated amount of work, its plain form and its floor.

A plain form computes the same values in the obvious way: one thread per pixel in 16 x 16 tiles for the rasterizer, one
launch per view for several views, torch or kornia for the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import kornia
import torch
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.benchmarks.machine import Machine
from mgavatar.kernels import binding, face_frames, laplacian, lbs, uv_map
from mgavatar.kernels.hash_grid import HashGrid, HashGridShape
from mgavatar.kernels.rasterize import RasterSettings, blend, blend_backward, project, rasterize
from mgavatar.kernels.ssim import compare_images

Step = Callable[[], Callable[[], object]]
"""Function that runs a forward pass and returns the function of its backward pass."""

RASTER_OPERATIONS = (26, 62)
"""Multiply-adds per pixel inside an ellipse, forward and backward, as counted from the formulas."""

SSIM_OPERATIONS = (5 * 22 + 20, 3 * 22 + 20)
"""Multiply-adds per value of the image: a separable window of 11 over five maps forward and three backward."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One row of the table.

    Attributes:
        name: Name of the kernel.
        work: Amount of work, for the table.
        step: One pass of the kernel.
        plain: One pass of its plain form.
        operations: Unavoidable multiply-adds, both directions together.
        bytes: Unavoidable bytes, both directions together.
    """

    name: str
    work: str
    step: Step
    plain: Step
    operations: float = 0.0
    bytes: float = 0.0

    def floor(self, machine: Machine) -> float:
        """Return the least time that the work can take on ``machine`` [s]."""
        return max(self.operations / machine.operations, self.bytes / machine.bytes)


def _autograd(loss: Callable[[], Tensor]) -> Step:
    def step() -> Callable[[], object]:
        return loss().backward

    return step


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@dataclass(frozen=True)
class RasterScene:
    """Gaussians before a camera, as tensors of ``rasterize``."""

    gaussians: tuple[Tensor, ...]
    viewmat: Tensor
    K: Tensor
    size: tuple[int, int]

    def loss(self, settings: RasterSettings) -> Tensor:
        """Draw the scene and return the sum of the squared image."""
        out = rasterize(*self.gaussians, viewmat=self.viewmat, K=self.K, size=self.size, settings=settings)
        return out.image.square().sum()


def head_scene(n: int, size: tuple[int, int], device: torch.device, *, opaque: bool = False) -> RasterScene:
    """Return ``n`` Gaussians on an ellipsoid, seen from 3.6 m; their sizes cover it for every ``n``."""
    g = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    scales = math.sqrt(4 * math.pi * 0.75 / n) * (0.6 + 0.4 * torch.rand(n, 3, generator=g))
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=1)
    opacities = torch.sigmoid(1 + 1.5 * torch.randn(n, generator=g))
    colors = torch.rand(n, 3, generator=g)
    if opaque:
        opacities = torch.ones(n)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.6
    focal = 1.4 * size[1]
    K = torch.tensor([[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]])
    gaussians = (directions * torch.tensor([0.75, 1.0, 0.85]), quats, scales, opacities, colors)
    leaves = tuple(tensor.to(device).requires_grad_() for tensor in gaussians)
    return RasterScene(leaves, viewmat.to(device), K.to(device), size)


def _ellipse_pixels(scene: RasterScene) -> float:
    """Count the pixels inside all ellipses on which alpha reaches the threshold, hidden or not."""
    background = scene.viewmat.new_zeros(3)
    detached = tuple(tensor.detach() for tensor in scene.gaussians)
    splats = project(RasterSettings(), scene.size, (*detached, scene.viewmat, scene.K, background)).splats.double()
    seen = splats[splats[:, 6] > 0]
    return float((math.pi * seen[:, 12] / (seen[:, 4] * seen[:, 6]).sqrt()).sum())


def raster_job(name: str, n: int, size: tuple[int, int], device: torch.device, *, opaque: bool = False) -> Job:
    """Return the rasterizer from projection to image and back."""
    return _scene_job(name, head_scene(n, size, device, opaque=opaque))


def _scene_job(name: str, scene: RasterScene) -> Job:
    return Job(
        name=name,
        work=_work_of(scene),
        step=_autograd(lambda: scene.loss(RasterSettings())),
        plain=_autograd(lambda: scene.loss(RasterSettings(form="plain"))),
        operations=sum(RASTER_OPERATIONS) * _ellipse_pixels(scene),
    )


def _work_of(scene: RasterScene) -> str:
    return f"{len(scene.gaussians[0]) // 1000}K, {scene.size[0]} x {scene.size[1]}"


def avatar_job(path: Path, device: torch.device) -> Job:
    """Return a fitted avatar in its mean pose, seen from the middle one of its training cameras.

    Raises:
        DataError: If ``path`` is not an avatar.
    """
    avatar = Avatar.load(path, device=device)
    camera = avatar.capture.mean_camera()
    gaussians = avatar.gaussians(avatar.mean_pose(), camera)
    leaves = tuple(
        tensor.detach().clone().requires_grad_()
        for tensor in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    )
    viewmat, K = (torch.from_numpy(matrix).to(leaves[0]) for matrix in (camera.viewmat, camera.K))
    return _scene_job("rasterize, fitted avatar", RasterScene(leaves, viewmat, K, (camera.width, camera.height)))


def views_job(n: int, size: tuple[int, int], device: torch.device, *, n_views: int = 4) -> Job:
    """Return several views around the head in one launch; the plain form launches each view."""
    scene = head_scene(n, size, device)
    viewmats = scene.viewmat.repeat(n_views, 1, 1)
    for viewmat, angle in zip(viewmats, torch.linspace(0, 2 * math.pi, n_views + 1)[:-1], strict=True):
        sine, cosine = float(angle.sin()), float(angle.cos())
        viewmat[0, 0], viewmat[0, 2], viewmat[2, 0], viewmat[2, 2] = cosine, sine, -sine, cosine
    view_ids = torch.arange(n_views, dtype=torch.int32, device=device).repeat_interleave(n)
    views = [replace(scene, viewmat=viewmat) for viewmat in viewmats]

    def together() -> Tensor:
        gaussians = [torch.cat([tensor] * n_views) for tensor in scene.gaussians]
        return rasterize(*gaussians, viewmat=viewmats, K=scene.K, size=size, view_ids=view_ids).image.square().sum()

    return Job(
        name="rasterize, several views",
        work=f"{n_views} x {_work_of(scene)}",
        step=_autograd(together),
        plain=_autograd(lambda: torch.stack([view.loss(RasterSettings()) for view in views]).sum()),
        operations=sum(RASTER_OPERATIONS) * sum(_ellipse_pixels(view) for view in views),
    )


def blending_step(n: int, size: tuple[int, int], device: torch.device) -> Step:
    """Return the blending alone, of the same scene, to measure its share of the time."""
    scene = head_scene(n, size, device)
    background = scene.viewmat.new_zeros(3)
    settings = RasterSettings()
    work = project(settings, size, (*(t.detach() for t in scene.gaussians), scene.viewmat, scene.K, background))

    def step() -> Callable[[], object]:
        image, alphas, depths, final_T, last_ids = blend(settings, work, background)
        return lambda: blend_backward(settings, work, background, final_T, last_ids, [image, alphas, depths])

    return step


def lbs_job(device: torch.device, n_verts: int = 20_000, n_dirs: int = 400) -> Job:
    """Return blend shapes and skinning; the floor reads every direction once per pass."""
    template = _random(n_verts, 3).to(device).requires_grad_()
    dirs = _random(n_dirs, n_verts, 3, seed=1).to(device)
    coeffs = _random(n_dirs, seed=2).to(device).requires_grad_()
    weights = torch.softmax(_random(n_verts, 5, seed=3), 1).to(device)
    transforms = torch.eye(4).repeat(5, 1, 1).to(device).requires_grad_()

    def plain() -> Tensor:
        verts = template + torch.einsum("k,kvc->vc", coeffs, dirs)
        blended = torch.einsum("vj,jrc->vrc", weights, transforms[:, :3])
        return ((blended[:, :, :3] @ verts[:, :, None])[:, :, 0] + blended[:, :, 3]).square().sum()

    return Job(
        name="skinning",
        work=f"{n_verts // 1000}K vertices, {n_dirs} directions",
        step=_autograd(lambda: lbs.skin(lbs.blend_shapes(template, dirs, coeffs), weights, transforms).square().sum()),
        plain=_autograd(plain),
        bytes=2 * 4.0 * dirs.numel(),
    )


def _torch_hash(points: Tensor, table: Tensor, levels: list[list[int]]) -> Tensor:
    features = []
    corners = torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3)
    primes = torch.tensor([1, 2654435761, 805459861], device=points.device)
    for resolution, first, n_entries in levels:
        x = points * resolution
        cell = x.floor().clamp(max=resolution - 1)
        part = (x - cell)[:, None]
        vertices = cell.long()[:, None] + corners
        side = resolution + 1
        if side**3 <= n_entries:
            entries = vertices[..., 0] + side * (vertices[..., 1] + side * vertices[..., 2])
        else:
            hashed = vertices * primes % 2**32
            entries = (hashed[..., 0] ^ hashed[..., 1] ^ hashed[..., 2]) % n_entries
        weights = torch.where(corners.bool(), part, 1 - part).prod(2, keepdim=True)
        features.append((weights * table[first + entries]).sum(1))
    return torch.cat(features, 1)


def hash_grid_job(device: torch.device, n: int = 40_000, *, log2_table_size: int = 19) -> Job:
    """Return features of points with an optimizer step.

    The plain form is torch's indexing with its Adam over the whole table.
    """
    grid = HashGrid(HashGridShape(log2_table_size=log2_table_size)).to(device)
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(0)).to(device)
    table = grid.table.detach().clone().requires_grad_()
    levels = grid.shape.table_levels().tolist()
    adam = torch.optim.Adam([table], lr=1e-2, betas=(0.9, 0.99), eps=1e-15)

    def step() -> Callable[[], object]:
        loss = grid(points).square().sum()

        def backward() -> None:
            loss.backward()
            grid.adam_step(1e-2)

        return backward

    def plain() -> Callable[[], object]:
        loss = _torch_hash(points, table, levels).square().sum()

        def backward() -> None:
            adam.zero_grad()
            loss.backward()
            adam.step()

        return backward

    touched = 8.0 * n * grid.n_outputs
    return Job(
        name="hash grid with Adam",
        work=f"{n // 1000}K points, 16 levels x 2",
        step=step,
        plain=plain,
        bytes=3 * 4.0 * touched,
    )


def ssim_job(device: torch.device, side: int = 512) -> Job:
    """Return SSIM and mean absolute error of an RGB image."""
    image = torch.rand(3, side, side, generator=torch.Generator().manual_seed(0)).to(device).requires_grad_()
    target = torch.rand(3, side, side, generator=torch.Generator().manual_seed(1)).to(device)

    def plain() -> Tensor:
        return kornia.losses.ssim_loss(image[None], target[None], 11) + (image - target).abs().mean()

    return Job(
        name="SSIM + L1",
        work=f"{side} x {side} RGB",
        step=_autograd(lambda: compare_images(image, target).sum()),
        plain=_autograd(plain),
        operations=float(sum(SSIM_OPERATIONS) * image.numel()),
    )


def _sheet(rows: int, columns: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions, faces and UV of a curved sheet of (rows + 1)(columns + 1) vertices."""
    v, u = torch.meshgrid(torch.linspace(0, 1, rows + 1), torch.linspace(0, 1, columns + 1), indexing="ij")
    uv = torch.stack([u, v], 2).reshape(-1, 2)
    verts = torch.cat([uv, 0.1 * torch.sin(7 * uv.sum(1, keepdim=True))], 1)
    index = torch.arange(len(uv)).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = torch.stack([a, b, c, a, c, d], 2).reshape(-1, 3).int()
    return verts, faces, uv


def mesh_jobs(device: torch.device) -> Iterator[Job]:
    """Yield Laplacian, binding and UV map on a sheet of 20K vertices and 40K faces."""
    points, faces, uv = (tensor.to(device) for tensor in _sheet(100, 200))
    verts = points.requires_grad_()
    n_verts = len(verts)
    matrix = laplacian.laplacian_matrix(faces, n_verts)
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).long()
    edges = torch.unique(torch.cat([edges, edges.flip(1)]), dim=0)
    degree = torch.bincount(edges[:, 0], minlength=n_verts)[:, None]

    def plain_laplacian() -> Tensor:
        sums = torch.zeros_like(verts).index_add(0, edges[:, 0], verts[edges[:, 1]])
        return (verts - sums / degree).square().sum()

    yield Job(
        name="Laplacian",
        work=f"{n_verts // 1000}K vertices",
        step=_autograd(lambda: laplacian.laplacian(matrix, verts).square().sum()),
        plain=_autograd(plain_laplacian),
        bytes=2 * (8.0 * len(edges) + 24.0 * n_verts),
    )
    yield from _binding_jobs(verts, faces)
    yield _uv_job(verts, faces, uv)


def _sum_of_squares(*tensors: Tensor) -> Tensor:
    return torch.stack([tensor.square().sum() for tensor in tensors]).sum()


def _binding_jobs(verts: Tensor, faces: Tensor) -> Iterator[Job]:
    """Yield frames of the faces and Gaussians bound to them; on a frozen mesh only the second needs its adjoint."""
    n = len(faces)
    index = faces.long()
    order = face_frames.gather_matrix(faces, len(verts))
    face_ids = torch.arange(n, device=verts.device)
    shapes = ((n, 3), (n, 4), (n, 3), (n,))
    local = [_random(*shape, seed=seed).to(verts.device).requires_grad_() for seed, shape in enumerate(shapes)]

    def plain_frames() -> tuple[Tensor, Tensor, Tensor]:
        a, b, c = verts[index].unbind(1)
        edge = torch.nn.functional.normalize(b - a, dim=1)
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
        third = torch.linalg.cross(edge, normal)
        k = ((b - a).norm(dim=1) + ((c - a) * third).sum(1).abs()) / 2
        R = torch.stack([edge, normal, third], 2)
        return kornia.geometry.conversions.rotation_matrix_to_quaternion(R), k, (a + b + c) / 3

    def plain_binding() -> tuple[Tensor, ...]:
        q, k, center = frames[0][face_ids], frames[1][face_ids, None], frames[2][face_ids]
        local_means, local_quats, log_scales, logits = local
        R = kornia.geometry.conversions.quaternion_to_rotation_matrix(q)
        w, x, y, z = q.unbind(1)
        left = torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w], 1).reshape(-1, 4, 4)
        quats = (left @ local_quats[:, :, None])[:, :, 0]
        means = k * (R @ local_means[:, :, None])[:, :, 0] + center
        return means, quats, k * torch.exp(log_scales), torch.sigmoid(logits)

    with torch.no_grad():
        frames = face_frames.face_frames(verts, faces, order=order)
    yield Job(
        name="face frames",
        work=f"{n // 1000}K faces",
        step=_autograd(lambda: _sum_of_squares(*face_frames.face_frames(verts, faces, order=order))),
        plain=_autograd(lambda: _sum_of_squares(*plain_frames())),
        bytes=2 * 4.0 * n * (9 + 8),
    )
    yield Job(
        name="binding",
        work=f"{n // 1000}K Gaussians",
        step=_autograd(lambda: _sum_of_squares(*binding.bind_to_faces(frames, face_ids, *local)[:4])),
        plain=_autograd(lambda: _sum_of_squares(*plain_binding())),
        bytes=2 * (8.0 + 4.0 * (8 + 11 + 11)) * n,
    )


def _uv_job(verts: Tensor, faces: Tensor, uv: Tensor, side: int = 256) -> Job:
    drawn = uv_map.uv_map(uv, faces, faces, len(verts), side, side)
    covered = drawn.face_ids.reshape(-1).long()
    corners = faces.long()[covered.clamp(min=0)]
    rows, columns = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    places = torch.stack([(columns + 0.5) / side, 1 - (rows + 0.5) / side], 2).reshape(-1, 2).to(uv)
    a, b, c = uv[corners].unbind(1)
    bary = torch.linalg.solve(torch.stack([b - a, c - a], 2), (places - a)[:, :, None])[:, :, 0]
    weights = torch.cat([1 - bary.sum(1, keepdim=True), bary], 1) * (covered >= 0)[:, None]

    def plain() -> Tensor:
        return (weights[:, :, None] * verts[corners]).sum(1).T.reshape(3, side, side).square().sum()

    return Job(
        name="UV position map",
        work=f"{side} x {side}",
        step=_autograd(lambda: uv_map.position_map(drawn, verts).square().sum()),
        plain=_autograd(plain),
        bytes=2 * 4.0 * side * side * (3 + 6),
    )


def jobs(device: torch.device, avatar: Path | None = None) -> Iterator[Job]:
    """Yield the rows of the table one at a time; ``avatar`` is the file of a fitted avatar to add."""
    yield raster_job("rasterize", 20_000, (512, 512), device)
    yield raster_job("rasterize", 100_000, (802, 550), device)
    yield raster_job("rasterize, opaque", 20_000, (512, 512), device, opaque=True)
    yield views_job(20_000, (256, 256), device)
    if avatar is not None:
        yield avatar_job(avatar, device)
    yield lbs_job(device)
    yield hash_grid_job(device)
    yield ssim_job(device)
    yield from mesh_jobs(device)
