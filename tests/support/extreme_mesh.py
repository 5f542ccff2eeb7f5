"""The mesh kernels' rows of the table of extremes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from extreme_cases import Case
from torch import Tensor
from twins import mesh as twins

from mgavatar.kernels.binding import bind_to_faces
from mgavatar.kernels.face_frames import face_frames
from mgavatar.kernels.hash_encode import hash_encode
from mgavatar.kernels.hash_grid import HashGridShape
from mgavatar.kernels.laplacian import laplacian, laplacian_matrix
from mgavatar.kernels.lbs import blend_shapes, joint_transforms, skin
from mgavatar.kernels.sparse import SparseMatrix, sparse_apply
from mgavatar.kernels.uv_map import position_map, sample_map, uv_map

FAN = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
"""Four faces about a vertex."""

PARENTS = [-1, 0, 1, 1, 1]


def _fixed(*tensors: Any) -> Callable[[torch.Generator], tuple[Tensor, ...]]:
    return lambda _: tuple(torch.as_tensor(t, dtype=torch.float64).clone() for t in tensors)


def _normal(*shapes: tuple[int, ...], factors: tuple[float, ...] | None = None) -> Any:
    scales = factors or (1.0,) * len(shapes)
    return lambda g: tuple(
        f * torch.randn(s, generator=g, dtype=torch.float64) for s, f in zip(shapes, scales, strict=True)
    )


def _fan(*, at: float = 0.0, size: float = 1.0, height: float = 0.3) -> Tensor:
    """Vertices of the fan: four rim points and a raised centre."""
    verts = torch.tensor(
        [[0.1, 0.05, height], [1, 0, 0], [0, 0.9, 0.1], [-1.1, 0, 0], [0, -1, 0.05]], dtype=torch.float64
    )
    return size * verts + at


def frames_as_matrices(verts: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The kernel's frames with their rotation as a matrix, which has no sign to choose."""
    quats, scales, centers = face_frames(verts, faces)
    return twins.quat_matrix(quats), scales, centers


def _frames(name: str, verts: Tensor, faces: Tensor = FAN, **expect: Any) -> Case:
    return Case(
        kernel="face_frames",
        name=name,
        inputs=_fixed(verts),
        op=lambda v: frames_as_matrices(v, faces),
        twin=lambda v: twins.face_frames(v, faces),
        **expect,
    )


def _collapsed(name: str, verts: Tensor) -> Case:
    """A face without an area: what the frame keeps agrees (scale, centre), what it replaces is a rotation."""

    def kept(v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        quats, scales, centers = face_frames(v, FAN[:1])
        return quats.square().sum(1), scales, centers

    def twin(v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        a, b, c = v[FAN[:1]].unbind(1)
        edge = torch.linalg.vector_norm(b - a, dim=1) if bool((b != a).any()) else torch.full((1,), 2e-8, dtype=v.dtype)
        return torch.ones(1, dtype=v.dtype) + 0 * v.sum(), edge / 2, (a + b + c) / 3

    return Case(kernel="face_frames", name=name, inputs=_fixed(verts), op=kept, twin=twin, floor=1e-3)


def _joints(name: str, angle: float, **expect: Any) -> Case:
    def inputs(g: torch.Generator) -> tuple[Tensor, ...]:
        axes = torch.nn.functional.normalize(torch.randn(5, 3, generator=g, dtype=torch.float64), dim=1)
        return 0.2 * torch.randn(5, 3, generator=g, dtype=torch.float64), angle * axes

    def op(joints: Tensor, poses: Tensor) -> Any:
        return joint_transforms(joints, poses, torch.tensor(PARENTS))

    def twin(joints: Tensor, poses: Tensor) -> Any:
        return twins.joint_transforms(joints, poses, PARENTS)

    return Case(kernel="joint_transforms", name=name, inputs=inputs, op=op, twin=twin, **expect)


def _skin(name: str, weights: Callable[[Tensor], Tensor], factor: float = 1.0) -> Case:
    g = torch.Generator().manual_seed(4)
    w = weights(torch.rand(40, 5, generator=g, dtype=torch.float64)).float().double()
    bottom = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(5, 1, 4)

    def inputs(g: torch.Generator) -> tuple[Tensor, ...]:
        top = torch.randn(5, 3, 4, generator=g, dtype=torch.float64)
        return factor * torch.randn(40, 3, generator=g, dtype=torch.float64), top

    def op(verts: Tensor, top: Tensor) -> Tensor:
        return skin(verts, w.to(verts), torch.cat([top, bottom.to(top)], 1))

    def twin(verts: Tensor, top: Tensor) -> Tensor:
        return twins.skin(verts, w, torch.cat([top, bottom], 1))

    return Case(kernel="skin", name=name, inputs=inputs, op=op, twin=twin)


def _blend(name: str, factor: float) -> Case:
    dirs = torch.randn(7, 50, 3, generator=torch.Generator().manual_seed(4))

    def op(template: Tensor, coeffs: Tensor) -> Tensor:
        return blend_shapes(template, dirs.to(template), coeffs)

    def twin(template: Tensor, coeffs: Tensor) -> Tensor:
        return twins.blend_shapes(template, dirs.double(), coeffs)

    inputs = _normal((50, 3), (7,), factors=(1.0, factor))
    return Case(kernel="blend_shapes", name=name, inputs=inputs, op=op, twin=twin)


def _laplacian(name: str, faces: Tensor, n: int, factor: float = 1.0, offset: float = 0.0, **expect: Any) -> Case:
    matrix = laplacian_matrix(faces, n)

    def inputs(g: torch.Generator) -> tuple[Tensor, ...]:
        return (factor * torch.randn(n, 3, generator=g, dtype=torch.float64) + offset,)

    def twin(x: Tensor) -> Tensor:
        return twins.laplacian(faces, x)

    return Case(kernel="laplacian", name=name, inputs=inputs, op=lambda x: laplacian(matrix, x), twin=twin, **expect)


def _position_map(name: str, vt: list[list[float]], ft: list[list[int]], factor: float = 1.0) -> Case:
    places, corners = torch.tensor(vt, dtype=torch.float64), torch.tensor(ft)
    n = len(places)
    uv = uv_map(places, corners, corners, n, 9, 7)

    def twin(verts: Tensor) -> Tensor:
        ids, weights = twins.uv_cover(places, corners, 9, 7)
        drawn = torch.einsum("hwk,hwkc->chw", weights, verts[corners[ids.long()]])
        return torch.where(ids >= 0, drawn, 0.0)

    inputs = _normal((n, 3), factors=(factor,))
    return Case(kernel="position_map", name=name, inputs=inputs, op=lambda v: position_map(uv, v), twin=twin)


def _sample(name: str, places: list[list[float]], size: tuple[int, int] = (5, 4), factor: float = 1.0) -> Case:
    uv = torch.tensor(places, dtype=torch.float64)
    inputs = _normal((3, *size), factors=(factor,))

    def twin(maps: Tensor) -> Tensor:
        return twins.sample_map(maps, uv)

    return Case(kernel="sample_map", name=name, inputs=inputs, op=lambda m: sample_map(m, uv.to(m)), twin=twin)


def _hash(
    name: str, points: list[list[float]] | float, shape: HashGridShape | None = None, factor: float = 1.0
) -> Case:
    shape = shape or HashGridShape(levels=4, base_resolution=4, max_resolution=60, log2_table_size=9)
    levels = shape.table_levels()
    n_entries = int((levels[-1, 1] + levels[-1, 2] + 63) // 64 * 64)

    def inputs(g: torch.Generator) -> tuple[Tensor, ...]:
        table = factor * torch.randn(n_entries, 2, generator=g, dtype=torch.float64)
        if isinstance(points, float):
            return points * torch.rand(30, 3, generator=g, dtype=torch.float64), table
        return torch.tensor(points, dtype=torch.float64), table

    def op(x: Tensor, table: Tensor) -> Tensor:
        return hash_encode(x, table, levels)

    def twin(x: Tensor, table: Tensor) -> Tensor:
        return twins.hash_encode(x, table, levels)

    return Case(kernel="hash_encode", name=name, inputs=inputs, op=op, twin=twin)


def _bound(name: str, *, factors: dict[str, float] | None = None, log_scale: float = 0.0, logit: float = 0.0) -> Case:
    """Twenty Gaussians on seven faces; ``log_scale`` is added to all, ``logit`` to every other one and off the rest."""
    shapes = {"face_quats": (7, 4), "face_scales": (7,), "face_centers": (7, 3)}
    shapes |= {"means": (20, 3), "quats": (20, 4), "log_scales": (20, 3), "logits": (20,), "offsets": (20, 13)}
    scales = {"log_scales": 0.5, "offsets": 0.3} | (factors or {})
    face_ids = torch.arange(20) % 7
    signs = torch.tensor([1.0, -1.0], dtype=torch.float64).repeat(10)

    def inputs(g: torch.Generator) -> tuple[Tensor, ...]:
        draw = _normal(*shapes.values(), factors=tuple(scales.get(key, 1.0) for key in shapes))
        *others, log_scales, logits, offsets = draw(g)
        return *others, log_scales + log_scale, logits + logit * signs, offsets

    def op(q: Tensor, k: Tensor, t: Tensor, *local: Tensor) -> Any:
        return bind_to_faces((q, k, t), face_ids, *local[:4], offsets=local[4])

    def twin(q: Tensor, k: Tensor, t: Tensor, *local: Tensor) -> Any:
        return twins.bind_to_faces(q, k, t, face_ids, *local)

    def of_unit(op: Callable[..., Any]) -> Callable[..., Any]:
        """Faces have unit quaternions: what happens off the sphere is not asked."""
        return lambda q, *rest: op(q / q.norm(dim=1, keepdim=True), *rest)

    return Case(kernel="bind_to_faces", name=name, inputs=inputs, op=of_unit(op), twin=of_unit(twin))


def _sparse_too_large(_x: Tensor) -> Tensor:
    matrix = SparseMatrix.from_coo(torch.zeros(1).long(), torch.zeros(1).long(), torch.ones(1), (2**31, 1))
    return sparse_apply(matrix, _x)


def _binding_cases() -> list[Case]:
    fan = _fan()
    flipped = FAN.clone()
    flipped[0] = flipped[0].flip(0)
    coincident, point = fan.clone(), fan.clone()
    coincident[2] = coincident[1]
    point[:3] = point[0]
    line = fan.clone()
    line[:3] = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.3, 0, 0]], dtype=torch.float64)
    needle = fan.clone()
    needle[:3] = torch.tensor([[0.0, 0, 0], [1, 0.5, 0], [0.5, 0.251, 0]], dtype=torch.float64)
    return [
        _frames("a face flipped inside out", fan, flipped),
        _frames("needle, height 1e-3 of its length", needle, gradient=1e-4),
        _frames("coordinates of 1e6 m", _fan(size=1e6)),
        _frames("faces of 1e-4 m", _fan(size=1e-4)),
        _frames("faces of 1 m at 1000 m", _fan(at=1000.0), gradient=1e-5),
        _collapsed("zero area, three points on a line", line),
        _collapsed("two coincident vertices", coincident),
        _collapsed("three coincident vertices", point),
        _bound("scales 1e6", factors={"face_scales": 1e6}, log_scale=math.log(1e6)),
        _bound("centres at 1e6 m", factors={"face_centers": 1e6}),
        _bound("scales 0", factors={"face_scales": 0.0}, log_scale=-math.inf),
        _bound("quaternions of length 1e-10", factors={"quats": 1e-10}),
        _bound("log-scales of 80", log_scale=80.0, factors={"offsets": 0.0}),
        _bound("log-scales of -200", log_scale=-200.0),
        _bound("logits of 200 and -200", logit=200.0),
    ]


def _skinning_cases() -> list[Case]:
    return [
        _joints("rotation 0", 0.0),
        _joints("rotation 1e-20", 1e-20),
        _joints("rotation 1e-4", 1e-4, double=(1e-11, 1e-9)),
        _joints("rotation pi - 1e-7", math.pi - 1e-7),
        _joints("rotation pi + 1e-7", math.pi + 1e-7),
        _joints("rotation 2 pi", 2 * math.pi, floor=1e-3, double=(1e-11, 1e-9)),
        _joints("rotation 1e4", 1e4, double=(1e-10, 1e-9)),
        _skin("weights that sum to 1", lambda w: w / w.sum(1, keepdim=True)),
        _skin("weights that sum to 3", lambda w: 3 * w / w.sum(1, keepdim=True)),
        _skin("weights 0", lambda w: 0 * w),
        _skin("negative weights", lambda w: w - 0.5),
        _skin("coordinates of 1e6 m", lambda w: w, 1e6),
        _blend("coefficients 0", 0.0),
        _blend("coefficients 1e6", 1e6),
        _blend("coefficients 1e-20", 1e-20),
    ]


def _mesh_cases() -> list[Case]:
    doubled = torch.cat([FAN, FAN])
    strip = torch.stack([torch.arange(300), torch.arange(300) + 1, torch.arange(300) + 2], 1)
    return [
        _laplacian("isolated vertices", FAN, 9),
        _laplacian("no faces", FAN[:0], 4),
        _laplacian("every face twice", doubled, 5),
        _laplacian("a face with two equal corners", torch.cat([FAN, torch.tensor([[1, 1, 2]])]), 5),
        _laplacian("a vertex with 300 neighbours", torch.cat([strip[:, :2], torch.full((300, 1), 301)], 1), 302),
        _laplacian("coordinates of 1e6 m", strip, 302, 1e6),
        _laplacian("1 m at 1000 m", strip, 302, 1.0, 1000.0, forward=3e-5),
        Case(
            kernel="sparse_apply",
            name="more than 2^31 entries",
            inputs=_normal((1, 3)),
            op=_sparse_too_large,
            expect="refused",
            message="does not fit 32-bit indices",
        ),
    ]


def _map_cases() -> list[Case]:
    square, two = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], [[0, 1, 2], [0, 2, 3]]
    return [
        _position_map("UV on the border", square, two),
        _position_map("UV outside the unit square", [[-1.1, -0.7], [2.3, -0.6], [0.4, 2.9]], [[0, 1, 2]]),
        _position_map("a face without an area in UV", [[0.125, 0.125], [0.5, 0.5], [0.875, 0.875]], [[0, 1, 2]]),
        _position_map("a mirrored face", [[0.1, 0.1], [0.2, 0.95], [0.93, 0.15]], [[0, 1, 2]]),
        _position_map("positions of 1e6 m", square, two, 1e6),
        _sample("UV on the border", [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0], [1.0, 0.0], [0.5, 1.0]]),
        _sample("UV outside the unit square", [[-3.0, 0.5], [7.0, 0.25], [0.5, -1e6], [1e6, 1e6]]),
        _sample("a map of one texel", [[0.3, 0.9], [-1.0, 2.0]], (1, 1)),
        _sample("values of 1e6", [[0.31, 0.72], [0.91, 0.13]], factor=1e6),
    ]


def _hash_cases() -> list[Case]:
    fine = HashGridShape(levels=2, base_resolution=4096, max_resolution=2**20, log2_table_size=9)
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3).tolist()
    return [
        _hash("on the box's lower corner", [[0.0, 0.0, 0.0]]),
        _hash("outside the box", [[-5.0, 0.3, 0.4], [0.2, 1e6, 0.4], [-1e6, 7.0, 1e20]]),
        _hash("just inside the box", [[0.99999, 0.3, 0.4], [0.2, 1e-20, 0.9999]]),
        _hash("everywhere in the box", 1.0),
        _hash("values of 1e6", 1.0, factor=1e6),
        _hash("all at one point", [[0.37, 0.61, 0.27]] * 500),
        _hash("2^20 cells a side", [[0.3125 + 2**-22, 0.71875, 0.40625 + 2**-23]], fine),
        _hash("outside, on the corners", [[3 * a - 1, 3 * b - 1, 3 * c - 1] for a, b, c in corners]),
    ]


def cases() -> list[Case]:
    """All rows."""
    return [*_binding_cases(), *_skinning_cases(), *_mesh_cases(), *_map_cases(), *_hash_cases()]
