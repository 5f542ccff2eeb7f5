"""The sheet on which the built-in head's skin is triangulated, and the rings of points along its features.

The sheet has coordinates (p, q), roughly in metres: p runs around the left half of the head from the front to the back,
q from the bust rim up to the crown. Between the rings, points of graded density are relaxed and triangulated.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial import Delaunay, cKDTree

from mgavatar.head.procedural import surface as form

Array = np.ndarray

AROUND = 0.070
"""Metres on the sheet per radian around the head."""
P_BACK = np.pi * AROUND
"""p of the back of the head."""
N_LID, N_LIP, N_EAR = 30, 21, 28
"""Number of points per ring around the eye, per half ring around the mouth, and per ring of the ear."""
RED_RINGS = (1.0, 0.74, 0.48, 0.24, 0.07, 0.0)
"""Places of the rings in the red of the lips, from 1 at its border to 0 at the opening."""


@lru_cache(maxsize=1)
def levels() -> tuple[PchipInterpolator, PchipInterpolator, float, float]:
    """Return the maps from level to q and from q to level, and q of the cap's edge and of the rim.

    q is 0 at the crown and falls with the length of the paths down the head, that of the front half counted more.
    """
    level = np.linspace(0.0, form.N_LEVELS - 1.0, 721)
    angles = np.linspace(0.0, np.pi, 9)
    paths = np.stack([form.base(np.full_like(level, a), level) for a in angles])
    steps = np.linalg.norm(np.diff(paths, axis=1), axis=-1)
    q = -np.concatenate([[0.0], np.cumsum(0.6 * steps[:5].mean(axis=0) + 0.4 * steps.mean(axis=0))])
    to_q = PchipInterpolator(level, q)
    return to_q, PchipInterpolator(q[::-1], level[::-1]), float(to_q(form.CAP_LEVEL)), float(q[-1])


def sheet_to_angles(sheet: Array) -> tuple[Array, Array]:
    """Return angle [rad] and level of points (p, q) of the sheet, shape [..., 2]."""
    return sheet[..., 0] / AROUND, levels()[1](sheet[..., 1])


def front_to_sheet(xy: Array) -> Array:
    """Return the points (p, q) of the sheet at x and y of the featureless face [m], shape [..., 2]."""
    angle, level = form.invert_front(xy[..., 0], xy[..., 1])
    return np.stack([angle * AROUND, levels()[0](level)], axis=-1)


def skin(sheet: Array) -> Array:
    """Return the points of the skin at points (p, q) of the sheet: shape [N, 2] to [N, 3] [m]."""
    return form.surface(*sheet_to_angles(sheet))


def spacing(points: Array) -> Array:
    """Return the wanted distance between neighbours at points of the featureless head: shape [..., 3] to [...] [m]."""
    x, y, z = np.abs(points[..., 0]), points[..., 1], points[..., 2]
    face = np.hypot(np.hypot(x / 1.0, (y + 0.018) / 1.25), np.minimum(z - 0.035, 0.0) / 0.9)
    coarse = 0.0039 + 0.0064 * form.smoothstep(0.035, 0.115, face)
    nose = np.exp(-((x / 0.016) ** 2) - ((y + 0.013) / 0.021) ** 2)
    chin = np.exp(-((x / 0.040) ** 2) - ((y + 0.092) / 0.016) ** 2) * (z > 0.0)
    return coarse * (1.0 - 0.55 * nose - 0.40 * chin)


def strip(outer: Array, inner: Array, *, closed: bool) -> Array:
    """Return the triangles between two counter-clockwise rings of ids, shape [N] each; the first is the outer one."""
    n = len(outer)
    i = np.arange(n if closed else n - 1)
    j = (i + 1) % n
    a, b, c, d = outer[i], outer[j], inner[j], inner[i]
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def ring_stack(rings: list[Array], *, closed: bool) -> Array:
    """Return the triangles of a stack of rings of ids, from outside to inside; the last may be a single point."""
    faces = [strip(a, b, closed=closed) for a, b in pairwise(rings) if len(b) > 1]
    if len(rings[-1]) == 1:
        ring = rings[-2]
        faces.append(np.stack([ring, np.roll(ring, -1), np.full_like(ring, rings[-1][0])], axis=1))
    return np.concatenate(faces)


def lid_rings() -> list[Array]:
    """Return rings around the left eye, from the socket to the edge of the lids: x and y, shape [N_LID, 2] each [m]."""
    t = np.linspace(0.0, 2 * np.pi, N_LID, endpoint=False)
    c, s = np.cos(t), np.sin(t)
    tilt = 0.0012 * c
    edge_height = np.where(s > 0, 0.0054, 0.0042) * np.abs(s) ** 1.12 * np.sign(s) * (1.0 - 0.12 * c)
    edge = np.stack([form.EYE[0] - 0.0006 + 0.0145 * c, form.EYE[1] + edge_height + tilt], axis=1)
    outer = np.stack([form.EYE[0] + 0.0005 + 0.0198 * c, form.EYE[1] + 0.0010 + 0.0158 * s], axis=1)
    return [edge + f * (outer - edge) for f in (1.0, 0.74, 0.50, 0.29, 0.12, 0.0)]


def nose_lines() -> list[Array]:
    """Return lines along the foot and the crest of the nose's underside, where the skin bends sharply: x and y [m]."""
    lines = []
    for offset in (-0.0010, 0.0002, 0.0014):
        radius = 0.0063 + offset
        t = np.linspace(-np.pi / 2, 0.75, 8)
        wing = np.stack([0.0113 + radius * np.cos(t), -0.0172 + radius * np.sin(t)], axis=1)
        x = np.array([0.0022, 0.0044, 0.0067, 0.0090])
        lines.append(np.concatenate([np.stack([x, np.full_like(x, -0.0172 - radius)], axis=1), wing]))
    return lines


def _lip_border(t: Array) -> Array:
    """Return the border of the lips' red before the mouth is closed, a half ring at the angles ``t``: x and y [m]."""
    x = (form.MOUTH_HALF_WIDTH + 0.0024) * np.cos(t)
    red = form.lip_height(np.minimum(x, form.MOUTH_HALF_WIDTH + 0.0014), upper=np.sin(t) > 0)
    opening = form.mouth_opening(x)
    distance = red + opening
    # Closing the mouth squeezes the sheet by an amount that depends on the distance itself. The fixed point is the
    # distance that the squeeze takes to the height of the red.
    for _ in range(20):
        distance = red + opening * (1.0 - form.smoothstep(opening, form.MOUTH_BLEND, distance))
    distance *= np.abs(np.sin(t)) > 1e-9  # the corner lies on the mouth line
    return np.stack([x, form.MOUTH_Y + np.sign(np.sin(t)) * distance], axis=1)


def lip_rings() -> list[Array]:
    """Return half rings around the mouth, counter-clockwise, from the cheek over the border of the red to the opening.

    Returns:
        x and y before the mouth is closed, shape [N_LIP, 2] each [m].
    """
    t = np.linspace(-np.pi / 2, np.pi / 2, N_LIP)
    t[N_LIP // 2] = 0.0  # exactly: the corner belongs to both lips
    c, s = np.cos(t), np.sin(t)
    c[[0, -1]] = 0.0  # exactly: both ends are welded to the right half
    x = form.MOUTH_HALF_WIDTH * c
    hole = np.stack([x, form.MOUTH_Y + np.sign(s) * form.mouth_opening(x)], axis=1)
    outer = np.stack([0.0365 * c, form.MOUTH_Y - 0.0010 + 0.0180 * s], axis=1)
    border = _lip_border(t)
    around = [border + f * (outer - border) for f in (1.0, 0.62, 0.28)]
    return around + [hole + f * (border - hole) for f in RED_RINGS]


def graded_line(start: Array, end: Array) -> Array:
    """Return points of the sheet between two ends, without the ends, spaced as :func:`spacing` wants, shape [N, 2]."""
    fine = start + np.linspace(0.0, 1.0, 2001)[:, None] * (end - start)
    wanted = spacing(form.base(*sheet_to_angles(fine)))
    # The integral of 1 / spacing counts the points up to each place; equal steps of it are the points.
    count = np.concatenate([[0.0], np.cumsum(np.linalg.norm(end - start) / 2000 / wanted[1:])])
    n = max(1, round(count[-1]))
    at = np.interp(np.arange(1, n) * count[-1] / n, count, np.linspace(0.0, 1.0, 2001))
    return start + at[:, None] * (end - start)


def _inside(points: Array, polygon: Array) -> Array:
    """Return True for points inside a closed polygon (even-odd rule), shape [N]."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = points[:, 0, None], points[:, 1, None]
    # A ray towards +x crosses an edge whose ends lie on either side of it, if it meets the edge's line ahead.
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])  # a level edge spans nothing
    meets_at = a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0])
    return (spans & (x < meets_at)).sum(axis=1) % 2 == 1


def _encroaches(points: Array, polygon: Array) -> Array:
    """Return True for points so close to an edge of a polygon that a Delaunay triangulation may lose it, shape [N].

    An edge is kept if the circle with the edge as its diameter holds no other point; 0.55 leaves a margin. The long
    edge that closes a half ring runs along the middle of the head and need not be kept.
    """
    a, b = polygon, np.roll(polygon, -1, axis=0)
    distance = np.linalg.norm(points[:, None] - (a + b) / 2, axis=-1)
    length = np.linalg.norm(b - a, axis=1)
    reach = 0.55 * length * (length < 0.012)
    return np.any(distance < reach, axis=1)


def _scatter(candidates: Array, wanted: Array, fixed: Array) -> Array:
    """Select candidates that keep about their wanted distance from each other and from the fixed points.

    Args:
        candidates: Shape [C, 2]; earlier ones are preferred.
        wanted: Wanted distance of each candidate from its neighbours, shape [C].
        fixed: Shape [N, 2].

    Returns:
        The selected candidates, in their order, shape [K, 2].
    """
    tree = cKDTree(candidates)
    alive = cKDTree(fixed).query(candidates)[0] > 0.75 * wanted
    kept = []
    for i in range(len(candidates)):
        if alive[i]:
            kept.append(i)
            alive[tree.query_ball_point(candidates[i], wanted[i] * 0.92)] = False
    return candidates[kept]


def fill(fixed: Array, holes: list[Array], candidates: Array, embed: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Fill a convex region of a plane around holes with points and triangles.

    Args:
        fixed: Points on the outline and on the holes' outlines, shape [N, 2].
        holes: Closed outlines, shape [M, 2] each.
        candidates: Points that may be used, shape [C, 2].
        embed: Maps points of the plane to space, shape [P, 2] to [P, 3] [m]; spacing and evenness are measured there.

    Returns:
        All points, the fixed ones first, shape [P, 2]; counter-clockwise triangles, shape [F, 3].
    """

    def in_hole(at: Array) -> Array:
        inside = np.zeros(len(at), bool)
        for hole in holes:
            inside |= _inside(at, hole) | _encroaches(at, hole)
        return inside

    candidates = candidates[~in_hole(candidates)]
    points = np.concatenate([fixed, _scatter(candidates, spacing(embed(candidates)), fixed)])
    n = len(fixed)
    outline = cKDTree(fixed)
    for _ in range(10):
        embedded = embed(points)
        moved = points + 0.6 * (_even_out(points, embedded) - points)
        near = outline.query(moved)[0] < 0.6 * spacing(embedded)
        free = ~near & ~in_hole(moved) & (np.arange(len(points)) >= n)
        points[free] = moved[free]
    triangles = Delaunay(points).simplices
    # Delaunay fills the convex hull: triangles in holes are removed, and flat ones along the straight outline.
    for hole in holes:
        triangles = triangles[~_inside(points[triangles].mean(axis=1), hole)]
    ab, ac = points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    triangles[area < 0] = triangles[area < 0][:, ::-1]
    return points, triangles[np.abs(area) > 1e-12]


def _even_out(points: Array, embedded: Array) -> Array:
    """Return the mean of each point's neighbours in the plane, shape [P, 2].

    Edges weigh as much as they are longer in space than in the plane: the points become even in space.
    """
    simplices = Delaunay(points).simplices
    # Every side of every triangle in both directions, so an edge inside counts twice for either end.
    i, j = simplices[:, [0, 1, 2, 1, 2, 0]].ravel(), simplices[:, [1, 2, 0, 0, 1, 2]].ravel()
    weight = np.linalg.norm(embedded[i] - embedded[j], axis=1) / np.maximum(
        np.linalg.norm(points[i] - points[j], axis=1), 1e-9
    )
    total = np.bincount(i, weight, len(points))
    return np.stack([np.bincount(i, weight * points[j, k], len(points)) / total for k in (0, 1)], axis=1)


def hexagons(low: Array, high: Array, pitch: float) -> Array:
    """Return a hexagonal lattice of points strictly inside a box, shape [N, 2].

    Args:
        low: Lower corner, shape [2].
        high: Upper corner, shape [2].
        pitch: Distance of neighbours.
    """
    x = np.arange(low[0] + pitch, high[0] - 0.5 * pitch, pitch)
    y = np.arange(low[1] + pitch, high[1] - 0.5 * pitch, pitch * 0.8660254)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    grid[1::2, :, 0] += 0.5 * pitch
    return grid.reshape(-1, 2)
