"""Motion of the built-in head's face carried to the face of another head.

Both heads are in FLAME's axes with a neutral face. The openings of the eyes, the line between the lips and the profile
are found in the view from the front; they place the built-in face roughly, and nearest points with similar normals draw
it onto the other surface, as smoothly as the distance allows. The same warp of space then carries displacements: a lid
that meets the other lid on one head does so on the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse import eye as identity
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from mgavatar.errors import DataError
from mgavatar.head.mesh_math import vertex_normals
from mgavatar.head.model import HeadModel
from mgavatar.kernels.closest_point import closest_points
from mgavatar.kernels.ray_cast import ray_cast

Array = np.ndarray

LEFT_EYE, RIGHT_EYE = 3, 4
"""Joints of the eyes."""

MILLIMETRE = 1e-3

STIFFNESS = (300.0, 100.0, 30.0, 10.0, 3.0, 3.0, 1.0, 1.0)
"""Weight of the bending of the built-in face in each step of the registration, against that of the distance."""

N_CENTRES = 700
"""Number of points of the face that define the warp of space."""

MAX_DISTANCE = 12.0 * MILLIMETRE
"""Largest distance of a nearest point that draws the face."""

BOUND_DISTANCE = 4.0 * MILLIMETRE
"""Largest distance to the registered face of a vertex that gets its motion."""

SAME_SIDE = 0.6
"""Least cosine between the normals of points that belong together."""


@dataclass(frozen=True, eq=False)
class FaceTransfer:
    """Points of the built-in face and of another head's face in correspondence, n of them.

    They are the built-in head's vertices, which lie densest around lips and lids: sums over them weigh the other head's
    surface the same way, whatever its topology.

    Attributes:
        _rest: Rest places on the built-in head [m], shape [n, 3].
        _vertex_ids: Its vertices there, shape [n].
        _corners: Three vertices of the other head around each point, shape [n, 3].
        _weights: Barycentric weights of these, shape [n, 3].
        _warp: From the built-in head's space to that of the other head, in the size of the built-in one.
        _warped_rest: The rest places after the warp [m], shape [n, 3].
        _scale: Size of the other head over that of the built-in one.
    """

    _rest: Array
    _vertex_ids: Array
    _corners: Array
    _weights: Array
    _warp: _Warp
    _warped_rest: Array
    _scale: float

    def carry(self, displacement: Array) -> Array:
        """Return the motion of the points on the other head.

        Args:
            displacement: Motion of all vertices of the built-in head [m], shape [V, 3].

        Returns:
            Motion [m], shape [n, 3].
        """
        shift = displacement[self._vertex_ids]
        moved = np.abs(shift).max(axis=1) > 1e-3 * MILLIMETRE
        out = np.zeros_like(shift)
        out[moved] = self._scale * (self._warp(self._rest[moved] + shift[moved]) - self._warped_rest[moved])
        return out

    def sample(self, values: Array) -> Array:
        """Return values of the other head's vertices at the points, shape [V, ...] to [n, ...]."""
        return np.einsum("nk,nk...->n...", self._weights, values[self._corners])


class _Warp:
    """Smooth warp of space through given points: a sum of distances to them, and an affine part."""

    def __init__(self, places: Array, goals: Array, *, slack: float) -> None:
        """Solve for the warp with the least bending; ``slack`` [m] trades distance from the goals for less of it."""
        n = len(places)
        kernel = np.linalg.norm(places[:, None] - places[None], axis=2)
        kernel[np.diag_indices(n)] -= slack
        affine = np.concatenate([np.ones((n, 1)), places], axis=1)
        system = np.zeros((n + 4, n + 4))
        system[:n, :n], system[:n, n:], system[n:, :n] = kernel, affine, affine.T
        self._places = places
        self._sums = np.linalg.solve(system, np.concatenate([goals, np.zeros((4, 3))]))

    def __call__(self, points: Array) -> Array:
        """Return warped points, shape [N, 3]."""
        n = len(self._places)
        squared = (points**2).sum(axis=1)[:, None] + (self._places**2).sum(axis=1) - 2.0 * points @ self._places.T
        affine = np.concatenate([np.ones((len(points), 1)), points], axis=1)
        return np.sqrt(np.maximum(squared, 0.0)) @ self._sums[:n] + affine @ self._sums[n:]


@dataclass(frozen=True, eq=False)
class _Face:
    """A head as the registration sees it, with the middle between its eyes where the built-in head has it.

    Attributes:
        model: The head.
        verts: Vertices in the built-in head's place and size [m], shape [V, 3], float64.
        faces: Faces of the outer surface of the face: without eyeballs, teeth and the inside of the mouth.
        landmarks: Points that all heads have, by their kind, shape [n, 3] each.
        seam: Height of the line between the lips at ``seam_x`` [m].
        seam_x: Places across the mouth, from its right corner to its left one [m].
    """

    model: HeadModel
    verts: Array
    faces: Array
    landmarks: dict[str, Array]
    seam: Array
    seam_x: Array

    def above_mouth(self, points: Array) -> Array:
        """Return the height of points above the line between the lips [m]."""
        return points[:, 1] - np.interp(points[:, 0], self.seam_x, self.seam)

    def near_mouth(self, points: Array) -> Array:
        """Return True for points where the lips are close to each other."""
        return (np.abs(points[:, 0]) < 0.03) & (np.abs(self.above_mouth(points)) < 0.02)


def register_face(source: HeadModel, target: HeadModel) -> FaceTransfer:
    """Register the built-in face with that of another head.

    Args:
        source: The built-in head.
        target: The other head, of any topology.

    Raises:
        DataError: If the other head has no face that looks like one from the front.
    """
    eyes = joints_of(source)[[LEFT_EYE, RIGHT_EYE]]
    own_eyes = joints_of(target)[[LEFT_EYE, RIGHT_EYE]]
    scale = float(np.linalg.norm(own_eyes[0] - own_eyes[1]) / np.linalg.norm(eyes[0] - eyes[1]))
    if not 0.2 < scale < 5.0 or (own_eyes[0] - own_eyes[1])[0] <= 0.0:
        raise _unlike(target, "its eyes are not beside each other")
    shift = eyes.mean(axis=0) - own_eyes.mean(axis=0) / scale
    face = _seen_from_the_front(source, source.v_template.astype(np.float64))
    other = _seen_from_the_front(target, target.v_template.astype(np.float64) / scale + shift)
    ids, corners = _movable_face(source)
    rest = face.verts[ids]
    fitted = _drawn_onto(face, other, rest, corners)
    centres = _spread(rest, N_CENTRES)
    warp = _Warp(rest[centres], fitted[centres], slack=MILLIMETRE)
    nearest, face_ids, drawn = _nearest(
        other, fitted, corners, upper=face.above_mouth(rest) > 0.0, lips=face.near_mouth(rest)
    )
    kept = drawn & (np.linalg.norm(nearest - fitted, axis=1) < BOUND_DISTANCE)
    if kept.sum() < 0.5 * len(rest):
        raise _unlike(target, f"the built-in face touches it in {kept.sum()} of {len(rest)} points")
    around = other.faces[face_ids[kept]]
    weights = _barycentric(nearest[kept], *(other.verts[around[:, corner]] for corner in range(3)))
    return FaceTransfer(rest[kept], ids[kept], around, weights, warp, warp(rest[kept]), scale)


def joints_of(model: HeadModel) -> Array:
    """Return the rest joints of a head [m], shape [5, 3], float64."""
    return model.J_regressor.astype(np.float64) @ model.v_template


def jaw_motion(model: HeadModel, angles: Array) -> Array:
    """Return the motion of a head's vertices when its jaw turns, without pose correctives [m], shape [V, 3].

    Args:
        model: The head.
        angles: Rotation vector [rad], shape [3].
    """
    arm = model.v_template - joints_of(model)[2]
    return model.lbs_weights[:, 2:3] * (Rotation.from_rotvec(angles).apply(arm) - arm)


def _unlike(model: HeadModel, why: str) -> DataError:
    return DataError(f"{model.name}: does not look like a head with a neutral face ({why}); give --expression-map FILE")


# ---- the view from the front ----


def _seen_from_the_front(model: HeadModel, verts: Array) -> _Face:
    """Find the landmarks of a head."""
    eyeball = model.lbs_weights[:, [LEFT_EYE, RIGHT_EYE]].max(axis=1) > 0.5
    inside = eyeball.copy()
    for name in ("teeth", "mouth_socket"):
        inside |= model.masks.get(name, np.zeros(len(verts), bool))
    faces = model.faces[~inside[model.faces].any(axis=1)]
    centres = verts[faces].mean(axis=1)
    faces = faces[(centres[:, 2] > -0.04) & (np.abs(centres[:, 1]) < 0.115)]
    if len(faces) < 100:
        raise _unlike(model, "there is no surface in front of the eyes")
    x, seam = _seam(model, verts)
    landmarks = {"mouth": np.stack([np.linspace(x[0], x[-1], 13), np.interp(np.linspace(x[0], x[-1], 13), x, seam)], 1)}
    landmarks["profile"] = _profile(model, verts, float(np.interp(0.0, x, seam)))
    for joint in (LEFT_EYE, RIGHT_EYE):
        opening = _eye_opening(model, verts, joint)
        if opening is not None:
            landmarks[f"eye {joint}"] = opening
    for name, places in landmarks.items():
        depths, hit = _front(model, verts, places)[:2]
        if (hit < 0).any():
            raise _unlike(model, "the view from the front has holes")
        landmarks[name] = np.column_stack([places, depths])
    joints = model.J_regressor.astype(np.float64) @ verts
    landmarks["eyes"] = joints[[LEFT_EYE, RIGHT_EYE]]
    return _Face(model, verts, np.ascontiguousarray(faces, np.int32), landmarks, seam, x)


def _front(model: HeadModel, verts: Array, places: Array) -> tuple[Array, Array, Array]:
    """Return what the eye of a viewer meets at places in x and y: z, the face (-1 for none), barycentric weights."""
    origins = np.column_stack([places, np.ones(len(places))])
    directions = np.tile([0.0, 0.0, -1.0], (len(places), 1))
    tensors = (torch.tensor(values, dtype=torch.float32) for values in (verts, origins, directions))
    points, start, along = tensors
    depths, faces, weights = ray_cast(points, torch.tensor(model.faces), start, along)
    return 1.0 - depths.numpy().astype(np.float64), faces.numpy(), weights.numpy().astype(np.float64)


def _mobility(model: HeadModel) -> Array:
    """Return how each vertex can move, in numbers that jump from one lip to the other, shape [V, n]."""
    directions = model.shapedirs[:, :, model.n_shape :].astype(np.float32)
    sizes = np.abs(directions).max(axis=(0, 1), initial=0.0)
    used = directions[:, :, sizes > 0.1 * MILLIMETRE] / sizes[sizes > 0.1 * MILLIMETRE]
    jaw = jaw_motion(model, np.array([0.1, 0.0, 0.0])).astype(np.float32)
    parts = [used.reshape(len(used), -1) / max(np.sqrt(used.shape[2]), 1.0)]
    if np.abs(jaw).max() > 0.0:
        parts.append(3.0 * jaw / np.abs(jaw).max())
    return np.concatenate(parts, axis=1)


def _seam(model: HeadModel, verts: Array) -> tuple[Array, Array]:
    """Return the line between the lips: places from the right to the left corner, and their heights."""
    x, y = np.arange(-0.034, 0.0341, 0.001), np.arange(-0.075, -0.02, 0.00025)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    _, hit, weights = _front(model, verts, places)
    mobility = _mobility(model)
    seen = np.zeros((len(places), mobility.shape[1]), np.float32)
    found = hit >= 0
    seen[found] = np.einsum("nk,nkc->nc", weights[found].astype(np.float32), mobility[model.faces[hit[found]]])
    columns = seen.reshape(len(x), len(y), -1)
    jumps = np.linalg.norm(columns[:, 2:] - columns[:, :-2], axis=2)
    heights, sizes = y[1 + jumps.argmax(axis=1)], jumps.max(axis=1)
    wide = sizes > 0.15 * sizes.max()
    middle = len(x) // 2
    if not wide[middle]:
        raise _unlike(model, "no line between the lips")
    # The mouth reaches from the middle to the first place on each side where nothing jumps.
    right = middle - int(np.argmin(np.append(wide[middle::-1], False))) + 1
    left = middle + int(np.argmin(np.append(wide[middle:], False))) - 1
    if left - right < 10:
        raise _unlike(model, "no line between the lips")
    return x[right : left + 1], heights[right : left + 1]


def _profile(model: HeadModel, verts: Array, mouth: float) -> Array:
    """Return root, tip and base of the nose, both lips, the fold below them and the chin, x and y, shape [7, 2]."""
    y = np.arange(-0.11, 0.08, 0.0005)
    z, hit, _ = _front(model, verts, np.column_stack([np.zeros_like(y), y]))
    z = np.where(hit >= 0, z, -1.0)

    def at(choose: Callable[[Array], np.intp], low: float, high: float) -> float:
        inside = np.flatnonzero((y >= low) & (y <= high))
        if not len(inside):
            raise _unlike(model, "no profile of nose and chin")
        return float(y[inside[choose(z[inside])]])

    tip = at(np.argmax, -0.04, 0.01)
    chin = at(np.argmax, mouth - 0.045, mouth - 0.02)
    base = at(np.argmin, mouth + 0.006, tip - 0.004)
    fold = at(np.argmin, chin + 0.004, mouth - 0.006)
    heights = [
        at(np.argmin, tip + 0.02, 0.055),
        tip,
        base,
        at(np.argmax, mouth + 0.001, base - 0.002),
        at(np.argmax, fold + 0.002, mouth - 0.001),
        fold,
        chin,
    ]
    return np.column_stack([np.zeros(7), heights])


def _eye_opening(model: HeadModel, verts: Array, joint: int) -> Array | None:
    """Return corners and lids of an eye's opening, x and y, shape [12, 2]; None if the lids are closed."""
    centre = (model.J_regressor[joint].astype(np.float64) @ verts)[:2]
    ball = (model.lbs_weights[:, joint] > 0.5)[model.faces].all(axis=1)
    angles = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    radii = np.arange(0.0, 0.024, 0.00025)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = centre + radii[None, :, None] * rays[:, None, :]
    _, hit, _ = _front(model, verts, places.reshape(-1, 2))
    on_ball = (ball[hit] & (hit >= 0)).reshape(len(angles), len(radii))
    outline = radii[np.argmin(on_ball, axis=1)]  # the first place that is not the eyeball
    if outline.max() < 4.0 * MILLIMETRE or on_ball.all(axis=1).any():
        return None
    rim = centre + outline[:, None] * rays
    inner, outer = (rim[np.argmin(rim[:, 0])], rim[np.argmax(rim[:, 0])])
    upper, lower = rim[: len(rim) // 2 + 1], np.concatenate([rim[len(rim) // 2 :], rim[:1]])
    share = np.linspace(0.0, 1.0, 7)[1:-1]
    across = inner[0] + share * (outer[0] - inner[0])
    lids = [np.column_stack([across, np.interp(across, *_by_x(lid))]) for lid in (upper, lower)]
    return np.concatenate([inner[None], outer[None], *lids])


def _by_x(points: Array) -> tuple[Array, Array]:
    order = np.argsort(points[:, 0], kind="stable")
    return points[order, 0], points[order, 1]


# ---- registration ----


def _movable_face(source: HeadModel) -> tuple[Array, Array]:
    """Return the vertices of the built-in head's face, and its faces in their numbers."""
    masks = source.masks
    skin = masks["face"] | masks["nose"] | masks["lips"] | masks["forehead"]
    skin &= ~(masks["eyeballs"] | masks["teeth"] | masks["mouth_socket"])
    ids = np.flatnonzero(skin)
    number = np.full(len(skin), -1)
    number[ids] = np.arange(len(ids))
    return ids, number[source.faces[skin[source.faces].all(axis=1)]]


def _drawn_onto(face: _Face, other: _Face, rest: Array, corners: Array) -> Array:
    """Return the places on the other head of the built-in face's vertices, shape [p, 3]."""
    kinds = sorted(face.landmarks.keys() & other.landmarks.keys())
    own, goals = (np.concatenate([head.landmarks[kind] for kind in kinds]) for head in (face, other))
    places = _Warp(own, goals, slack=0.0)(rest)
    bending = _bending(corners, len(rest))
    upper = face.above_mouth(rest) > 0.0
    lips = face.near_mouth(rest)
    for stiffness in STIFFNESS:
        goal, _, drawn = _nearest(other, places, corners, upper=upper, lips=lips)
        weight = drawn.astype(np.float64)
        system = diags(weight) + stiffness * bending + 1e-6 * identity(len(rest))
        places = places + splu(system.tocsc()).solve(weight[:, None] * (goal - places))
    return places


def _bending(corners: Array, n: int) -> csr_matrix:
    """Return the square of the neighbour-mean Laplacian, shape [n, n]: its form is the bending of a displacement."""
    sides = np.unique(np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    rows, columns = np.concatenate([sides, sides[:, ::-1]]).T
    neighbours = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n)).tocsr()
    counts = np.maximum(np.asarray(neighbours.sum(axis=1)).ravel(), 1.0)
    laplacian = identity(n) - diags(1.0 / counts) @ neighbours
    return (laplacian.T @ laplacian).tocsr()


def _nearest(face: _Face, points: Array, corners: Array, *, upper: Array, lips: Array) -> tuple[Array, Array, Array]:
    """Return the nearest points on a head of a surface's vertices, their faces, and which of them belong together.

    Lips touch: a point of the upper lip looks for the upper lip only.
    """
    above = face.above_mouth(face.verts[face.faces].mean(axis=1)) > 0.0
    goals, face_ids = points.copy(), np.full(len(points), -1)
    everything = np.ones(len(face.faces), bool)
    for chosen, allowed in ((~lips, everything), (lips & upper, above), (lips & ~upper, ~above)):
        if chosen.any() and allowed.any():
            goals[chosen], found = _closest(face.verts, face.faces[allowed], points[chosen])
            face_ids[chosen] = np.where(found >= 0, np.flatnonzero(allowed)[found], -1)
    normals = _face_normals(face.verts, face.faces)[face_ids]
    same_side = (vertex_normals(points, corners) * normals).sum(axis=1) > SAME_SIDE
    close = np.linalg.norm(goals - points, axis=1) < MAX_DISTANCE
    return goals, face_ids, (face_ids >= 0) & close & same_side


def _closest(verts: Array, faces: Array, points: Array) -> tuple[Array, Array]:
    """Return the nearest points of a mesh and their faces, -1 where nothing is near."""
    nearest, face_ids = closest_points(
        torch.tensor(verts, dtype=torch.float32),
        torch.tensor(faces, dtype=torch.int32),
        torch.tensor(points, dtype=torch.float32),
        reach=0.05,
    )
    return nearest.numpy().astype(np.float64), face_ids.numpy()


def _face_normals(verts: Array, faces: Array) -> Array:
    a, b, c = (verts[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def _spread(points: Array, count: int) -> Array:
    """Return points far from each other: each is the farthest one from those before it."""
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    for _ in range(min(count, len(points)) - 1):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def _barycentric(points: Array, a: Array, b: Array, c: Array) -> Array:
    """Return the weights of three corners in points of their triangle, shape [n, 3]."""
    sides = np.stack([b - a, c - a], axis=1)
    gram = np.einsum("nik,njk->nij", sides, sides)
    gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2)  # slivers have no inverse
    shares = np.linalg.solve(gram, np.einsum("nik,nk->ni", sides, points - a)[:, :, None])[:, :, 0]
    weights = np.clip(np.column_stack([1.0 - shares.sum(axis=1), shares]), 0.0, 1.0)
    return weights / weights.sum(axis=1, keepdims=True)
