"""Maps from ARKit's blendshapes to a head's own expression directions, jaw and eyes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mgavatar.driving.arkit import ARKIT_NAMES, arkit_name
from mgavatar.errors import DataError
from mgavatar.files import atomic_write, existing_file, float_array, npz_names, one_line, read_npy, read_npz
from mgavatar.head.model import HeadModel

LOOK_SIDEWAYS = np.radians(30.0)
"""Turn of an eye at ``eyeLookIn`` or ``eyeLookOut`` of 1 [rad]."""

LOOK_UP_OR_DOWN = np.radians(25.0)

JAW_OPEN = 0.36
"""Turn of the jaw joint at ``jawOpen`` of 1 [rad]; that of ICT-FaceKit's shape is 20.8 degrees."""

FEWEST_NAMES = 20
"""A head with fewer directions under ARKit's names is mapped by its surface instead."""

FLAME_COLUMNS = 103
"""Columns of the public maps to FLAME: 100 expressions and the jaw."""


@dataclass(frozen=True, eq=False)
class ExpressionMap:
    """Coefficients and joints of one head for each blendshape, fully on; several add up.

    Attributes:
        names: Blendshapes in ARKit's spelling, N of them.
        expr: Expression coefficients, shape [N, E], float32.
        jaw: Rotation vectors of the jaw joint [rad], shape [N, 3].
        eyes: Rotation vectors of left and right eye [rad], shape [N, 6].
        residual_mm: Mean distance between the wanted motion and the head's own over the vertices that move [mm], shape
            [N]; NaN where nothing was measured.
    """

    names: tuple[str, ...]
    expr: np.ndarray
    jaw: np.ndarray
    eyes: np.ndarray
    residual_mm: np.ndarray

    @property
    def unmapped(self) -> tuple[str, ...]:
        """Return the blendshapes that do nothing on this head."""
        moves = np.concatenate([self.expr, self.jaw, self.eyes], axis=1).any(axis=1)
        return tuple(self.names[row] for row in np.flatnonzero(~moves))

    def apply(self, names: Sequence[str], weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what weights of blendshapes set on the head.

        Args:
            names: Blendshapes in ARKit's spelling, M of them; those that the map lacks do nothing.
            weights: Shape [T, M].

        Returns:
            Expression coefficients [T, E], jaw [T, 3] and eyes [T, 6], float32. The jaw does not close further than
            shut: ``mouthClose`` undoes ``jawOpen`` and no more.
        """
        row_of = {name: row for row, name in enumerate(self.names)}
        known = [(column, row_of[name]) for column, name in enumerate(names) if name in row_of]
        columns, rows = [column for column, _ in known], [row for _, row in known]
        used = weights[:, columns]
        expr, jaw, eyes = (used @ part[rows] for part in (self.expr, self.jaw, self.eyes))
        jaw[:, 0] = np.maximum(jaw[:, 0], 0.0)
        return expr.astype(np.float32), jaw.astype(np.float32), eyes.astype(np.float32)


def gaze() -> np.ndarray:
    """Return the rotations of both eyes at each of ARKit's blendshapes [rad], shape [52, 6]."""
    eyes = np.zeros((len(ARKIT_NAMES), 6), np.float32)
    for side, column, outwards in (("Left", 0, 1.0), ("Right", 3, -1.0)):
        turns = {
            f"eyeLookUp{side}": (0, -LOOK_UP_OR_DOWN),  # a positive turn about x looks down
            f"eyeLookDown{side}": (0, LOOK_UP_OR_DOWN),
            f"eyeLookOut{side}": (1, outwards * LOOK_SIDEWAYS),  # a positive turn about y looks to the subject's left
            f"eyeLookIn{side}": (1, -outwards * LOOK_SIDEWAYS),
        }
        for name, (axis, angle) in turns.items():
            eyes[ARKIT_NAMES.index(name), column + axis] = angle
    return eyes


# Directions of the built-in head for ARKit's blendshapes; a pair has its left half here, and its right half mirrors it.
# A name with an underscore at its end stands for its direction on the blendshape's side.
BUILTIN_DIRECTIONS: dict[str, dict[str, float]] = {
    "browDownLeft": {"brow_down_": 1.0},
    "browInnerUp": {"brow_inner_up_L": 1.0, "brow_inner_up_R": 1.0},
    "browOuterUpLeft": {"brow_outer_up_": 1.2},
    "cheekPuff": {
        "cheek_puff_L": 1.4,
        "cheek_puff_R": 1.4,
        "cheek_30_30_L": 1.5,
        "cheek_30_30_R": 1.5,
        "cheek_46_34_L": 1.5,
        "cheek_46_34_R": 1.5,
    },
    "cheekSquintLeft": {"cheek_raise_": 1.4},
    "eyeBlinkLeft": {"blink_": 1.0},
    "eyeSquintLeft": {"squint_": 1.2},
    "eyeWideLeft": {"wide_": 1.5},
    "jawForward": {"jaw_forward": 1.7},
    "jawLeft": {"jaw_left": 1.3},
    "mouthDimpleLeft": {"dimple_": 1.0, "upper_lip_21_y_": 1.2, "lower_lip_21_y_": 1.2},
    "mouthFrownLeft": {"frown_": 0.8},
    "mouthFunnel": {"funnel": 1.2},
    "mouthLeft": {"mouth_left": 2.0},
    "mouthLowerDownLeft": {"lower_lip_depress_": 0.9},
    "mouthPressLeft": {"lower_lip_13_y_": 0.7, "lower_lip_21_y_": 0.9, "chin_side_": 0.8, "cheek_30_30_": 0.6},
    "mouthPucker": {"pucker": 1.3},
    "mouthRollLower": {"lower_lip_roll": 2.0},
    "mouthRollUpper": {"upper_lip_roll": 2.0},
    "mouthShrugLower": {
        "chin_raise": 1.5,
        "lower_lip_5_y_L": 1.2,
        "lower_lip_5_y_R": 1.2,
        "lower_lip_13_y_L": 0.8,
        "lower_lip_13_y_R": 0.8,
    },
    "mouthShrugUpper": {
        "upper_lip_5_y_L": 1.3,
        "upper_lip_5_y_R": 1.3,
        "upper_lip_13_y_L": 0.9,
        "upper_lip_13_y_R": 0.9,
    },
    "mouthSmileLeft": {"smile_": 1.4},
    "mouthStretchLeft": {"lip_stretch_": 1.3},
    "mouthUpperUpLeft": {"upper_lip_raise_": 1.3},
    "noseSneerLeft": {"nose_sneer_": 1.8, "nostril_flare_": 0.5, "cheek_25_10_": 1.0},
}

BUILTIN_JAW = {"jawOpen": JAW_OPEN, "mouthClose": -0.9 * JAW_OPEN}
"""Turns of the built-in head's jaw joint [rad]; it has no direction that closes the lips of an open jaw."""


def map_by_names(model: HeadModel) -> ExpressionMap | None:
    """Return the map onto a head whose directions have names that are understood, or None.

    Understood are the built-in head's own names, and ARKit's in any spelling (``eyeBlink_L``). Blendshapes of both
    sides, such as ``browInnerUp``, drive both halves of a pair (``browInnerUp_L``, ``browInnerUp_R``). Where there is a
    direction for ``jawOpen``, the jaw joint does not move, so that the mouth does not open twice.
    """
    names = model.expr_names
    if {"blink_L", "smile_L", "jaw_open"} <= set(names):
        return _built_in(names)
    expr = np.zeros((len(ARKIT_NAMES), model.n_expr), np.float32)
    for column, name in enumerate(names):
        own = arkit_name(name) or arkit_name(name.removesuffix("_L").removesuffix("_R"))
        if own is not None:
            expr[ARKIT_NAMES.index(own), column] = 1.0
    if np.count_nonzero(expr.any(axis=1)) < FEWEST_NAMES:
        return None
    jaw = np.zeros((len(ARKIT_NAMES), 3), np.float32)
    if not expr[ARKIT_NAMES.index("jawOpen")].any():
        jaw[ARKIT_NAMES.index("jawOpen"), 0] = JAW_OPEN
    return ExpressionMap(ARKIT_NAMES, expr, jaw, gaze(), np.full(len(ARKIT_NAMES), np.nan, np.float32))


def _built_in(names: tuple[str, ...]) -> ExpressionMap:
    """Return the map onto the built-in head."""
    column_of = {name: column for column, name in enumerate(names)}
    expr = np.zeros((len(ARKIT_NAMES), len(names)), np.float32)
    for name, directions in built_in_directions().items():
        for direction, weight in directions.items():
            expr[ARKIT_NAMES.index(name), column_of[direction]] = weight
    jaw = np.zeros((len(ARKIT_NAMES), 3), np.float32)
    for name, angle in BUILTIN_JAW.items():
        jaw[ARKIT_NAMES.index(name), 0] = angle
    return ExpressionMap(ARKIT_NAMES, expr, jaw, gaze(), np.full(len(ARKIT_NAMES), np.nan, np.float32))


def built_in_directions() -> dict[str, dict[str, float]]:
    """Return the built-in head's directions for each of ARKit's blendshapes, of both sides."""
    table = {}
    for name, directions in BUILTIN_DIRECTIONS.items():
        table[name] = {_on_side(direction, "L"): weight for direction, weight in directions.items()}
        if name.endswith("Left"):
            mirrored = {_on_side(direction, "R"): weight for direction, weight in directions.items()}
            table[name.removesuffix("Left") + "Right"] = mirrored
    return table


def _on_side(direction: str, side: str) -> str:
    if direction.endswith("_"):
        return direction + side
    if side == "R" and direction in ("mouth_left", "jaw_left"):
        return direction.replace("left", "right")
    return direction


def write_expression_map(path: Path, mapped: ExpressionMap, *, notes: Mapping[str, np.ndarray] | None = None) -> None:
    """Write a map as ``.npz``; atomic.

    Args:
        path: The file.
        mapped: The map.
        notes: More arrays to keep in it.

    Raises:
        DataError: If the file cannot be written.
    """
    arrays = {
        "names": np.array(mapped.names),
        "expr": mapped.expr,
        "jaw": mapped.jaw,
        "eyes": mapped.eyes,
        "residual_mm": mapped.residual_mm,
    }
    with atomic_write(path) as file:
        np.savez_compressed(file, **arrays, **(notes or {}))  # type: ignore[arg-type]


def read_expression_map(path: Path | str, *, n_expr: int) -> ExpressionMap:
    """Read a map from ARKit's blendshapes to a head.

    Args:
        path: ``.npz`` with ``names``, ``expr``, ``jaw``, ``eyes`` and ``residual_mm`` (all but the first two may be
            absent), or a single array (``.npy``, or the only one of an ``.npz``) of 51 or 52 rows and 103 columns: 100
            expressions and the jaw of FLAME. Its rows are ARKit's blendshapes in alphabetical order, ``tongueOut`` last
            or absent, or MediaPipe's, ``_neutral`` first.
        n_expr: Number of the head's expression directions.

    Raises:
        DataError: If the file is no such map, or if it has another number of directions than the head.
    """
    path = existing_file(Path(path))
    names = npz_names(path)
    if {"names", "expr"} <= names:
        return _of_arrays(path, n_expr=n_expr)
    if len(names) == 1:
        (name,) = names
        return _of_matrix(read_npz(path, wanted=lambda key: key == name).arrays[name], path=path, n_expr=n_expr)
    if names:
        raise DataError(f"{path}: no expression map, which has names and expr, or one array of 52 x {FLAME_COLUMNS}")
    return _of_matrix(read_npy(path), path=path, n_expr=n_expr)


def _of_arrays(path: Path, *, n_expr: int) -> ExpressionMap:
    arrays = read_npz(path, wanted=lambda key: key in ("names", "expr", "jaw", "eyes", "residual_mm")).arrays
    names = arrays["names"]
    if names.ndim != 1 or names.dtype.kind != "U":
        raise DataError(f"{path}: names must be a list of text")
    own = [arkit_name(str(name)) for name in names]
    if None in own or len(set(own)) != len(own):
        wrong = next((name for name, known in zip(names, own, strict=True) if known is None), "one of them")
        raise DataError(f"{path}: names: {one_line(wrong, limit=40)} is none of ARKit's blendshapes, or there twice")
    n = len(names)
    parts = {key: _part(arrays, key, (n, width), path=path) for key, width in (("jaw", 3), ("eyes", 6))}
    expr = _part(arrays, "expr", (n, n_expr), path=path)
    residual = arrays.get("residual_mm")
    if residual is None or residual.shape != (n,) or residual.dtype.kind != "f":
        residual = np.full(n, np.nan)
    return ExpressionMap(tuple(str(name) for name in own), expr, **parts, residual_mm=residual.astype(np.float32))


def _part(arrays: dict[str, np.ndarray], key: str, shape: tuple[int, int], *, path: Path) -> np.ndarray:
    if key not in arrays:
        return np.zeros(shape, np.float32)
    value = float_array(arrays[key], where=f"{path}: {key}")
    if value.shape != shape:
        raise DataError(f"{path}: {key} has shape {value.shape}, {shape} is needed: names by this head's directions")
    return value


def _of_matrix(value: np.ndarray, *, path: Path, n_expr: int) -> ExpressionMap:
    matrix = float_array(value, where=f"{path}: its array")
    rows = matrix.shape[0] if matrix.ndim == 2 else 0
    if rows not in (51, 52) or matrix.shape[1] != FLAME_COLUMNS:
        raise DataError(
            f"{path}: has shape {matrix.shape}; a map without names has 51 or 52 rows of ARKit's blendshapes and "
            f"{FLAME_COLUMNS} columns, 100 expressions and the jaw of FLAME"
        )
    if n_expr < FLAME_COLUMNS - 3 and matrix[:, n_expr:-3].any():
        raise DataError(f"{path}: is a map to FLAME's 100 expressions, but the head has {n_expr} directions")
    if rows == 52 and not matrix[0].any():
        matrix = matrix[1:]  # MediaPipe's _neutral
    names = ARKIT_NAMES[: len(matrix)]
    expr = np.zeros((len(names), n_expr), np.float32)
    expr[:, : FLAME_COLUMNS - 3] = matrix[:, : min(n_expr, FLAME_COLUMNS - 3)]
    return ExpressionMap(names, expr, matrix[:, -3:], gaze()[: len(names)], np.full(len(names), np.nan, np.float32))


def listed(names: Iterable[str], *, most: int = 5) -> str:
    """Return names in a row for a message, cut after some."""
    names = list(names)
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")
