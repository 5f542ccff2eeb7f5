"""The mesh of the procedural head: points on a sheet, triangles, one texture atlas.

The skin is a sheet with coordinates (p, q): p runs around the head, q down its length, both about in metres. Rings of
points follow the lids, the lips and the ear; between them, points of graded density are relaxed and triangulated.
Only the left half is made; :func:`build_mesh` mirrors it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial import Delaunay, cKDTree

from mgavatar.head import procedural_surface as form
from mgavatar.head.procedural_ear import ear_rings
from mgavatar.head.procedural_parts import eyeball_half, socket_rings, teeth_half

AROUND = 0.070
"""Sheet metres per radian around the head."""
P_BACK = np.pi * AROUND
N_LID, N_LIP, N_EAR = 30, 21, 28
GUTTER = 0.006
RED_RINGS = (1.0, 0.74, 0.48, 0.24, 0.07, 0.0)
"""Where the rings of the red of the lips lie between its border and the opening."""

Array = np.ndarray


@lru_cache(maxsize=1)
def _levels() -> tuple[PchipInterpolator, PchipInterpolator, float, float]:
    """q of a level, level of a q, q of the cap's edge and of the rim; q is 0 at the crown and falls."""
    level = np.linspace(0.0, form.N_LEVELS - 1.0, 721)
    angles = np.linspace(0.0, np.pi, 9)
    paths = np.stack([form.base(np.full_like(level, a), level) for a in angles])
    steps = np.linalg.norm(np.diff(paths, axis=1), axis=-1)
    q = -np.concatenate([[0.0], np.cumsum(0.6 * steps[:5].mean(axis=0) + 0.4 * steps.mean(axis=0))])
    to_q = PchipInterpolator(level, q)
    return to_q, PchipInterpolator(q[::-1], level[::-1]), float(to_q(form.CAP_LEVEL)), float(q[-1])


def sheet_to_angles(sheet: Array) -> tuple[Array, Array]:
    """Angle and level of points (p, q) of the sheet."""
    return sheet[..., 0] / AROUND, _levels()[1](sheet[..., 1])


def front_to_sheet(xy: Array) -> Array:
    """Points of the sheet that lie under these x and y of the face [m]."""
    angle, level = form.invert_front(xy[..., 0], xy[..., 1])
    return np.stack([angle * AROUND, _levels()[0](level)], axis=-1)


def skin(sheet: Array) -> Array:
    """Points of the skin [m] at points (p, q) of the sheet."""
    return form.surface(*sheet_to_angles(sheet))


def spacing(points: Array) -> Array:
    """Wanted distance between neighbours [m] at points of the featureless head."""
    x, y, z = np.abs(points[..., 0]), points[..., 1], points[..., 2]
    face = np.hypot(np.hypot(x / 1.0, (y + 0.018) / 1.25), np.minimum(z - 0.035, 0.0) / 0.9)
    coarse = 0.0039 + 0.0064 * form.smoothstep(0.035, 0.115, face)
    nose = np.exp(-((x / 0.016) ** 2) - ((y + 0.013) / 0.021) ** 2)
    chin = np.exp(-((x / 0.040) ** 2) - ((y + 0.092) / 0.014) ** 2) * (z > 0.0)
    return coarse * (1.0 - 0.55 * nose - 0.25 * chin)


@dataclass
class HalfMesh:
    """The left half while it is put together; every list holds one array per piece that was added."""

    verts: list[Array] = field(default_factory=list)
    sheet: list[Array] = field(default_factory=list)
    part: list[Array] = field(default_factory=list)
    vt: list[Array] = field(default_factory=list)
    vt_axis: list[Array] = field(default_factory=list)
    faces: list[Array] = field(default_factory=list)
    face_vt: list[Array] = field(default_factory=list)
    groups: dict[str, Array] = field(default_factory=dict)
    n_verts: int = 0
    n_vt: int = 0

    def add_points(self, verts: Array, *, part: str, sheet: Array | None = None) -> Array:
        """Add vertices; returns their ids."""
        n = len(verts)
        self.verts.append(verts)
        self.sheet.append(np.full((n, 2), np.nan) if sheet is None else sheet)
        self.part.append(np.full(n, part))
        self.n_verts += n
        return np.arange(self.n_verts - n, self.n_verts)

    def add_vt(self, vt: Array, *, axis: float) -> Array:
        """Add texture coordinates that are mirrored about u = ``axis``; returns their ids."""
        self.vt.append(vt)
        self.vt_axis.append(np.full(len(vt), axis))
        self.n_vt += len(vt)
        return np.arange(self.n_vt - len(vt), self.n_vt)

    def add_faces(self, local: Array, vertex_ids: Array, vt_ids: Array) -> None:
        """Add triangles that index into ``vertex_ids`` and ``vt_ids`` alike."""
        self.faces.append(vertex_ids[local])
        self.face_vt.append(vt_ids[local])


@dataclass(frozen=True)
class HeadMesh:
    """The whole mesh and what the rig needs to know about it.

    Attributes:
        verts: [V, 3] [m].
        faces: [F, 3].
        vt: [U, 2].
        ft: [F, 3].
        part: Name of the part of each vertex: ``skin``, ``socket``, ``eye``, ``upper_teeth``, ``lower_teeth``, [V].
        rest: Where the vertex is on the featureless head, its mouth open [m]; NaN off the skin, [V, 3].
        level: Level of the section, NaN off the skin, [V].
        mirror: Index of the mirrored vertex, [V].
        groups: Ids of rings and regions of the left half, e.g. ``lid_0`` for the edge of the lids.
    """

    verts: Array
    faces: Array
    vt: Array
    ft: Array
    part: Array
    rest: Array
    level: Array
    mirror: Array
    groups: dict[str, Array]


def strip(outer: Array, inner: Array, *, closed: bool) -> Array:
    """Triangles between two rings of equal length that run counter-clockwise, the outer one first."""
    n = len(outer)
    i = np.arange(n if closed else n - 1)
    j = (i + 1) % n
    a, b, c, d = outer[i], outer[j], inner[j], inner[i]
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def ring_stack(rings: list[Array], *, closed: bool) -> Array:
    """Triangles of a stack of rings, given as local ids from outside to inside."""
    return np.concatenate([strip(a, b, closed=closed) for a, b in zip(rings[:-1], rings[1:], strict=True)])


def _lid_rings() -> list[Array]:
    """Rings around the left eye on the sheet, from the socket to the edge of the lids."""
    t = np.linspace(0.0, 2 * np.pi, N_LID, endpoint=False)
    c, s = np.cos(t), np.sin(t)
    tilt = 0.0012 * c
    edge_height = np.where(s > 0, 0.0054, 0.0042) * np.abs(s) ** 1.12 * np.sign(s) * (1.0 - 0.12 * c)
    edge = np.stack([form.EYE[0] - 0.0006 + 0.0145 * c, form.EYE[1] + edge_height + tilt], axis=1)
    outer = np.stack([form.EYE[0] + 0.0005 + 0.0198 * c, form.EYE[1] + 0.0010 + 0.0158 * s], axis=1)
    return [edge + f * (outer - edge) for f in (1.0, 0.74, 0.50, 0.29, 0.12, 0.0)]


def _lip_border(t: Array) -> Array:
    """The edge of the lips' red on the sheet: a half ring at the angles ``t``."""
    x = (form.MOUTH_HALF_WIDTH + 0.0024) * np.cos(t)
    red = form.lip_height(np.minimum(x, form.MOUTH_HALF_WIDTH + 0.0014), upper=np.sin(t) > 0)
    opening = form.mouth_opening(x)
    distance = red + opening
    for _ in range(20):  # the fixed point of the squeeze that closes the sheet's mouth
        distance = red + opening * (1.0 - form.smoothstep(opening, form.MOUTH_BLEND, distance))
    distance *= np.abs(np.sin(t)) > 1e-9
    return np.stack([x, form.MOUTH_Y + np.sign(np.sin(t)) * distance], axis=1)


def _lip_rings() -> list[Array]:
    """Half rings around the mouth on the sheet, counter-clockwise, from the cheek over the border to the opening."""
    t = np.linspace(-np.pi / 2, np.pi / 2, N_LIP)
    t[N_LIP // 2] = 0.0
    c, s = np.cos(t), np.sin(t)
    c[[0, -1]] = 0.0
    x = form.MOUTH_HALF_WIDTH * c
    hole = np.stack([x, form.MOUTH_Y + np.sign(s) * form.mouth_opening(x)], axis=1)
    outer = np.stack([0.0365 * c, form.MOUTH_Y - 0.0010 + 0.0180 * s], axis=1)
    border = _lip_border(t)
    around = [border + f * (outer - border) for f in (1.0, 0.62, 0.28)]
    return around + [hole + f * (border - hole) for f in RED_RINGS]


def _line(start: Array, end: Array) -> Array:
    """Points between two ends of the sheet, spaced as :func:`spacing` asks, without the ends."""
    fine = start + np.linspace(0.0, 1.0, 2001)[:, None] * (end - start)
    wanted = spacing(form.base(*sheet_to_angles(fine)))
    count = np.concatenate([[0.0], np.cumsum(np.linalg.norm(end - start) / 2000 / wanted[1:])])
    n = max(1, round(count[-1]))
    at = np.interp(np.arange(1, n) * count[-1] / n, count, np.linspace(0.0, 1.0, 2001))
    return start + at[:, None] * (end - start)


def _inside(points: Array, polygon: Array) -> Array:
    """Whether points lie inside a closed polygon (even-odd rule)."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = points[:, 0, None], points[:, 1, None]
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
    return (crosses & (x < a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0]))).sum(axis=1) % 2 == 1


def _encroaches(points: Array, polygon: Array) -> Array:
    """Whether points are so close to an edge of a polygon that Delaunay triangles would break it."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    distance = np.linalg.norm(points[:, None] - (a + b) / 2, axis=-1)
    return np.any(distance < 0.55 * np.linalg.norm(b - a, axis=1) * (np.linalg.norm(b - a, axis=1) < 0.012), axis=1)


def _scatter(candidates: Array, wanted: Array, fixed: Array) -> Array:
    """Points of ``candidates`` that keep their ``wanted`` distance from each other and from ``fixed``."""
    tree = cKDTree(candidates)
    alive = cKDTree(fixed).query(candidates)[0] > 0.75 * wanted
    kept = []
    for i in range(len(candidates)):
        if alive[i]:
            kept.append(i)
            alive[tree.query_ball_point(candidates[i], wanted[i] * 0.92)] = False
    return candidates[kept]


def _fill(fixed: Array, holes: list[Array], candidates: Array, embed: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Points and triangles that fill a convex region of a plane around holes.

    Args:
        fixed: Points on the outline and on the holes' outlines, [N, 2].
        holes: Closed outlines, [M, 2] each.
        candidates: Points that may be used, [C, 2].
        embed: Maps points of the plane to space, for spacing and evenness.

    Returns:
        All points, the fixed ones first, [P, 2]; counter-clockwise triangles, [F, 3].
    """
    def in_hole(at: Array) -> Array:
        return np.any([np.zeros(len(at), bool), *(_inside(at, hole) | _encroaches(at, hole) for hole in holes)], axis=0)

    candidates = candidates[~in_hole(candidates)]
    points = np.concatenate([fixed, _scatter(candidates, spacing(embed(candidates)), fixed)])
    n = len(fixed)
    outline = cKDTree(fixed)
    for _ in range(12):
        moved = points + 0.6 * (_even_out(points, embed(points)) - points)
        near = outline.query(moved)[0] < 0.6 * spacing(embed(moved))
        free = ~near & ~in_hole(moved) & (np.arange(len(points)) >= n)
        points[free] = moved[free]
    triangles = Delaunay(points).simplices
    centres = points[triangles].mean(axis=1)
    triangles = triangles[~np.any([np.zeros(len(centres), bool), *(_inside(centres, hole) for hole in holes)], axis=0)]
    ab, ac = points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    triangles[area < 0] = triangles[area < 0][:, ::-1]
    return points, triangles[np.abs(area) > 1e-12]


def _even_out(points: Array, embedded: Array) -> Array:
    """Neighbours' mean in the plane, longer edges pulling harder."""
    simplices = Delaunay(points).simplices
    i, j = simplices[:, [0, 1, 2, 1, 2, 0]].ravel(), simplices[:, [1, 2, 0, 0, 1, 2]].ravel()
    weight = np.linalg.norm(embedded[i] - embedded[j], axis=1) / np.maximum(np.linalg.norm(points[i] - points[j], axis=1), 1e-9)
    total = np.bincount(i, weight, len(points))
    return np.stack([np.bincount(i, weight * points[j, k], len(points)) / total for k in (0, 1)], axis=1)


def _hexagons(low: Array, high: Array, pitch: float) -> Array:
    """A lattice of points strictly inside a box."""
    x = np.arange(low[0] + pitch, high[0] - 0.5 * pitch, pitch)
    y = np.arange(low[1] + pitch, high[1] - 0.5 * pitch, pitch * 0.8660254)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    grid[1::2, :, 0] += 0.5 * pitch
    return grid.reshape(-1, 2)


def _main_uv(sheet: Array) -> Array:
    """Texture coordinates of the sheet: the face is enlarged at the cost of the back and the neck."""
    _, _, q_cap, q_rim = _levels()
    a = np.linspace(0.0, 1.0, 200)
    wide = np.cumsum(0.42 + 0.58 * (1.0 - form.smoothstep(0.28, 0.62, a)))
    u = np.interp(sheet[:, 0] / P_BACK, a, (wide - wide[0]) / (wide[-1] - wide[0]))
    q = np.linspace(q_rim, q_cap, 400)
    y = form.base(np.full_like(q, 0.4), sheet_to_angles(np.stack([np.zeros_like(q), q], 1))[1])[:, 1]
    tall = np.cumsum(0.45 + 0.55 * form.smoothstep(-0.12, -0.085, y) * (1.0 - form.smoothstep(0.06, 0.085, y)))
    v = np.interp(sheet[:, 1], q, (tall - tall[0]) / (tall[-1] - tall[0]))
    return np.stack([0.5 + (0.5 - GUTTER) * u, 0.29 + (0.71 - GUTTER) * v], axis=1)


def _add_skin(half: HalfMesh) -> None:
    _, _, q_cap, q_rim = _levels()
    lids, lips = ([front_to_sheet(r) for r in rings] for rings in (_lid_rings(), _lip_rings()))
    lips = [np.where(np.isin(np.arange(N_LIP), (0, N_LIP - 1))[:, None], r * [0.0, 1.0], r) for r in lips]
    ear_sheet, ear_verts = ear_rings(skin, n=N_EAR, around=AROUND, q_of_level=_levels()[0])
    corners = np.array([[0.0, q_rim], [P_BACK, q_rim], [P_BACK, q_cap], [0.0, q_cap]])
    front = [_line(corners[3], lips[0][-1]), _line(lips[0][0], corners[0])]
    sides = [_line(a, b) for a, b in ((corners[0], corners[1]), (corners[1], corners[2]), (corners[2], corners[3]))]
    fixed = np.concatenate([corners, *front, *sides, lips[0], lids[0], ear_sheet[0]])
    filler, triangles = _fill(
        fixed, [lips[0], lids[0], ear_sheet[0]], _hexagons(corners[0], corners[2], 0.0016),
        lambda s: form.surface(*sheet_to_angles(s)),
    )  # fmt: skip
    n_before = len(corners) + sum(map(len, front)) + sum(map(len, sides))
    starts = np.cumsum([n_before, N_LIP, N_LID, N_EAR])
    outer = [np.arange(a, b) for a, b in zip(starts[:-1], starts[1:], strict=True)]
    sheet, verts, groups = [filler], [skin(filler)], {}
    tris, count = [triangles], len(filler)
    for name, ring, rings, closed in zip(("lip", "lid", "ear"), outer, (lips, lids, ear_sheet), (False, True, True), strict=True):
        ids = [ring]
        for k in range(1, len(rings)):
            ids.append(np.arange(count, count + len(rings[k])))
            sheet.append(rings[k])
            verts.append(ear_verts[k] if name == "ear" else skin(rings[k]))
            count += len(rings[k])
        tris.append(ring_stack(ids if len(rings[-1]) > 1 else ids[:-1], closed=closed))
        if len(rings[-1]) == 1:
            tris.append(_fan(ids[-2], ids[-1][0]))
        groups.update({f"{name}_{len(ids) - 1 - k}": v for k, v in enumerate(ids)})
    all_sheet, all_verts = np.concatenate(sheet), np.concatenate(verts)
    all_verts[all_sheet[:, 0] == 0.0, 0] = 0.0
    all_verts[all_sheet[:, 0] == P_BACK, 0] = 0.0
    ids = half.add_points(all_verts, part="skin", sheet=all_sheet)
    vt = half.add_vt(_main_uv(all_sheet), axis=0.5)
    half.add_faces(np.concatenate(tris), ids, vt)
    half.groups.update(groups)
    n_sides = np.cumsum([len(corners) + sum(map(len, front)), *map(len, sides)])
    half.groups["rim"] = np.concatenate([[0], np.arange(n_sides[0], n_sides[1]), [1]])
    half.groups["cap_edge"] = np.concatenate([[2], np.arange(n_sides[2], n_sides[3]), [3]])


def _fan(ring: Array, centre: int) -> Array:
    return np.stack([ring, np.roll(ring, -1), np.full_like(ring, centre)], axis=1)


def _add_cap(half: HalfMesh) -> None:
    """The top of the skull, triangulated in a polar plane whose outline is the sheet's upper edge."""
    to_q, to_level, q_cap, _ = _levels()
    edge = half.groups["cap_edge"]
    angle = np.concatenate(half.sheet)[edge, 0] / AROUND
    rim = -q_cap * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    rim[[0, -1], 0] = 0.0
    n = 9
    spine = np.stack([np.zeros(2 * n - 1), np.linspace(-q_cap, q_cap, 2 * n + 1)[1:-1]], axis=1)

    def embed(plane: Array) -> Array:
        radius = np.hypot(plane[:, 0], plane[:, 1])
        return form.surface(np.arctan2(plane[:, 0], -plane[:, 1]), to_level(np.clip(-radius, 2 * q_cap, 0.0)))

    fixed = np.concatenate([rim, spine])
    candidates = _hexagons(np.array([0.0, q_cap]), np.array([-q_cap, -q_cap]), 0.0016)
    candidates = candidates[np.hypot(candidates[:, 0], candidates[:, 1]) < -q_cap - 0.004]
    points, triangles = _fill(fixed, [], candidates, embed)
    new = np.arange(len(rim), len(points))
    verts = embed(points[new])
    verts[points[new, 0] == 0.0, 0] = 0.0
    radius = np.hypot(points[new, 0], points[new, 1])
    sheet = np.stack([np.arctan2(points[new, 0], -points[new, 1]) * AROUND, -radius], axis=1)
    ids = np.concatenate([edge, half.add_points(verts, part="skin", sheet=sheet)])
    vt = half.add_vt(np.array([0.145, 0.142]) + points / -q_cap * 0.135, axis=0.145)
    half.add_faces(triangles, ids, vt)


def _add_lids_inside(half: HalfMesh) -> None:
    """The thickness of the lids: from their edge inwards, then back along the eyeball."""
    edge = half.groups["lid_0"]
    verts, sheet = np.concatenate(half.verts)[edge], np.concatenate(half.sheet)[edge]
    away = verts - form.EYE
    radius = np.linalg.norm(away, axis=1, keepdims=True)
    margin = form.EYE + away / radius * np.maximum(radius - 0.0010, form.EYE_RADIUS + 0.0008)
    outward = away * [1.0, 1.0, 0.0]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    deep = away + outward * 0.0042 - np.array([0.0, 0.0, 0.0042])
    deep = form.EYE + deep / np.linalg.norm(deep, axis=1, keepdims=True) * (form.EYE_RADIUS + 0.0006)
    ids = [half.add_points(v, part="skin", sheet=sheet) for v in (margin, deep)]
    edge_uv = np.concatenate(half.vt)[edge]
    centre = edge_uv.mean(axis=0)
    vt = half.add_vt(np.concatenate([centre + f * (edge_uv - centre) for f in (1.0, 0.78, 0.45)]), axis=0.5)
    rings = np.arange(3 * N_LID).reshape(3, N_LID)
    half.add_faces(ring_stack(list(rings), closed=True), np.concatenate([edge, *ids]), vt)
    half.groups["lid_margin"], half.groups["lid_inner"] = ids


def _add_socket(half: HalfMesh) -> None:
    """The inside of the mouth: a bag behind the lips."""
    edge = half.groups["lip_0"]
    rings = socket_rings(np.concatenate(half.verts)[edge])
    ids = [edge, *(half.add_points(r, part="socket") for r in rings)]
    n = len(edge)
    t = np.linspace(-np.pi / 2, np.pi / 2, n)
    circle = np.stack([np.where(np.isin(np.arange(n), (0, n - 1)), 0.0, np.cos(t)), np.sin(t)], axis=1)
    scale = np.linspace(1.0, 0.16, len(ids))
    vt = half.add_vt(np.concatenate([np.array([0.397, 0.142]) + 0.110 * s * circle for s in scale]), axis=0.397)
    stack = ring_stack(list(np.arange(len(ids) * n).reshape(len(ids), n)), closed=False)
    half.add_faces(stack, np.concatenate(ids), vt)
    last = np.arange((len(ids) - 1) * n, len(ids) * n)
    chord = np.stack([np.full(n - 2, last[0]), last[1:-1], last[2:]], axis=1)
    half.add_faces(chord, np.concatenate(ids), vt)
    half.groups.update({f"socket_{k}": v for k, v in enumerate(ids)})


def _add_parts(half: HalfMesh) -> None:
    for piece in (*eyeball_half(), *teeth_half()):
        ids = half.add_points(piece.verts, part=piece.part)
        for faces, vt, axis in piece.charts:
            used, local = np.unique(faces, return_inverse=True)
            half.add_faces(local.reshape(-1, 3), ids[used], half.add_vt(vt[used], axis=axis))


def build_mesh() -> HeadMesh:
    """Make the left half, mirror it and weld it along the middle."""
    half = HalfMesh()
    for add in (_add_skin, _add_cap, _add_lids_inside, _add_socket, _add_parts):
        add(half)
    verts, vt, axis = np.concatenate(half.verts), np.concatenate(half.vt), np.concatenate(half.vt_axis)
    n, middle = len(verts), verts[:, 0] == 0.0
    right = np.where(middle, np.arange(n), n + np.cumsum(~middle) - 1)
    vt_middle = vt[:, 0] == axis
    vt_right = np.where(vt_middle, np.arange(len(vt)), len(vt) + np.cumsum(~vt_middle) - 1)
    faces, face_vt = np.concatenate(half.faces), np.concatenate(half.face_vt)
    sheet, part = np.concatenate(half.sheet), np.concatenate(half.part)
    rest = np.full((n, 3), np.nan)
    on_skin = ~np.isnan(sheet[:, 0])
    angle, level = sheet_to_angles(sheet)
    rest[on_skin] = form.base(angle[on_skin], level[on_skin])
    rest[middle, 0] = 0.0
    flip = np.array([-1.0, 1.0, 1.0])
    mirror = np.concatenate([right, np.flatnonzero(~middle)])
    vt_flipped = np.stack([2.0 * axis - vt[:, 0], vt[:, 1]], axis=1)[~vt_middle]
    return HeadMesh(
        verts=np.concatenate([verts, verts[~middle] * flip]),
        faces=np.concatenate([faces, right[faces][:, ::-1]]),
        vt=np.concatenate([vt, vt_flipped]),
        ft=np.concatenate([face_vt, vt_right[face_vt][:, ::-1]]),
        part=np.concatenate([part, part[~middle]]),
        rest=np.concatenate([rest, rest[~middle] * flip]),
        level=np.concatenate([level, level[~middle]]),
        mirror=mirror,
        groups=half.groups,
    )
