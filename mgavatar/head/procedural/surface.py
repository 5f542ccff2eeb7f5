"""The rest surface of the built-in head: horizontal sections, modelled features, and their inverse.

The surface is a map from two coordinates to space. ``angle`` goes around the head (0 = front, pi/2 = the subject's
left, pi = back) [rad]; ``level`` goes down (0 = crown, ``N_LEVELS - 1`` = bust rim) through the rows of ``SECTIONS``.
Only the left half, x >= 0, is modelled; the right half is its mirror image. All lengths are metres.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

EYE = np.array([0.031, 0.023, 0.024])
"""Centre of the left eyeball [m]."""
EYE_RADIUS = 0.0118
"""Radius of the eyeball [m]."""
LID_RADIUS = 0.0134
"""Radius of the sphere on which the lids lie [m]."""
MOUTH_Y = -0.047
MOUTH_HALF_WIDTH = 0.0255
MOUTH_HALF_HEIGHT = 0.0045
"""Half height of the mouth's opening on the sheet [m]; on the closed lips it is squeezed to ``LIP_GAP``."""
MOUTH_BLEND = 0.0230
"""Distance from the mouth line at which the sheet is no longer squeezed [m]."""
LIP_GAP = 0.00008
"""Half the distance of the closed lips [m]."""

# One row per section: front (z, y), side (x, z, y), back (z, y) [m], then how square the front is (2 = an ellipse).
SECTIONS = np.array(
    [
        # zf    yf       xs      zs      ys      zb      yb     square
        (-0.048, 0.1370, 0.0000, -0.048, 0.1370, -0.048, 0.1370, 2.0),  # crown
        (-0.012, 0.1330, 0.0350, -0.049, 0.1295, -0.085, 0.1320, 2.0),
        (0.0190, 0.1185, 0.0580, -0.051, 0.1130, -0.116, 0.1120, 2.05),
        (0.0380, 0.0950, 0.0705, -0.054, 0.0895, -0.134, 0.0860, 2.1),  # hairline
        (0.0460, 0.0690, 0.0755, -0.056, 0.0660, -0.140, 0.0590, 2.2),  # forehead
        (0.0475, 0.0430, 0.0755, -0.056, 0.0420, -0.139, 0.0330, 2.25),  # brow
        (0.0430, 0.0230, 0.0730, -0.054, 0.0190, -0.134, 0.0090, 2.25),  # eyes
        (0.0420, 0.0010, 0.0700, -0.051, -0.004, -0.126, -0.012, 2.2),  # nose
        (0.0430, -0.024, 0.0650, -0.049, -0.027, -0.117, -0.032, 2.15),  # below the nose
        (0.0435, -0.047, 0.0580, -0.048, -0.046, -0.109, -0.051, 2.00),  # mouth
        (0.0400, -0.065, 0.0525, -0.047, -0.061, -0.104, -0.067, 1.88),  # above the chin
        (0.0385, -0.080, 0.0485, -0.047, -0.073, -0.102, -0.081, 1.78),  # chin
        (0.0270, -0.0935, 0.0475, -0.047, -0.083, -0.101, -0.093, 1.74),  # edge of the jaw
        (0.0020, -0.0990, 0.0475, -0.048, -0.092, -0.102, -0.105, 1.78),  # below the jaw
        (-0.0120, -0.1100, 0.0485, -0.050, -0.105, -0.104, -0.118, 1.90),  # throat
        (-0.0130, -0.1320, 0.0520, -0.053, -0.125, -0.109, -0.133, 2.0),  # neck
        (-0.0060, -0.1580, 0.0640, -0.057, -0.148, -0.119, -0.152, 2.0),
        (0.0080, -0.1820, 0.0920, -0.060, -0.166, -0.130, -0.174, 2.1),  # shoulders
        (0.0200, -0.2040, 0.1220, -0.060, -0.196, -0.136, -0.200, 2.2),  # bust rim
    ]
)
N_LEVELS = len(SECTIONS)
CAP_LEVEL = 2.6
"""Level above which the head is triangulated and unwrapped as a cap."""

# Smooth bumps of the left half: centre (x, y, z), widths (x, y, z), displacement (x, y, z) [mm].
BUMPS_MM = np.array(
    [
        ((26, 45, 42), (17, 6.5, 20), (0, 0, 3.8)),  # brow ridge
        ((42, 40, 30), (9, 8, 14), (3, 0, 2.5)),  # outer brow
        ((0, 44, 47), (9, 8, 20), (0, 0, 1.5)),  # glabella
        ((31, 25, 30), (15, 11, 22), (0, 0, -8)),  # eye socket
        ((17, 25, 38), (6, 8, 18), (0, 0, -3.5)),  # inner corner of the socket
        ((46, -1, 20), (13, 12, 20), (2.5, 0, 3.2)),  # cheekbone
        ((58, 0, 0), (12, 9, 26), (1.5, 0, 0)),  # zygomatic arch
        ((30, -13, 33), (11, 11, 16), (0, 0, 2.5)),  # front of the cheek
        ((48, -40, 10), (13, 17, 22), (-1.5, 0, -1.2)),  # hollow of the cheek
        ((66, 42, 5), (11, 17, 22), (-3.5, 0, -1.5)),  # temple
        ((0, -83, 42), (15, 9.5, 16), (0, 0, 5.5)),  # chin
        ((14, -84, 38), (8, 8, 14), (0.5, 0, 1.5)),  # sides of the chin
        ((0, -66, 43), (16, 4.5, 16), (0, 0, -2.5)),  # fold above the chin
        ((0, -50, 46), (26, 19, 22), (0, 0, 3.5)),  # dental arch
        ((53, -68, -22), (9, 13, 20), (3.0, 0, 0)),  # angle of the jaw
        ((36, -86, 10), (12, 7, 22), (1.2, -1, 1)),  # body of the jaw
        ((0, -117, -12), (8, 9, 14), (0, 0, 4)),  # larynx
        ((36, -125, -26), (9, 36, 12), (2, 0, 2)),  # sternomastoid
        ((0, -172, 0), (9, 9, 20), (0, 0, -4)),  # jugular notch
        ((62, -177, -18), (34, 6, 22), (0, 2.5, 3.5)),  # collar bone
    ],
    dtype=float,
)

# Solid parts of the nose: two end points, two radii [mm]; the left of each mirrored pair.
NOSE_MM = np.array(
    [
        ((0, 27, 40.5), (0, 6, 50.5), (6.0, 7.2)),  # bridge
        ((0, 6, 50.5), (0, -9, 58.0), (7.2, 8.6)),
        ((0, -10, 59.0), (0, -13.5, 60.0), (8.8, 9.2)),  # tip
        ((2.8, -14.5, 62.5), (2.8, -13.5, 62.5), (6.0, 6.0)),
        ((11.3, -17.0, 47.5), (9.5, -16.5, 52.0), (6.3, 5.6)),  # wing
        ((0, -20.0, 47.0), (0, -20.0, 57.0), (3.6, 3.6)),  # columella
    ],
    dtype=object,
)
# The pyramid under them: y, height above the face, half width [mm].
NOSE_PYRAMID_MM = np.array(
    [
        (34, 0.0, 8.0),
        (28, 1.0, 8.0),
        (20, 3.4, 8.5),
        (6, 9.0, 10.5),
        (-6, 13.5, 12.0),
        (-13, 15.0, 13.0),
        (-19, 10.5, 13.5),
        (-25, 2.5, 13.0),
        (-30, 0.0, 12.0),
    ]
)
NOSTRIL_MM = ((6.2, -23.0, 55.0), (3.4, 4.5, 5.5), (0.0, 3.5, -2.5))

_splines = {
    # The heights are level at the crown, where all sections meet.
    name: CubicSpline(np.arange(N_LEVELS), column, bc_type=((1, 0.0) if name[0] == "y" else "natural", "natural"))
    for name, column in zip(("zf", "yf", "xs", "zs", "ys", "zb", "yb", "square"), SECTIONS.T, strict=True)
}
_nose_pyramid = [PchipInterpolator(-NOSE_PYRAMID_MM[:, 0], NOSE_PYRAMID_MM[:, i], extrapolate=True) for i in (1, 2)]


def smoothstep(low: float | np.ndarray, high: float | np.ndarray, value: np.ndarray) -> np.ndarray:
    """Interpolate from 0 below ``low`` to 1 above ``high`` with a cubic that is level at both ends."""
    s = np.clip((value - low) / (high - low), 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def base(angle: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return points of the head without features, shape [..., 3] [m].

    Each section is a half ellipse behind and a half superellipse before its widest place.

    Args:
        angle: Angle around the head [rad], any shape.
        level: Level, of the same shape.
    """
    row = {name: spline(level) for name, spline in _splines.items()}
    c, s = np.cos(angle), np.sin(angle)
    n = np.where(c > 0, row["square"], 2.0)
    radius = (np.abs(c) ** n + np.abs(s) ** n) ** (-1.0 / n)
    depth = np.where(c > 0, row["zf"] - row["zs"], row["zs"] - row["zb"])
    y = row["ys"] * s**2 + np.where(c > 0, row["yf"], row["yb"]) * c**2
    return np.stack([row["xs"] * radius * s, y, row["zs"] + depth * radius * c], axis=-1)


def invert_front(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return angle and level of the points of the featureless face that have these x and y.

    Args:
        x: Coordinates [m], any shape.
        y: Coordinates [m], of the same shape.
    """
    # Newton's method in two unknowns. The steps solve the 2 x 2 system of the Jacobian by Cramer's rule.
    angle, level = np.arcsin(np.clip(x / 0.075, -0.95, 0.95)), np.interp(-y, -SECTIONS[:, 1], np.arange(N_LEVELS))
    step = 1e-5
    for _ in range(12):
        here = base(angle, level)
        by_angle = (base(angle + step, level) - here) / step
        by_level = (base(angle, level + step) - here) / step
        ex, ey = x - here[..., 0], y - here[..., 1]
        det = by_angle[..., 0] * by_level[..., 1] - by_level[..., 0] * by_angle[..., 1]
        angle = angle + (ex * by_level[..., 1] - by_level[..., 0] * ey) / det
        level = level + (by_angle[..., 0] * ey - ex * by_angle[..., 1]) / det
    return angle, level


def bumps(points: np.ndarray) -> np.ndarray:
    """Return points moved by the bumps of ``BUMPS_MM`` and by their mirror images, shape [..., 3]."""
    moved = points.copy()
    for centre, width, shift in BUMPS_MM / 1000.0:
        for side in (1.0, -1.0) if centre[0] else (1.0,):
            mirror = np.array([side, 1.0, 1.0])
            weight = np.exp(-np.sum(((points - centre * mirror) / width) ** 2, axis=-1))
            moved += weight[..., None] * shift * mirror
    return moved


def _capsule(points: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return signed distances from a row of ``NOSE_MM``, a segment with a radius at either end, shape [...] [m]."""
    start, end, radii = (np.asarray(v, float) / 1000.0 for v in part)
    along = np.clip((points - start) @ (end - start) / np.sum((end - start) ** 2), 0.0, 1.0)
    nearest = start + along[..., None] * (end - start)
    return np.linalg.norm(points - nearest, axis=-1) - (radii[0] + along * (radii[1] - radii[0]))


def _soft_min(values: list[np.ndarray], width: float) -> np.ndarray:
    """Return the smooth minimum of arrays; values that differ by less than about ``width`` are blended."""
    stack = np.stack(values)
    low = stack.min(axis=0)  # taken out of the exponentials, which then cannot overflow
    return low - width * np.log(np.exp(-(stack - low) / width).sum(axis=0))


def nose_height(points: np.ndarray) -> np.ndarray:
    """Return z of the face with its nose above the points' x and y, shape [...] [m]; sphere tracing from the front."""
    height, width = (spline(-points[..., 1] * 1000.0) / 1000.0 for spline in _nose_pyramid)
    floor = points[..., 2] + height * np.exp(-((np.abs(points[..., 0]) / width) ** 2.2))
    z = points[..., 2] + 0.045
    for _ in range(50):
        here = np.stack([np.abs(points[..., 0]), points[..., 1], z], axis=-1)
        parts = [_capsule(here, part) for part in NOSE_MM]
        # The parts of the nose are blended over a small width, the nose and the face over a larger one.
        z = z - 0.8 * _soft_min([(z - floor) * 0.8, _soft_min(parts, 0.0013)], 0.0022)
    return np.maximum(z, floor)


def lid_height(points: np.ndarray, *, width: float = 0.0016) -> np.ndarray:
    """Return z of the face with its lids, the smooth maximum of the socket and a sphere, shape [...] [m]."""
    across = np.hypot(np.abs(points[..., 0]) - EYE[0], points[..., 1] - EYE[1])
    sphere = np.sqrt(np.maximum(LID_RADIUS**2 - across**2, 0.0)) - 3.0 * np.maximum(across - LID_RADIUS, 0.0)
    return width * np.logaddexp((EYE[2] + sphere) / width, points[..., 2] / width)


def mouth_opening(x: np.ndarray) -> np.ndarray:
    """Return half the height of the mouth's opening on the sheet at each x [m]."""
    return MOUTH_HALF_HEIGHT * np.maximum(1.0 - (x / MOUTH_HALF_WIDTH) ** 2, 0.0) ** 0.7


def lip_height(x: np.ndarray, *, upper: np.ndarray) -> np.ndarray:
    """Return the height of the red of the lips at each x [m]: of the upper lip where ``upper``, else of the lower."""
    ax = np.abs(x)
    taper = np.maximum(1.0 - (ax / (MOUTH_HALF_WIDTH + 0.0015)) ** 2, 0.0)
    bow = 1.0 + 0.16 * np.exp(-(((ax - 0.0055) / 0.004) ** 2)) - 0.10 * np.exp(-((ax / 0.0028) ** 2))
    return np.where(upper, 0.0072 * taper**0.75 * bow, 0.0092 * taper**0.65)


def _close_mouth(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Close the mouth of the sheet: return the distance of its points from the mouth line and their y [m]."""
    x, dy = points[..., 0], points[..., 1] - MOUTH_Y
    distance, opening = np.abs(dy), mouth_opening(x)
    from_line = np.maximum(distance - opening * (1.0 - smoothstep(opening, MOUTH_BLEND, distance)), 0.0)
    near = 1.0 - smoothstep(0.0, MOUTH_BLEND, distance)
    droop = 0.0012 * np.exp(-(((np.abs(x) - MOUTH_HALF_WIDTH) / 0.009) ** 2)) + 0.0006 * np.exp(-((x / 0.006) ** 2))
    gap = LIP_GAP * np.clip(opening / MOUTH_HALF_HEIGHT, 0.0, 1.0)
    return from_line, MOUTH_Y - droop * near + np.where(dy >= 0.0, 1.0, -1.0) * (from_line + gap)


def _lips(points: np.ndarray) -> np.ndarray:
    """Return points of the sheet, shape [..., 3], with the mouth closed and the lips raised."""
    x, upper = points[..., 0], points[..., 1] >= MOUTH_Y
    from_line, y = _close_mouth(points)
    red = np.maximum(lip_height(x, upper=upper), 1e-4)
    across = from_line / red
    fullness = np.where(upper, 0.0034, 0.0046) * np.clip(red / np.where(upper, 0.0072, 0.0092), 0.0, 1.2)
    roll = np.sqrt(np.clip(1.0 - (across - 0.45) ** 2 / 0.34, 0.0, 1.0))
    raised = fullness * np.where(across < 1.0, roll, 0.33 * np.exp(-1.6 * np.maximum(across - 1.0, 0.0)))
    raised -= 0.0035 * np.exp(-((from_line / 0.0016) ** 2)) * (mouth_opening(x) > 0)  # the lips roll inwards
    corner = (np.abs(x) - MOUTH_HALF_WIDTH - 0.001) / 0.0045
    raised -= 0.0028 * np.exp(-(corner**2) - (from_line / 0.0050) ** 2)
    philtrum = smoothstep(0.007, 0.010, from_line) * (1.0 - smoothstep(0.015, 0.020, from_line)) * upper
    raised -= 0.0011 * np.exp(-((x / 0.0030) ** 2)) * philtrum
    out = points.copy()
    out[..., 1] = y
    out[..., 2] += raised
    return out


def _features(face: np.ndarray) -> np.ndarray:
    """Return points of the front of the head with lips, nose, lids and nostrils, shape [N, 3] [m]."""
    out = face.copy()
    mouth = (np.abs(out[:, 1] - MOUTH_Y) < MOUTH_BLEND) & (np.abs(out[:, 0]) < 0.04)
    out[mouth] = _lips(out[mouth])
    nose = (np.abs(out[:, 0]) < 0.034) & (out[:, 1] < 0.034) & (out[:, 1] > -0.030)
    height = nose_height(out[nose])
    out[nose, 1] -= 0.16 * (height - out[nose, 2])  # the tip hangs: the nose has an underside
    out[nose, 2] = height
    eye = np.hypot(np.abs(out[:, 0]) - EYE[0], out[:, 1] - EYE[1]) < 0.03
    out[eye, 2] = lid_height(out[eye])
    centre, width, shift = (np.array(v) / 1000.0 for v in NOSTRIL_MM)
    for side in (1.0, -1.0):
        offset = (out - centre * [side, 1.0, 1.0]) / width
        out += np.exp(-np.sum(offset**2, axis=1))[:, None] * shift
    return out


def surface(angle: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return points of the skin with all its features, shape [N, 3] [m].

    Args:
        angle: Angle around the head [rad], shape [N].
        level: Level, shape [N].
    """
    points = bumps(base(angle, level))
    front = np.cos(angle) > 0.2
    points[front] = _features(points[front])
    return points
