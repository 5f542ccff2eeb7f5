"""Identity directions of the built-in head: named proportions first, then smooth band-limited fields."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import solve_triangular

from mgavatar.head.procedural import surface as form
from mgavatar.head.procedural.mesh import HeadMesh
from mgavatar.head.procedural.surface import smoothstep

Array = np.ndarray
Field = Callable[[Array], Array]

N_SHAPE = 300
SEED = 20
CENTRE = np.array([0.0, 0.02, -0.045])
"""Middle of the head [m]."""


def _spread(scale: tuple[float, float, float]) -> Field:
    """Return a field that scales the head about its middle along the axes."""
    return lambda p: (p - CENTRE) * np.array(scale)


def _within(field: Field, y: tuple[float, float, float, float]) -> Field:
    """Restrict a field to heights [mm]: it rises from the first to the second, falls from the third to the fourth."""
    a, b, c, d = (v / 1000.0 for v in y)
    return lambda p: field(p) * (smoothstep(a, b, p[:, 1]) * (1.0 - smoothstep(c, d, p[:, 1])))[:, None]


def _front(field: Field) -> Field:
    """Restrict a field to the front of the head."""
    return lambda p: field(p) * smoothstep(-0.05, 0.02, p[:, 2])[:, None]


def _bell(centre: tuple[float, ...], width: tuple[float, ...], shift: tuple[float, ...]) -> Field:
    """Return a field that moves a bell around ``centre`` [mm] by ``shift``, and its mirror image symmetrically."""

    def field(p: Array) -> Array:
        out = np.zeros_like(p)
        for side in (1.0, -1.0) if centre[0] else (1.0,):
            mirror = np.array([side, 1.0, 1.0])
            offset = (p - np.array(centre) / 1000.0 * mirror) / (np.array(width) / 1000.0)
            out += np.exp(-np.sum(offset**2, axis=1))[:, None] * np.array(shift) * mirror
        return out

    return field


def _sum(*fields: Field) -> Field:
    """Add up fields."""
    return lambda p: np.sum([f(p) for f in fields], axis=0)


def _skew(shift: tuple[float, float, float], axis: int, width: float) -> Field:
    """Return a field that shifts both sides of the middle in opposite directions; ``axis`` tells the sides apart."""
    return lambda p: np.tanh((p[:, axis : axis + 1] - CENTRE[axis]) / width) * np.array(shift)


# In the order of their size: AMPLITUDE_MM has the first ones.
NAMED: tuple[tuple[str, Field], ...] = (
    ("size", _spread((1, 1, 1))),
    ("head_width", _within(_spread((1, 0, 0)), (-120, -80, 300, 301))),
    (
        "face_length",
        _sum(
            _within(_spread((0, 1, 0)), (-150, -100, 300, 301)),
            _bell((0, -85, 20), (60, 30, 60), (0, -0.03, 0)),
        ),
    ),
    ("depth", _within(_spread((0, 0, 1)), (-120, -80, 300, 301))),
    ("jaw_width", _within(_spread((1, 0, 0)), (-115, -85, -55, 0))),
    ("face_width", _front(_within(_spread((1, 0, 0)), (-80, -40, 30, 60)))),
    ("neck_width", _within(_spread((1, 0, 1)), (-180, -150, -115, -80))),
    ("shoulders", _within(_spread((1, 0.2, 0.4)), (-400, -300, -185, -140))),
    ("skull_height", _bell((0, 140, -45), (80, 50, 90), (0, 1, 0))),
    ("skull_back", _bell((0, 40, -135), (70, 60, 50), (0, 0, -1))),
    ("chin", _bell((0, -82, 40), (30, 24, 40), (0, -0.5, 1))),
    ("nose_length", _bell((0, -14, 62), (16, 16, 26), (0, -0.4, 1))),
    ("cheeks", _bell((44, -28, 18), (20, 26, 30), (1, 0, 0.6))),
    ("brow", _bell((24, 43, 42), (24, 12, 24), (0, -0.2, 1))),
    ("nose_width", _bell((11, -17, 50), (9, 10, 16), (1, 0, 0.1))),
    ("ears_out", _bell((80, 3, -58), (20, 36, 26), (1, 0, 0.2))),
    ("ears_height", _bell((80, 22, -58), (20, 26, 26), (0.1, 1, -0.2))),
    ("mouth_width", _bell((24, -48, 36), (14, 14, 24), (1, 0, -0.2))),
    ("lips", _sum(_bell((0, -42, 48), (22, 6, 20), (0, 0.6, 1)), _bell((0, -53, 48), (22, 6, 20), (0, -0.6, 1)))),
    ("mouth_height", _bell((0, -47, 46), (34, 16, 30), (0, 1, 0))),
    ("chin_narrow", _bell((18, -84, 34), (14, 16, 26), (-1, 0, 0))),
    ("cheekbones", _bell((50, 0, 14), (18, 14, 30), (1, 0.2, 0.8))),
    ("forehead", _bell((0, 78, 44), (50, 32, 40), (0, 0, 1))),
    ("nose_bridge", _bell((0, 10, 54), (10, 18, 24), (0, 0, 1))),
    ("nose_tip", _bell((0, -14, 66), (12, 10, 18), (0, 1, 0.3))),
    ("eyes_apart", _bell((30, 23, 30), (22, 20, 30), (1, 0, 0))),
    ("eyes_deep", _bell((30, 23, 30), (20, 16, 30), (0, 0, -1))),
    ("lean", _skew((1, 0, 0), 1, 0.08)),
    ("one_side_lower", _front(_within(_skew((0, 1, 0), 0, 0.04), (-110, -80, 50, 90)))),
    ("one_side_wider", lambda p: smoothstep(-0.02, 0.08, np.abs(p[:, 0]))[:, None] * np.array([1.0, 0, 0])),
    ("nose_aside", _bell((0, -10, 60), (13, 22, 24), (1, 0, 0))),
    ("chin_aside", _bell((0, -82, 36), (30, 24, 40), (1, 0, 0))),
)  # fmt: skip
AMPLITUDE_MM = (2.0, 1.6, 1.5, 1.3, 1.1, 1.0, 0.9, 0.8, 0.8, 0.75)
"""Root mean square of the first directions over all vertices [mm]."""
LARGEST_MM = 7.0, 2.6
"""Largest motion of a vertex per standard deviation [mm]: of the first directions, of the others."""


def _waves(rng: np.random.Generator, wavelength: float, *, symmetric: bool) -> Field:
    """Draw a vector field of six plane waves of one wavelength [m]."""
    directions = rng.normal(size=(6, 3))
    directions *= 2 * np.pi / wavelength / np.linalg.norm(directions, axis=1, keepdims=True)
    phases, amplitudes = rng.uniform(0, 2 * np.pi, 6), rng.normal(size=(6, 3))
    flip = np.array([-1.0, 1.0, 1.0])

    def field(p: Array) -> Array:
        out = np.cos(p @ directions.T + phases) @ amplitudes
        if symmetric:
            out = out + (np.cos((p * flip) @ directions.T + phases) @ amplitudes) * flip
        return out

    return field


def _fields() -> list[Field]:
    """Return 300 fields: the named ones, then waves from 30 cm down to 5 cm, every third of them asymmetric."""
    rng = np.random.default_rng(SEED)
    fields = [field for _, field in NAMED]
    n_waves = N_SHAPE - len(fields)
    for i in range(n_waves):
        wavelength = 0.30 * (0.05 / 0.30) ** (i / (n_waves - 1))
        fields.append(_waves(rng, wavelength, symmetric=i % 3 != 2))
    return fields


def identity_directions(mesh: HeadMesh) -> Array:
    """Return orthogonal identity directions, shape [V, 3, 300] [m]; a coefficient of 1 is one standard deviation.

    Near each eye, a field is replaced by its value in the eye's centre, so that the lids keep fitting the eyeball.
    """
    verts = mesh.verts
    at = np.where(verts[:, :1] > 0, 1.0, -1.0) * [form.EYE[0], 0.0, 0.0] + [0.0, form.EYE[1], form.EYE[2]]
    distance = np.linalg.norm(verts - at, axis=1)
    held = 1.0 - smoothstep(0.0165, 0.028, distance)
    held[mesh.part == "eye"] = 1.0
    raw = np.stack([f(verts) * (1 - held[:, None]) + f(at) * held[:, None] for f in _fields()], axis=-1)
    flat = raw.reshape(-1, N_SHAPE)
    # Gram and Schmidt: each field loses its part in the span of the fields before it. With the Cholesky factor
    # flat.T @ flat = L @ L.T, the columns of flat @ inv(L).T are the orthonormal ones, in the same order.
    q = solve_triangular(np.linalg.cholesky(flat.T @ flat), flat.T, lower=True).T
    rms = 0.22 * (len(NAMED) / np.maximum(np.arange(N_SHAPE), len(NAMED))) ** 0.9
    rms[: len(NAMED)] = 0.7
    rms[: len(AMPLITUDE_MM)] = AMPLITUDE_MM
    directions = (q * np.sqrt(len(verts))).reshape(raw.shape)
    limit = np.where(np.arange(N_SHAPE) < len(AMPLITUDE_MM), *LARGEST_MM)
    scale = np.minimum(rms, limit / np.linalg.norm(directions, axis=1).max(axis=0))
    # Rounded to 10 nanometres: sums in another order (threads, machines) then give the same bits.
    return np.round(directions * scale / 1000.0, 8)
