"""A garment over shoulders and upper torso, shaped around the bust of a head."""

from __future__ import annotations

import numpy as np
import torch

from mgavatar.kernels.ray_cast import RayMesh

_COLUMNS, _ROWS = 128, 80
"""Number of vertices around the body, and from the collar to the hem."""
_CLEARANCE = 0.005
"""Least distance of the cloth from the skin under it [m]."""

# Along the cloth, from the collar (0) to the hem (1): height at the front, the side and the back, from the middle of
# the eyes [m]; half the width; depth to the front and to the back of the neck's axis [m].
_KNOTS = np.array([0.0, 0.07, 0.22, 0.42, 0.60, 0.75, 1.0])
_FRONT_Y = np.array([-0.168, -0.176, -0.195, -0.225, -0.265, -0.310, -0.460])
_SIDE_Y = np.array([-0.126, -0.131, -0.143, -0.160, -0.186, -0.240, -0.460])
_BACK_Y = np.array([-0.108, -0.114, -0.135, -0.170, -0.220, -0.290, -0.460])
_WIDTH = np.array([0.058, 0.066, 0.095, 0.148, 0.190, 0.207, 0.205])
_FRONT_Z = np.array([0.030, 0.036, 0.050, 0.066, 0.082, 0.094, 0.100])
_BACK_Z = np.array([0.062, 0.068, 0.074, 0.086, 0.096, 0.102, 0.104])
_AXIS_Z = -0.082
"""z of the neck's axis, from the middle of the eyes [m]."""


def drape(head: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make a garment around the bust of a head, outside of it everywhere.

    Args:
        head: Vertices relative to the middle of the eyes [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        rng: Generator that draws build and folds.

    Returns:
        Vertices relative to the middle of the eyes [m], shape [G, 3]; faces, shape [., 3]; and 1 on the collar, 0 off
        it, smooth between, shape [G].
    """
    angle = np.arange(_COLUMNS) * (2 * np.pi / _COLUMNS)
    along = np.linspace(0.0, 1.0, _ROWS)[:, None]
    cloth = _torso(along, angle, rng)
    cloth = _clear_of_body(cloth, head, faces)
    cloth += _folds(along, angle, cloth, rng)
    collar = np.broadcast_to(np.clip((0.055 - along) / 0.01, 0.0, 1.0), cloth.shape[:2])
    inside = cloth[0] * np.array([0.86, 1.0, 1.0]) + np.array([0.0, -0.012, 0.0])
    inside[:, 2] = _AXIS_Z + 0.86 * (cloth[0, :, 2] - _AXIS_Z)
    verts = np.concatenate([inside[None], cloth])  # the collar turns inwards: no gap to the neck
    collar = np.concatenate([collar[:1], collar])
    return verts.reshape(-1, 3), _grid_faces(len(verts)), collar.reshape(-1)


def _torso(along: np.ndarray, angle: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a torso of drawn build, shape [rows, columns, 3] [m], at places along it and angles from the front."""
    broad, deep = rng.uniform([0.94, 0.95], [1.06, 1.1])
    sine, cosine = np.sin(angle), np.cos(angle)

    def at(values: np.ndarray) -> np.ndarray:
        return np.interp(along, _KNOTS, values)

    grown = np.interp(along, [0.1, 0.5], [0.0, 1.0])
    ahead = cosine > 0
    end_y = np.where(ahead, at(_FRONT_Y), at(_BACK_Y))
    depth = np.where(ahead, at(_FRONT_Z), at(_BACK_Z)) * (1.0 + (deep - 1.0) * grown)
    x = at(_WIDTH) * (1.0 + (broad - 1.0) * grown) * np.sign(sine) * np.abs(sine) ** 0.9
    y = at(_SIDE_Y) * sine**2 + end_y * cosine**2
    z = _AXIS_Z + depth * np.sign(cosine) * np.abs(cosine) ** 0.85
    return np.stack([x, y, z], axis=-1)


def _clear_of_body(cloth: np.ndarray, head: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Push the cloth away from the axis, smoothly, until it is outside of the body."""
    mesh = RayMesh(torch.from_numpy(head.astype(np.float32)), torch.from_numpy(np.array(faces, np.int32)))
    arm = cloth - np.array([0.0, 0.0, _AXIS_Z])
    arm[..., 1] = 0.0
    radius = np.linalg.norm(arm, axis=-1, keepdims=True)
    arm /= radius
    starts = cloth - arm * (radius - 0.6)  # 0.6 m from the axis: outside of any body, looking inwards
    depths, _, _ = mesh.cast(_rays(starts), _rays(-arm))
    body = 0.6 - depths.numpy().reshape(radius.shape).astype(np.float64)  # -inf where there is no body
    lack = np.maximum(body + _CLEARANCE - radius, 0.0)
    # Smooth, but never below what is lacking: each place takes the mean of its four neighbours if that is more. The
    # rows end at collar and hem, the columns go around.
    for _ in range(6):
        padded = np.pad(lack, ((1, 1), (0, 0), (0, 0)), mode="edge")
        padded = np.pad(padded, ((0, 0), (1, 1), (0, 0)), mode="wrap")
        around = padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2]
        lack = np.maximum(lack, 0.25 * around)
    for row in range(1, _ROWS):  # below the end of the bust the cloth hangs down from it
        lack[row] = np.maximum(lack[row], 0.95 * lack[row - 1])
    return cloth + lack * arm


def _rays(values: np.ndarray) -> torch.Tensor:
    """Return origins or directions as the ray caster takes them, shape [N, 3], float32."""
    return torch.from_numpy(values.reshape(-1, 3).astype(np.float32))


def _folds(along: np.ndarray, angle: np.ndarray, cloth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the offsets of creases, which hang from the shoulders and pull towards the arms, and of the collar [m]."""
    phases = rng.uniform(0.0, 2 * np.pi, 4)
    x, y, _ = np.moveaxis(cloth, -1, 0)
    hanging = np.sin(52 * x + 22 * y + phases[0] + 1.5 * np.sin(17 * y + phases[1]))
    pulled = np.sin(95 * y - 40 * np.abs(x) + phases[2] + 2.0 * np.sin(21 * x + phases[3]))
    height = 0.0022 * (0.6 * hanging + 0.5 * pulled + 1.1) * np.interp(along, [0.08, 0.3], [0.0, 1.0])
    height = height + 0.0025 * np.clip((0.055 - along) / 0.01, 0.0, 1.0)
    out = np.stack([np.broadcast_to(np.sin(angle), x.shape), 0.35 + 0 * x, np.broadcast_to(np.cos(angle), x.shape)], -1)
    return height[..., None] * out


def _grid_faces(rows: int) -> np.ndarray:
    """Return two triangles per cell of a grid that is closed along its columns, shape [., 3]."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(_COLUMNS), indexing="ij")
    right = (column + 1) % _COLUMNS
    a, b = row * _COLUMNS + column, row * _COLUMNS + right
    c, d = a + _COLUMNS, b + _COLUMNS
    return np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
