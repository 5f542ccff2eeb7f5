"""Computing a map from ARKit's blendshapes to the expression directions of any head.

The built-in head's motion for each blendshape is carried to the other head (:mod:`mgavatar.driving.face_transfer`).
Heads are of two kinds. A rig has a direction for each of many expressions; where one of them alone explains the
carried motion nearly as well as all together, it is the rig's own version of that blendshape and is taken as it is,
fully on. The directions of a statistical model such as FLAME mean nothing by themselves; their coefficients are those
of regularised least squares. ``jawOpen`` goes into the jaw joint and ``eyeLook*`` into the eyes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from mgavatar.driving.arkit import ARKIT_NAMES, is_arkit
from mgavatar.driving.expression_map import (
    JAW_OPEN,
    ExpressionMap,
    built_in_directions,
    gaze,
    map_by_names,
    read_expression_map,
    write_expression_map,
)
from mgavatar.driving.face_transfer import jaw_motion, joints_of, register_face
from mgavatar.driving.motion import Driving
from mgavatar.errors import DataError
from mgavatar.files import read_npz
from mgavatar.head.model import HeadModel
from mgavatar.head.procedural.build import build_head

Array = np.ndarray

VERSION = 1
"""Raise it when maps change for another reason than the tables: maps kept beside avatars are then computed anew."""

LIDS = {
    "eyeLookDownLeft": {"upper_lid_up_L": -1.8},
    "eyeLookDownRight": {"upper_lid_up_R": -1.8},
    "eyeLookUpLeft": {"upper_lid_up_L": 1.2},
    "eyeLookUpRight": {"upper_lid_up_R": 1.2},
}
"""Lids that follow the gaze; the built-in head moves them with its eyes by correctives of its own."""

CLOSED = 0.9
"""Part of the jaw's opening that ``mouthClose`` undoes at the lips."""

LIP_REACH = 0.018
"""Width of the bell around the lips in which ``mouthClose`` acts [m]."""

COEFFICIENT_COST = 1e-4
"""Mean distance [m] that is worth as much as one coefficient of 1 in the least squares."""

JAW_COST = 1e-3
"""The same for the jaw, per radian."""

RIG = 0.6
"""Median part of what all directions explain that single ones explain alone from which a head is a rig: about 0.8 on
ICT-FaceKit, and 0.33 on mixtures of its directions as a statistical model has them."""

ALONE = 0.35
"""Least such part for the direction of one blendshape on a rig."""

AMPLITUDES = (0.2, 4.0)
"""Largest carried motion over that of a rig's direction within which 1 is taken for fully on."""

MOVING = 0.1
"""Vertices move if their motion is more than this part of the largest."""

MIRRORED = 0.8
"""Least cosine between a direction and the mirror image of its partner."""

MIRROR_X = np.array([-1.0, 1.0, 1.0])

TO_MM = 1e3


def map_expressions(model: HeadModel, *, progress: Callable[[int, int], None] | None = None) -> ExpressionMap:
    """Compute the map from ARKit's 52 blendshapes to a head, by its surface alone: names are not looked at.

    Args:
        model: The head, in metres and FLAME's axes, with a neutral face; it may be without a working jaw.
        progress: Called with the number of blendshapes done and their total.

    Returns:
        The map, with the mean distance between the carried motion and the head's own over the vertices that move.

    Raises:
        DataError: If the head has no face that the built-in one can be registered with.
    """
    source = build_head()
    transfer = register_face(source, model)
    wanted = {name: transfer.carry(motion) for name, motion in named_motion(source).items()}
    directions = transfer.sample(model.shapedirs[:, :, model.n_shape :].astype(np.float64))
    has_jaw = bool(transfer.sample(model.lbs_weights[:, 2]).max() > 0.3)
    places = transfer.sample(model.v_template.astype(np.float64))
    own = _own_directions(wanted, directions, places, without={"jawOpen"} if has_jaw else set())
    n = len(ARKIT_NAMES)
    expr, jaw = np.zeros((n, model.n_expr)), np.zeros((n, 3))
    residual = np.full(n, np.nan)
    solver = _LeastSquares(directions, transfer.sample(jaw_columns(model)))
    for row, name in enumerate(ARKIT_NAMES):
        if name in wanted:
            if name == "jawOpen" and has_jaw:
                jaw[row, 0] = JAW_OPEN
            elif name in own:
                expr[row] = own[name]
            elif name == "mouthClose" and has_jaw:
                jaw[row, 0] = -CLOSED * JAW_OPEN
            else:
                expr[row], jaw[row] = solver(wanted[name], with_jaw=has_jaw and name.startswith("jaw"))
            made = directions @ expr[row] + transfer.sample(jaw_motion(model, jaw[row]))
            residual[row] = TO_MM * _mean_distance(made, wanted[name])
        if progress is not None:
            progress(row + 1, n)
    has_eyes = bool((model.lbs_weights[:, 3:].max(axis=0) > 0.5).all())
    return ExpressionMap(
        ARKIT_NAMES,
        expr.astype(np.float32),
        jaw.astype(np.float32),
        gaze() if has_eyes else np.zeros((n, 6), np.float32),
        residual.astype(np.float32),
    )


@lru_cache(maxsize=2)
def computed_map(model: HeadModel) -> ExpressionMap:
    """Return :func:`map_expressions` of a head, computed once."""
    return map_expressions(model)


def map_for(
    driving: Driving, model: HeadModel, *, given: Path | None, avatar: Path
) -> tuple[ExpressionMap | None, str | None]:
    """Return the map that a motion needs on a head, and a line for the user if it was computed.

    Args:
        driving: The motion.
        model: The head.
        given: File of a map, or None to take the one kept beside the avatar, or to compute it.
        avatar: File of the avatar, or the folder of its fit.

    Returns:
        The map; None if the motion has no blendshapes, or if the head's names say where they go.

    Raises:
        DataError: If the file given is no map to this head, or if none can be computed.
    """
    if given is not None:
        return read_expression_map(given, n_expr=model.n_expr), None
    if not is_arkit(driving) or map_by_names(model) is not None:
        return None, None
    file = avatar / "avatar.pt" if avatar.is_dir() else avatar
    return kept_map(model, file.with_suffix(".expression_map.npz"))


def kept_map(model: HeadModel, path: Path) -> tuple[ExpressionMap, str | None]:
    """Return the map of a head from a file, or compute it and keep it there.

    A file of another head, of another version of the tables here, or a damaged one is computed anew.

    Args:
        model: The head.
        path: The file; if it cannot be written, the map is not kept.

    Returns:
        The map, and a line for the user if it was computed.

    Raises:
        DataError: As :func:`map_expressions`.
    """
    own = np.array(_fingerprint(model))
    try:
        if path.exists() and read_npz(path, wanted=lambda key: key == "head").arrays.get("head") == own:
            return read_expression_map(path, n_expr=model.n_expr), None
    except DataError:
        pass
    mapped = computed_map(model)
    try:
        write_expression_map(path, mapped, notes={"head": own})
    except DataError as error:
        return mapped, f"the map from ARKit's blendshapes to {model.name} is computed, but not kept: {error}"
    return mapped, f"the map from ARKit's blendshapes to {model.name} is computed and kept in {path}"


def _fingerprint(model: HeadModel) -> str:
    """Return a digest of what a map depends on: the head, and the motion of the built-in one."""
    digest = hashlib.sha256(repr((VERSION, built_in_directions(), LIDS, JAW_OPEN)).encode())
    for array in (model.v_template, model.faces, model.shapedirs, model.lbs_weights, model.J_regressor):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def named_motion(source: HeadModel) -> dict[str, Array]:
    """Return the motion of the built-in head's vertices at each blendshape, fully on [m], shape [V, 3].

    Args:
        source: The built-in head.
    """
    column_of = {name: source.n_shape + column for column, name in enumerate(source.expr_names)}
    motion = {}
    for name, table in (built_in_directions() | LIDS).items():
        motion[name] = sum(
            weight * source.shapedirs[:, :, column_of[direction]].astype(np.float64)
            for direction, weight in table.items()
        )
    opened = jaw_motion(source, np.array([JAW_OPEN, 0.0, 0.0]))
    lips = source.v_template[source.masks["lips"]]
    middle = lips.mean(axis=0)
    beside = np.abs(source.v_template[:, 0]) - np.abs(lips[:, 0]).max()
    away = np.linalg.norm(source.v_template[:, 1:] - middle[1:], axis=1)
    bell = np.exp(-((away / LIP_REACH) ** 2) - (np.maximum(beside, 0.0) / LIP_REACH) ** 2)
    return motion | {"jawOpen": opened, "mouthClose": -CLOSED * bell[:, None] * opened}


def jaw_columns(model: HeadModel) -> Array:
    """Return the motion of a head's vertices per radian of the jaw about x, y and z [m], shape [V, 3, 3]."""
    arm = model.v_template - joints_of(model)[2]
    axes = np.eye(3)
    return np.stack([model.lbs_weights[:, 2:3] * np.cross(axis, arm) for axis in axes], axis=-1)


class _LeastSquares:
    """Coefficients and jaw whose motion is nearest to a given one, at a cost."""

    def __init__(self, directions: Array, jaw: Array) -> None:
        self._n_expr = directions.shape[2]
        self._root = 1.0 / np.sqrt(len(directions))  # squares of the columns are means over the points
        columns = np.concatenate([directions, jaw], axis=2) * self._root
        self._columns = columns.reshape(-1, columns.shape[2])
        self._gram = self._columns.T @ self._columns
        self._cost = np.diag([COEFFICIENT_COST**2] * self._n_expr + [JAW_COST**2] * 3)

    def __call__(self, motion: Array, *, with_jaw: bool) -> tuple[Array, Array]:
        """Return coefficients [E] and the jaw's rotation vector [3]."""
        used = self._n_expr + (3 if with_jaw else 0)
        right = self._columns.T @ (motion * self._root).ravel()
        solved = np.zeros(self._n_expr + 3)
        solved[:used] = np.linalg.solve((self._gram + self._cost)[:used, :used], right[:used])
        return solved[: self._n_expr], solved[self._n_expr :]

    def explained(self, motion: Array) -> float:
        """Return the part of a motion's length that all directions explain together, 0..1."""
        goal = (motion * self._root).ravel()
        expr, _ = self(motion, with_jaw=False)
        reached = self._columns[:, : self._n_expr] @ expr
        return float(reached @ goal / max(np.linalg.norm(reached) * np.linalg.norm(goal), 1e-20))


def _mean_distance(made: Array, goal: Array) -> float:
    """Return the mean distance between two motions over the points that one of them moves [m]."""
    size = np.maximum(np.linalg.norm(made, axis=1), np.linalg.norm(goal, axis=1))
    moving = size > MOVING * size.max()
    return float(np.linalg.norm(made - goal, axis=1)[moving].mean())


def _own_directions(
    wanted: dict[str, Array], directions: Array, places: Array, *, without: set[str]
) -> dict[str, Array]:
    """Return the coefficients of the blendshapes for which a rig has a direction of its own, or a mirrored pair.

    Args:
        wanted: Carried motion of each blendshape [m], shape [n, 3].
        directions: Motion of the head's directions [m], shape [n, 3, E].
        places: Rest places of the points [m], shape [n, 3].
        without: Blendshapes that are not looked for.

    Returns:
        Coefficients of 0 and 1 by blendshape; nothing if most blendshapes have no direction of their own.
    """
    names = [name for name in wanted if name not in without]
    goals = np.stack([wanted[name].ravel() for name in names])
    candidates = _candidates(directions, places)
    made = (directions @ candidates.T).reshape(goals.shape[1], -1).T
    products = goals @ made.T
    sizes = np.linalg.norm(made, axis=1)
    alike = products / np.maximum(np.linalg.norm(goals, axis=1)[:, None] * sizes, 1e-20)
    largest, own_largest = (_largest(motion) for motion in (goals, made))
    amplitudes = largest[:, None] / np.maximum(own_largest, 1e-20)
    alike[(amplitudes < AMPLITUDES[0]) | (amplitudes > AMPLITUDES[1])] = 0.0
    sided = np.array([name.endswith(("Left", "Right")) for name in names])
    alike[np.ix_(sided, candidates.sum(axis=1) > 1.0)] = 0.0  # pairs are for blendshapes of both sides
    solver = _LeastSquares(directions, np.zeros((*directions.shape[:2], 3)))
    together = np.array([solver.explained(wanted[name]) for name in names])
    share = alike / np.maximum(together[:, None], 1e-6)
    rows, columns = _assigned(share, candidates)
    if not len(rows) or np.median(share[rows, columns]) < RIG:
        return {}
    return {
        names[row]: candidates[column] for row, column in zip(rows, columns, strict=True) if share[row, column] > ALONE
    }


def _largest(motion: Array) -> Array:
    """Return the largest motion of a point in each row, shape [n, 3 p] to [n]."""
    return np.linalg.norm(motion.reshape(len(motion), -1, 3), axis=2).max(axis=1)


def _assigned(share: Array, candidates: Array) -> tuple[Array, Array]:
    """Return rows and columns of the best assignment in which no direction is used twice, alone and in a pair."""
    share = share.copy()
    while True:
        rows, columns = linear_sum_assignment(share, maximize=True)
        used = candidates[columns].sum(axis=0)
        twice = np.flatnonzero(used > 1.0)
        if not len(twice):
            return rows, columns
        rivals = np.flatnonzero(candidates[columns][:, twice[0]] > 0.0)
        loser = rivals[np.argmin(share[rows[rivals], columns[rivals]])]
        share[rows[loser], columns[loser]] = -1.0


def _candidates(directions: Array, places: Array) -> Array:
    """Return the coefficients of single directions and of pairs that mirror each other, shape [n, E]."""
    n_expr = directions.shape[2]
    mirror = cKDTree(places).query(places * MIRROR_X)[1]
    mirrored = directions[mirror] * MIRROR_X[:, None]
    flat, other = directions.reshape(-1, n_expr), mirrored.reshape(-1, n_expr)
    sizes = np.linalg.norm(flat, axis=0) * np.linalg.norm(other, axis=0)[:, None]
    alike = (other.T @ flat) / np.maximum(sizes, 1e-20)
    partner = alike.argmax(axis=1)
    pairs = [
        (one, two)
        for one, two in enumerate(partner)
        if one < two and partner[two] == one and alike[one, two] > MIRRORED
    ]
    return np.concatenate(
        [np.eye(n_expr), *(np.eye(n_expr)[None, one] + np.eye(n_expr)[None, two] for one, two in pairs)]
    )
