"""The mesh of the built-in head: skin, inside of the mouth, eyeballs, teeth, and one texture atlas for all.

The left half is put together piece by piece in a :class:`HalfMesh`; :func:`build_mesh` mirrors it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mgavatar.head.procedural import surface as form
from mgavatar.head.procedural.ear import ear_rings
from mgavatar.head.procedural.parts import eyeball_half, socket_rings, teeth_half
from mgavatar.head.procedural.sheet import (
    AROUND,
    N_EAR,
    N_LID,
    P_BACK,
    fill,
    front_to_sheet,
    graded_line,
    hexagons,
    levels,
    lid_rings,
    lip_rings,
    nose_lines,
    ring_stack,
    sheet_to_angles,
    skin,
)

Array = np.ndarray

GUTTER = 0.006
"""Margin of the atlas, and least distance between its charts."""


@dataclass
class HalfMesh:
    """The left half while it is put together.

    Attributes:
        verts: Vertices of each piece, shape [V, 3] [m].
        sheet: Their points on the sheet, shape [V, 2]; NaN off the skin.
        part: Their part's name, shape [V].
        vt: Texture coordinates of each chart, shape [U, 2].
        vt_axis: u of the axis about which each is mirrored, shape [U].
        faces: Vertex ids of each piece's triangles, shape [F, 3].
        face_vt: Their texture ids, shape [F, 3].
        groups: Vertex ids of named rings and outlines.
        n_verts: Number of vertices so far.
        n_vt: Number of texture coordinates so far.
    """

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
        """Add vertices and return their ids."""
        n = len(verts)
        self.verts.append(verts)
        self.sheet.append(np.full((n, 2), np.nan) if sheet is None else sheet)
        self.part.append(np.full(n, part))
        self.n_verts += n
        return np.arange(self.n_verts - n, self.n_verts)

    def add_vt(self, vt: Array, *, axis: float) -> Array:
        """Add texture coordinates that are mirrored about u = ``axis``, and return their ids."""
        self.vt.append(vt)
        self.vt_axis.append(np.full(len(vt), axis))
        self.n_vt += len(vt)
        return np.arange(self.n_vt - len(vt), self.n_vt)

    def add_faces(self, local: Array, vertex_ids: Array, vt_ids: Array) -> None:
        """Add triangles whose entries are places in both ``vertex_ids`` and ``vt_ids``."""
        self.faces.append(vertex_ids[local])
        self.face_vt.append(vt_ids[local])


@dataclass(frozen=True)
class HeadMesh:
    """The whole mesh, with what rig and directions need.

    Attributes:
        verts: Vertices [m], shape [V, 3].
        faces: Vertex indices, counter-clockwise from outside, shape [F, 3].
        vt: Texture coordinates, v up, shape [U, 2].
        ft: Texture indices of each face, shape [F, 3].
        part: ``skin``, ``socket``, ``eye``, ``upper_teeth`` or ``lower_teeth`` of each vertex, shape [V].
        rest: Place of each vertex on the featureless head with an open mouth [m], shape [V, 3]; NaN off the skin.
        level: Level of each vertex, shape [V]; NaN off the skin.
        mirror: Index of each vertex's mirror image, its own in the middle, shape [V].
        groups: Vertex ids of rings and outlines of the left half, for example ``lid_0``, the edge of the lids.
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


def _main_uv(sheet: Array) -> Array:
    """Return texture coordinates of points of the sheet; the face gets more room than the back and the neck."""
    _, _, q_cap, q_rim = levels()
    # The maps from p to u and from q to v are integrals of the wanted scale at each place, and so increase everywhere.
    a = np.linspace(0.0, 1.0, 200)
    wide = np.cumsum(0.42 + 0.58 * (1.0 - form.smoothstep(0.28, 0.62, a)))
    u = np.interp(sheet[:, 0] / P_BACK, a, (wide - wide[0]) / (wide[-1] - wide[0]))
    q = np.linspace(q_rim, q_cap, 400)
    y = form.base(np.full_like(q, 0.4), sheet_to_angles(np.stack([np.zeros_like(q), q], 1))[1])[:, 1]
    tall = np.cumsum(0.45 + 0.55 * form.smoothstep(-0.12, -0.085, y) * (1.0 - form.smoothstep(0.06, 0.085, y)))
    v = np.interp(sheet[:, 1], q, (tall - tall[0]) / (tall[-1] - tall[0]))
    return np.stack([0.5 + (0.5 - GUTTER) * u, 0.29 + (0.71 - GUTTER) * v], axis=1)


def _outline(rings: dict[str, list[Array]]) -> dict[str, Array]:
    """Return the fixed points of the sheet by their names: corners, sides, outermost rings, lines of the nose."""
    _, _, q_cap, q_rim = levels()
    corners = np.array([[0.0, q_rim], [P_BACK, q_rim], [P_BACK, q_cap], [0.0, q_cap]])
    return {
        "corners": corners,
        "above_mouth": graded_line(corners[3], rings["lip"][0][-1]),
        "below_mouth": graded_line(rings["lip"][0][0], corners[0]),
        "bottom": graded_line(corners[0], corners[1]),
        "back": graded_line(corners[1], corners[2]),
        "top": graded_line(corners[2], corners[3]),
        **{name: stack[0] for name, stack in rings.items()},
        "nose": front_to_sheet(np.concatenate(nose_lines())),
    }


def _numbered(pieces: dict[Any, Array]) -> dict[Any, Array]:
    """Number the points of all pieces one after the other; return the ids of each piece."""
    ends = np.cumsum([len(piece) for piece in pieces.values()])
    return {name: np.arange(end - len(pieces[name]), end) for name, end in zip(pieces, ends, strict=True)}


def _add_skin(half: HalfMesh) -> None:
    """Add the skin below the cap, with the rings of mouth, lids and ear; it comes first, so its ids start at 0."""
    lips = [front_to_sheet(ring) for ring in lip_rings()]
    for ring in lips:
        ring[[0, -1], 0] = 0.0  # exactly on the middle, where the halves are welded
    ear_sheet, ear_verts = ear_rings(skin, n=N_EAR, around=AROUND, q_of_level=levels()[0])
    rings = {"lip": lips, "lid": [front_to_sheet(ring) for ring in lid_rings()], "ear": ear_sheet}
    outline = _outline(rings)
    ids = _numbered(outline)
    low, high = outline["corners"][[0, 2]]
    holes = [stack[0] for stack in rings.values()]
    # ``fill`` puts the fixed points first: ``ids`` holds for its result too. Each stack's outermost ring is part of it,
    # and the rings inside follow after all points so far.
    filler, triangles = fill(np.concatenate(list(outline.values())), holes, hexagons(low, high, 0.0016), skin)
    sheets, verts, faces = [filler], [skin(filler)], [triangles]
    n_points = len(filler)
    for name, stack in rings.items():
        numbered = [ids[name]]
        for ring in stack[1:]:
            numbered.append(np.arange(n_points, n_points + len(ring)))
            n_points += len(ring)
        sheets.extend(stack[1:])
        verts.extend(ear_verts[1:] if name == "ear" else map(skin, stack[1:]))
        faces.append(ring_stack(numbered, closed=name != "lip"))
        for k, ring_ids in enumerate(reversed(numbered)):  # ring 0 is the innermost
            half.groups[f"{name}_{k}"] = ring_ids
    sheet, points = np.concatenate(sheets), np.concatenate(verts)
    points[(sheet[:, 0] == 0.0) | (sheet[:, 0] == P_BACK), 0] = 0.0  # exactly, for the welding
    half.add_faces(
        np.concatenate(faces),
        half.add_points(points, part="skin", sheet=sheet),
        half.add_vt(_main_uv(sheet), axis=0.5),
    )
    corner = ids["corners"]
    half.groups["rim"] = np.concatenate([corner[:1], ids["bottom"], corner[1:2]])
    half.groups["cap_edge"] = np.concatenate([corner[2:3], ids["top"], corner[3:]])


def _add_cap(half: HalfMesh) -> None:
    """Add the top of the skull, triangulated in a polar plane whose outline is the sheet's upper edge."""
    _, to_level, q_cap, _ = levels()
    edge = half.groups["cap_edge"]
    angle = np.concatenate(half.sheet)[edge, 0] / AROUND
    rim = -q_cap * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    rim[[0, -1], 0] = 0.0
    n = 9
    spine = np.stack([np.zeros(2 * n - 1), np.linspace(-q_cap, q_cap, 2 * n + 1)[1:-1]], axis=1)

    def embed(plane: Array) -> Array:
        """Map the plane to the skin: the angle from -y is that around the head, the distance from 0 is -q."""
        radius = np.hypot(plane[:, 0], plane[:, 1])
        return form.surface(np.arctan2(plane[:, 0], -plane[:, 1]), to_level(np.clip(-radius, 2 * q_cap, 0.0)))

    fixed = np.concatenate([rim, spine])
    candidates = hexagons(np.array([0.0, q_cap]), np.array([-q_cap, -q_cap]), 0.0016)
    candidates = candidates[np.hypot(candidates[:, 0], candidates[:, 1]) < -q_cap - 0.004]
    points, triangles = fill(fixed, [], candidates, embed)
    new = np.arange(len(rim), len(points))
    verts = embed(points[new])
    verts[points[new, 0] == 0.0, 0] = 0.0
    radius = np.hypot(points[new, 0], points[new, 1])
    sheet = np.stack([np.arctan2(points[new, 0], -points[new, 1]) * AROUND, -radius], axis=1)
    ids = np.concatenate([edge, half.add_points(verts, part="skin", sheet=sheet)])
    vt = half.add_vt(np.array([0.145, 0.142]) + points / -q_cap * 0.135, axis=0.145)
    half.add_faces(triangles, ids, vt)


def _add_lids_inside(half: HalfMesh) -> None:
    """Add the thickness of the lids: from their edge inwards, then back along the eyeball."""
    edge = half.groups["lid_0"]
    verts, sheet = np.concatenate(half.verts)[edge], np.concatenate(half.sheet)[edge]
    away = verts - form.EYE
    radius = np.linalg.norm(away, axis=1, keepdims=True)
    margin = form.EYE + away / radius * np.maximum(radius - 0.0010, form.EYE_RADIUS + 0.0008)
    outward = away * [1.0, 1.0, 0.0]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    deep = away + outward * 0.0042 - np.array([0.0, 0.0, 0.0060])
    deep = form.EYE + deep / np.linalg.norm(deep, axis=1, keepdims=True) * (form.EYE_RADIUS + 0.0004)
    ids = [half.add_points(v, part="skin", sheet=sheet) for v in (margin, deep)]
    edge_uv = np.concatenate(half.vt)[edge]  # each vertex of the skin has one texture coordinate, of the same id
    centre = edge_uv.mean(axis=0)
    vt = half.add_vt(np.concatenate([centre + f * (edge_uv - centre) for f in (1.0, 0.78, 0.45)]), axis=0.5)
    rings = np.arange(3 * N_LID).reshape(3, N_LID)
    half.add_faces(ring_stack(list(rings), closed=True), np.concatenate([edge, *ids]), vt)
    half.groups["lid_margin"], half.groups["lid_inner"] = ids


def _add_socket(half: HalfMesh) -> None:
    """Add the inside of the mouth, a bag behind the lips."""
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
    """Add eyeball and teeth."""
    for piece in (*eyeball_half(), *teeth_half()):
        ids = half.add_points(piece.verts, part=piece.part)
        for faces, vt, axis in piece.charts:
            # A chart takes along only the vertices of its own faces, which are numbered anew.
            used, local = np.unique(faces, return_inverse=True)
            half.add_faces(local.reshape(-1, 3), ids[used], half.add_vt(vt[used], axis=axis))


def build_mesh() -> HeadMesh:
    """Build the left half, mirror it and weld both halves along the middle."""
    half = HalfMesh()
    for add in (_add_skin, _add_cap, _add_lids_inside, _add_socket, _add_parts):
        add(half)
    verts, vt, axis = np.concatenate(half.verts), np.concatenate(half.vt), np.concatenate(half.vt_axis)
    n, middle = len(verts), verts[:, 0] == 0.0
    # Points in the middle are their own mirror images, which welds the halves without a search for close points. The
    # images of the others are appended in their order: the k-th of them gets the id n + k. Texture coordinates alike.
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
        faces=np.concatenate([faces, right[faces][:, ::-1]]),  # reversed: a mirror turns triangles around
        vt=np.concatenate([vt, vt_flipped]),
        ft=np.concatenate([face_vt, vt_right[face_vt][:, ::-1]]),
        part=np.concatenate([part, part[~middle]]),
        rest=np.concatenate([rest, rest[~middle] * flip]),
        level=np.concatenate([level, level[~middle]]),
        mirror=mirror,
        groups=half.groups,
    )
