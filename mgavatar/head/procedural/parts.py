"""The inner parts of the built-in head's left half: inside of the mouth, eyeball, teeth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mgavatar.head.procedural.surface import EYE, EYE_RADIUS, MOUTH_Y

Array = np.ndarray

N_EYE_AROUND = 24
"""Number of points per ring of an eyeball."""
EYE_RINGS_DEG = (0.0, 11.0, 22.0, 29.0, 42.0, 58.0, 76.0, 96.0, 118.0, 140.0, 160.0, 180.0)
"""Angles of its rings from the optical axis; the pupil ends at the second, the iris at the fourth."""
EYE_SEAM = 6
"""Ring that separates the front chart of an eyeball from the back chart."""
N_TEETH_ALONG = 17
"""Number of points along half a row of teeth."""


@dataclass(frozen=True)
class Part:
    """One inner part.

    Attributes:
        verts: Vertices [m], shape [V, 3].
        part: Its name.
        charts: Faces, shape [F, 3], with texture coordinates, shape [V, 2], and u of the axis that mirrors them.
    """

    verts: Array
    part: str
    charts: tuple[tuple[Array, Array, float], ...]


def socket_rings(edge: Array) -> list[Array]:
    """Return half rings of the mouth's inside, from behind the lips to the throat.

    Args:
        edge: The innermost half ring of the lips [m], shape [N, 3].

    Returns:
        Rings of shape [N, 3] each [m].
    """
    t = np.linspace(-np.pi / 2, np.pi / 2, len(edge))
    c, s = np.cos(t), np.sin(t)
    c[[0, -1]] = 0.0  # exactly: both ends are welded to the right half
    rings = [edge + np.stack([0.0 * c, 0.0003 * s, np.full_like(c, -0.0030)], axis=1)]
    for width, height, depth, bend in (
        (0.0262, 0.0100, 0.0005, 1.0),
        (0.0275, 0.0165, -0.0050, 0.9),
        (0.0270, 0.0170, -0.0150, 0.6),
        (0.0230, 0.0150, -0.0260, 0.2),
        (0.0120, 0.0080, -0.0320, 0.0),
    ):
        front = 0.0385 + depth - bend * 20.0 * (width * c) ** 2
        rings.append(np.stack([width * c, MOUTH_Y + height * s, front], axis=1))
    return rings


def eyeball_half() -> tuple[Part, ...]:
    """Return the left eyeball, a closed sphere with its pole at the front."""
    polar = np.radians(EYE_RINGS_DEG)
    sphere = _sphere(polar)
    n_rings = len(polar) - 2
    # The front pole has the id 0, the rings follow from front to back, the back pole comes last.
    ids = 1 + np.arange(n_rings * N_EYE_AROUND).reshape(n_rings, N_EYE_AROUND)
    after = np.roll(ids, -1, axis=1)
    front_fan = np.stack([np.zeros_like(ids[0]), ids[0], after[0]], axis=1)
    back_fan = np.stack([np.full_like(ids[-1], len(sphere) - 1), after[-1], ids[-1]], axis=1)
    bands = []
    for k in range(n_rings - 1):
        one = np.stack([ids[k], ids[k + 1], after[k + 1]], axis=1)
        other = np.stack([ids[k], after[k + 1], after[k]], axis=1)
        bands.append(np.concatenate([one, other]))
    front = np.concatenate([front_fan, *bands[:EYE_SEAM]])
    back = np.concatenate([*bands[EYE_SEAM:], back_fan])
    # Both charts are discs: the distance from the centre is the angle from the pole, in units of that of the seam.
    angle = np.arccos(np.clip(sphere[:, 2], -1, 1))
    flat = sphere[:, :2] / np.maximum(np.linalg.norm(sphere[:, :2], axis=1, keepdims=True), 1e-12)
    seam = polar[EYE_SEAM + 1]
    front_vt = np.array([0.695, 0.218]) + 0.057 * (angle / seam)[:, None] * flat
    mirrored = flat * [-1.0, 1.0]  # seen from behind
    back_vt = np.array([0.695, 0.080]) + 0.057 * ((np.pi - angle) / (np.pi - seam))[:, None] * mirrored
    return (Part(EYE + EYE_RADIUS * sphere, "eye", ((front, front_vt, 0.635), (back, back_vt, 0.635))),)


def _sphere(polar: Array) -> Array:
    """Return the front pole, the rings at polar angles [rad] between the first and the last, and the back pole."""
    around = np.linspace(0.0, 2 * np.pi, N_EYE_AROUND, endpoint=False)
    sine, cosine = np.sin(polar[1:-1]), np.cos(polar[1:-1])
    x, y = np.outer(sine, np.cos(around)), np.outer(sine, np.sin(around))
    z = np.broadcast_to(cosine[:, None], x.shape)
    rings = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return np.concatenate([[[0.0, 0.0, 1.0]], rings, [[0.0, 0.0, -1.0]]])


def _teeth_row(*, upper: bool) -> Part:
    """Return half a row of teeth: outer face, biting edge and inner face, as a strip along a parabola."""
    sign = 1.0 if upper else -1.0
    along = np.linspace(0.0, 1.0, N_TEETH_ALONG)
    x = 0.0235 * np.sin(along * np.pi / 2) ** 0.9 if upper else 0.0220 * np.sin(along * np.pi / 2) ** 0.9
    x[0] = 0.0
    front = (0.0385 if upper else 0.0362) - 46.0 * x**2 - 3.0e4 * x**4 * 0.6
    scallop = 0.00035 * np.abs(np.sin(along * 7.0 * np.pi))
    biting = MOUTH_Y + (-0.0012 if upper else -0.0022)
    height = sign * (0.0100 - 0.0020 * along)
    # Sections from the gum outside over the biting edge to the gum inside: share of the height, depth [m].
    section = ((1.0, 0.0), (0.55, 0.0006), (0.08, 0.0), (0.0, -0.0012), (0.08, -0.0026), (1.0, -0.0050))
    rows = [np.stack([x, biting + f * height, front + scallop * (f < 1.0) + d], axis=1) for f, d in section]
    verts = np.concatenate(rows)
    n, m = len(section), N_TEETH_ALONG
    ids = np.arange(n * m).reshape(n, m)
    a, b, c, d = ids[:-1, :-1].ravel(), ids[1:, :-1].ravel(), ids[1:, 1:].ravel(), ids[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    v = np.repeat(np.linspace(1.0, 0.0, n), m) if upper else np.repeat(np.linspace(0.0, 1.0, n), m)
    centre, bottom = 0.875, (0.155 if upper else 0.015)
    vt = np.stack([centre + 0.105 * np.tile(along, n), bottom + 0.115 * v], axis=1)
    return Part(verts, "upper_teeth" if upper else "lower_teeth", ((faces if upper else faces[:, ::-1], vt, centre),))


def teeth_half() -> tuple[Part, ...]:
    """Return the left halves of the upper and of the lower row of teeth."""
    return _teeth_row(upper=True), _teeth_row(upper=False)
