"""The left ear of the built-in head: rings from the skin around it over its rim into the concha."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mgavatar.head.procedural.surface import smoothstep

Array = np.ndarray

EAR_ANGLE, EAR_LEVEL = 1.60, 6.75
"""Centre of the ear on the head's sheet."""
HALF_WIDTH, HALF_HEIGHT, LEAN = 0.0168, 0.0305, 0.10
"""Half width and half height of the rim [m]; backward lean of its axis [m per m of height]."""

# One row per ring, from outside to inside: size behind the ear, size before it, share of the plate's height, lift [mm].
RINGS = np.array(
    [
        (1.10, 1.10, 0.0, 0.0),  # skin around the ear
        (0.80, 1.04, 0.0, 0.0),  # foot of the ear's back
        (0.66, 0.99, 0.25, 0.0),
        (0.90, 0.95, 0.85, -2.0),  # back of the rim
        (1.00, 0.91, 1.00, -0.8),  # rim
        (0.95, 0.86, 1.00, 1.2),
        (0.84, 0.78, 1.00, -0.3),
        (0.75, 0.69, 1.00, -3.0),  # groove inside the rim
        (0.60, 0.59, 1.00, 1.4),  # antihelix
        (0.46, 0.48, 0.75, -1.5),
        (0.30, 0.34, 0.30, -2.0),  # wall of the concha
    ]
)


def _ring(skin: Callable[[Array], Array], centre: Array, row: Array, t: Array) -> Array:
    """Return the points of one ring at the angles ``t`` (0 backwards, pi/2 up), shape [N, 3] [m]."""
    c, s = np.cos(t), np.sin(t)
    behind = smoothstep(-0.75, 0.25, c)
    size = row[1] + (row[0] - row[1]) * behind
    back, up = size * HALF_WIDTH * c * (1.0 + 0.09 * s), size * HALF_HEIGHT * s
    back = back + LEAN * up - 0.0042 * (1.0 - size)
    up = up - 0.0075 * np.maximum(0.8 - size, 0.0)
    foot = skin(centre + np.stack([back, up], axis=1))
    plate = 0.60 * np.maximum(back + 0.011 - LEAN * up, 0.0)
    lobe = 1.0 - 0.75 * smoothstep(0.45, 0.95, -s)
    lift = row[3] / 1000.0 * (behind * 0.85 + 0.15) * lobe
    tragus = 0.0038 * np.exp(-(((c + 1.0) / 0.10) ** 2)) * np.exp(-(((size - 0.60) / 0.14) ** 2))
    out = row[2] * plate + lift + tragus
    return foot + out[:, None] * np.array([0.96, 0.0, 0.12])


def ear_rings(
    skin: Callable[[Array], Array], *, n: int, around: float, q_of_level: Callable[[float], float]
) -> tuple[list[Array], list[Array]]:
    """Return the rings of the left ear, from outside to inside; the last is a single point.

    Args:
        skin: Maps points (p, q) of the head's sheet, shape [N, 2], to the bare skin, shape [N, 3] [m].
        n: Number of points per ring, N.
        around: Metres on the sheet per radian.
        q_of_level: Maps a level of the head to q.

    Returns:
        The rings on the sheet, nested ellipses, shape [N, 2] each; and in space, shape [N, 3] each [m].
    """
    centre = np.array([EAR_ANGLE * around, float(q_of_level(EAR_LEVEL))])
    # Seen from outside, the left half's p grows to the right and q upwards: this ring is counter-clockwise.
    t = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    back, up = HALF_WIDTH * np.cos(t) * (1.0 + 0.09 * np.sin(t)), HALF_HEIGHT * np.sin(t)
    ellipse = RINGS[0, 0] * np.stack([back + LEAN * up, up], axis=1)
    sheet = [centre + scale * ellipse for scale in np.linspace(1.0, 0.12, len(RINGS))]
    verts = [_ring(skin, centre, row, t) for row in RINGS]
    middle = skin(centre[None] + [[0.0008, -0.002]]) - [0.0025, 0.0, 0.0]
    return [*sheet, centre[None]], [*verts, middle]
