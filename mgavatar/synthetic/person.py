"""A person whom the head model cannot express: one of its identities with hair, a garment and muscles that move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mgavatar.head.mesh_math import vertex_normals
from mgavatar.head.model import HeadModel
from mgavatar.head.params import HeadParams
from mgavatar.head.procedural.surface import smoothstep
from mgavatar.head.subdivide import split_faces
from mgavatar.synthetic.garment import drape

SKIN, EYE, TEETH, MOUTH, CLOTH = range(5)
"""Materials, numbered as in kernels/portrait.py."""

_MIN_FACES = 30_000
"""Least number of faces of the head, for the sake of hair and silhouette."""
_MAX_SUBDIVISIONS = 2
"""Largest number of subdivisions that are made for it."""


@dataclass(frozen=True, eq=False)
class Person:
    """The surface of a synthetic person: H vertices of the head, then G of the garment.

    Attributes:
        head: Head model that is posed.
        betas: True identity coefficients, shape [n_shape].
        fine: Interpolates values of the model's vertices to the subdivided head, sparse, shape [H, V].
        faces: Vertex indices, shape [F, 3], int32.
        kinds: Material of each face, shape [F], int32.
        hair: Offsets of the head's vertices to the surface of the hair [m], shape [H, 3].
        garment: Rest vertices of the garment [m], shape [G, 3].
        lbs_weights: Skinning weights of all vertices, shape [H + G, 5].
        rest: Place of each vertex on the template, relative to the middle of the eyes [m], shape [H + G, 3].
        marks: Shares of hair, lips and collar in each vertex, 0..1, shape [H + G, 3].
        masks: Named vertex regions, each shape [H + G], bool.
    """

    head: HeadModel
    betas: np.ndarray
    fine: sp.csr_matrix
    faces: np.ndarray
    kinds: np.ndarray
    hair: np.ndarray
    garment: np.ndarray
    lbs_weights: np.ndarray
    rest: np.ndarray
    marks: np.ndarray
    masks: dict[str, np.ndarray]

    def posed(self, motion: HeadParams, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Pose the person as in one frame of a motion.

        FLAME's forward pass (linear blend skinning about joints regressed from the shaped vertices), with muscles and
        hair that follow the neck. It is independent of the kernels that a fit uses.

        Args:
            motion: Parameters of all frames.
            frame: Row of the parameters.

        Returns:
            Vertices in world space [m], shape [H + G, 3], and the rotation of each, shape [H + G, 3, 3], float64.
        """
        shaped = shaped_vertices(self.head, self.betas, motion.expr[frame])
        neck_pose = motion.neck_pose[frame]
        joints = self.head.J_regressor.astype(np.float64) @ shaped
        joint_rotvecs = (motion.rotation[frame], neck_pose, motion.jaw_pose[frame], motion.eyes_pose[frame])
        rotvecs = np.concatenate(joint_rotvecs).reshape(5, 3)
        rotations = Rotation.from_rotvec(rotvecs).as_matrix()
        shaped = shaped + self.head.posedirs.astype(np.float64) @ (rotations[1:] - np.eye(3)).reshape(-1)
        moved = np.concatenate([self.fine @ shaped + self.hair, self.garment]) + self._correctives(neck_pose)
        transforms = _joint_transforms(rotations, joints, self.head.parents)
        blended = np.einsum("vj,jab->vab", self.lbs_weights, transforms)
        verts = np.einsum("vab,vb->va", blended[:, :3, :3], moved) + blended[:, :3, 3] + motion.translation[frame]
        return verts, blended[:, :3, :3]

    def _correctives(self, neck_pose: np.ndarray) -> np.ndarray:
        """Return offsets that skinning lacks, a smooth function of the neck's rotation, shape [H + G, 3] [m]."""
        pitch, yaw, roll = neck_pose
        x, y, z = self.rest.T
        side = np.tanh(x / 0.02)
        strand = np.exp(-0.5 * (((np.abs(x) - 0.035) / 0.018) ** 2 + ((y + 0.13) / 0.035) ** 2)) * (z > -0.11)
        bulge = 0.012 * np.sin(yaw) * strand * side  # the muscle opposite to the turn stands out
        shrug = np.exp(-0.5 * (((np.abs(x) - 0.12) / 0.06) ** 2 + ((y + 0.16) / 0.06) ** 2))
        out = np.zeros_like(self.rest)
        out[:, 0] = bulge * side
        out[:, 1] = 0.018 * shrug * (np.abs(np.sin(yaw)) * 0.5 + np.maximum(side * np.sin(-roll), 0.0))
        out[:, 2] = np.abs(bulge) + 0.008 * shrug * np.sin(pitch)
        hair = np.pad(self.hair, ((0, len(self.garment)), (0, 0)))
        sway = np.clip(np.linalg.norm(hair, axis=1) / 0.03, 0.0, 1.5)  # thick hair swings further
        low = np.clip((0.06 - y) / 0.12, 0.0, 1.0) * sway
        out += low[:, None] * np.array([-0.016 * np.sin(yaw) + 0.012 * np.sin(roll), 0.0, -0.012 * np.sin(pitch)])
        return out


def make_person(head: HeadModel, rng: np.random.Generator) -> Person:
    """Draw a person: identity, hair style and garment.

    Args:
        head: Head model of the identity.
        rng: Generator that draws the person.
    """
    betas = 0.7 * np.clip(rng.standard_normal(head.n_shape), -2.0, 2.0)
    shaped = shaped_vertices(head, betas, np.zeros(head.n_expr))
    fine, head_faces = subdivision(head.faces, len(shaped))
    eyes = (head.J_regressor.astype(np.float64) @ head.v_template)[3:]
    rest = fine @ (head.v_template - eyes.mean(0))
    regions = {name: fine @ mask.astype(np.float64) for name, mask in vertex_regions(head).items()}
    cover, hair = comb(rest, fine @ shaped, head_faces, regions, rng)
    middle = (head.J_regressor.astype(np.float64) @ shaped)[3:].mean(0)
    garment, garment_faces, collar = drape(shaped - middle, head.faces, rng)
    weights = _all_weights(fine, head, shaped, garment + middle)
    n_head, n_cloth = len(rest), len(garment)
    marks = np.zeros((n_head + n_cloth, 3))
    marks[:n_head, 0], marks[:n_head, 1], marks[n_head:, 2] = cover, regions["lips"], collar
    masks = {name: np.concatenate([values > 0.999, np.zeros(n_cloth, bool)]) for name, values in regions.items()}
    masks["hair"] = np.concatenate([cover > 0.5, np.zeros(n_cloth, bool)])
    masks["face"] &= ~masks["hair"]
    masks["shoulders"] = np.concatenate([np.zeros(n_head, bool), np.ones(n_cloth, bool)])
    return Person(
        head=head,
        betas=betas,
        fine=fine,
        faces=np.concatenate([head_faces, garment_faces + n_head]).astype(np.int32),
        kinds=np.concatenate([_materials(head_faces, regions), np.full(len(garment_faces), CLOTH)]).astype(np.int32),
        hair=hair,
        garment=garment + middle,
        lbs_weights=weights,
        rest=np.concatenate([rest, garment]),
        marks=marks,
        masks=masks,
    )


def shaped_vertices(head: HeadModel, betas: np.ndarray, expr: np.ndarray) -> np.ndarray:
    """Return vertices with identity and expression, before pose correctives [m], shape [V, 3], float64."""
    return head.v_template.astype(np.float64) + head.shapedirs.astype(np.float64) @ np.concatenate([betas, expr])


def subdivision(faces: np.ndarray, n_verts: int) -> tuple[sp.csr_matrix, np.ndarray]:
    """Return midpoint subdivision as a sparse matrix, shape [H, V], and its faces, shape [F, 3].

    A mesh with enough faces is not subdivided: the matrix is then the identity.
    """
    fine = sp.identity(n_verts, format="csr")
    for _ in range(_MAX_SUBDIVISIONS):
        if len(faces) >= _MIN_FACES:
            break
        n_coarse = fine.shape[0]
        faces, parents = split_faces(faces, n_coarse)
        ends = parents[n_coarse:]
        rows = np.repeat(np.arange(len(ends)), 2)
        halves = sp.csr_matrix((np.full(ends.size, 0.5), (rows, ends.ravel())), (len(ends), n_coarse))
        fine = sp.vstack([fine, halves @ fine], format="csr")
        # From four quarters per face to all first quarters, all second ones, ...: the order of the faces in every
        # capture so far. A seed must give the same bits, and sums over faces depend on their order.
        faces = faces.reshape(-1, 4, 3).swapaxes(0, 1).reshape(-1, 3)
    return fine, faces


def vertex_regions(head: HeadModel) -> dict[str, np.ndarray]:
    """Return the head's masks; regions that it does not name are derived from skinning weights and positions.

    Args:
        head: The head model.

    Returns:
        Masks of shape [V], bool, by name: those of the head, and at least ``eyeballs``, ``teeth``, ``lips``, ``ears``,
        ``face``, ``scalp`` and ``skin``.
    """
    points = head.v_template - (head.J_regressor @ head.v_template)[3:].mean(0)
    x, y, z = points.T
    regions = dict(head.masks)
    regions.setdefault("eyeballs", head.lbs_weights[:, 3:].max(1) > 0.5)
    regions.setdefault("teeth", np.zeros(len(x), bool))
    skin = ~(regions["eyeballs"] | regions["teeth"])
    for inside in ("mouth_socket", "mouth", "mouth_interior"):
        skin &= ~regions.get(inside, np.zeros(len(x), bool))
    mouth = (x / 0.026) ** 2 + ((y - _mouth_height(points, head.lbs_weights[:, 2], skin)) / 0.0125) ** 2 < 1.0
    regions.setdefault("lips", mouth & skin & (z > 0.0))
    ear = ((y + 0.024) / 0.040) ** 2 + ((z + 0.082) / 0.023) ** 2 < 1.0
    regions.setdefault("ears", ear & (np.abs(x) > 0.06) & skin)
    regions.setdefault("face", (z > -0.045) & (y > -0.115) & skin)
    regions.setdefault("scalp", (y > -0.09) & skin & ~regions["face"])
    regions["skin"] = skin
    return regions


def _mouth_height(points: np.ndarray, jaw: np.ndarray, skin: np.ndarray) -> float:
    """Return the height of the mouth line above the eyes [m]: between skin that follows the skull and the jaw."""
    front = skin & (np.abs(points[:, 0]) < 0.01) & (points[:, 2] > 0.015) & (points[:, 1] < -0.03)
    upper, lower = front & (jaw < 0.5), front & (jaw >= 0.5)
    if not upper.any() or not lower.any():
        return -0.066
    return 0.5 * float(points[upper, 1].min() + points[lower, 1].max())


def hairline(around: np.ndarray) -> np.ndarray:
    """Return the height of the hairline above the eyes [m] at angles from the front about the vertical axis [rad]."""
    degrees = [0, 25, 50, 66, 78, 88, 104, 116, 128, 150, 180]
    heights = [0.070, 0.069, 0.060, 0.030, -0.018, 0.018, 0.022, -0.02, -0.062, -0.082, -0.090]
    return np.interp(np.degrees(around), degrees, heights)


def comb(
    rest: np.ndarray, shaped: np.ndarray, faces: np.ndarray, regions: dict[str, np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a hair style.

    Args:
        rest: Vertices on the template, relative to the middle of the eyes [m], shape [H, 3].
        shaped: The same vertices with the person's identity [m], shape [H, 3].
        faces: Vertex indices, shape [F, 3].
        regions: Named regions, 0..1, shape [H] each.
        rng: Generator that draws the style.

    Returns:
        Share of hair in each vertex, 0..1, shape [H], and its offset from the scalp [m], shape [H, 3].
    """
    top, side, fall, wave = rng.uniform([0.012, 0.009, 0.0, 1.5], [0.028, 0.022, 0.05, 6.0])
    fall = 0.0 if fall < 0.018 else fall  # short hair has no fall
    parting, phases = rng.uniform(-0.9, 0.9), rng.uniform(0.0, 2 * np.pi, 8)
    x, y, z = rest.T
    around = np.arctan2(x, z + 0.065)
    above = np.arctan2(y - 0.02, np.hypot(x, z + 0.065))
    line = hairline(np.abs(around)) + 0.0035 * np.sin(9 * around + phases[0])
    ears = np.clip(regions["ears"], 0.0, 1.0)
    grows = regions["skin"] * (1.0 - ears)
    cover = smoothstep(-0.005, 0.009, y - line) * grows
    rise = smoothstep(-0.004, 0.030, y - line) * cover
    clumps = _clumps(around, above, wave, phases)
    thick = top * smoothstep(0.0, 0.09, y) + side * (1.0 - smoothstep(0.0, 0.09, y))
    thick *= 1.0 - 0.35 * np.exp(-0.5 * ((around - parting) / 0.10) ** 2) * (np.abs(above) > 0.7)
    normals = vertex_normals(shaped, faces)
    outward = rest - np.array([0.0, 0.02, -0.065])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    direction = 0.55 * normals + 0.45 * outward
    offsets = direction * (thick * rise * (0.72 + 0.45 * clumps))[:, None]
    fringe = np.exp(-0.5 * (around / 0.75) ** 2) * smoothstep(0.045, 0.075, y) * cover
    sweep = 0.5 * top * np.array([0.25 * np.sign(parting), -0.35, 0.75])
    offsets += (fringe * (0.6 + 0.6 * clumps))[:, None] * sweep
    hang = fall * cover * smoothstep(-0.05, 0.08, -y) * smoothstep(1.3, 2.1, np.abs(around))
    offsets += hang[:, None] * (np.array([0.0, -1.0, 0.0]) + 0.35 * outward) * (0.8 + 0.4 * clumps)[:, None]
    return cover, offsets


def _clumps(around: np.ndarray, above: np.ndarray, wave: float, phases: np.ndarray) -> np.ndarray:
    """Return the height of locks that run from the crown outwards, 0..1: ridges in the angle, bent by waves."""
    bent = around + 0.12 * np.sin(wave * above + phases[1]) + 0.06 * np.sin(2.3 * wave * above + phases[2])
    ridges = np.abs(np.sin(7 * bent + phases[3] + 0.8 * np.sin(3 * bent + phases[4])))
    small = np.abs(np.sin(17 * bent + phases[5] + 2.0 * above))
    return 0.65 * ridges + 0.35 * small


def _materials(faces: np.ndarray, regions: dict[str, np.ndarray]) -> np.ndarray:
    """Return the material of each face, that of the region in which all its corners lie, shape [F]."""
    kinds = np.full(len(faces), SKIN)
    parts = {"mouth_socket": MOUTH, "mouth": MOUTH, "mouth_interior": MOUTH, "teeth": TEETH, "eyeballs": EYE}
    for name, kind in parts.items():
        if name in regions:
            kinds[(regions[name][faces] > 0.999).all(axis=1)] = kind
    return kinds


def _all_weights(fine: sp.csr_matrix, head: HeadModel, shaped: np.ndarray, garment: np.ndarray) -> np.ndarray:
    """Return the skinning weights of head and garment, shape [H + G, 5].

    Cloth near the skin follows the nearest vertex, the rest of it the root.
    """
    weights = head.lbs_weights.astype(np.float64)
    distance, nearest = cKDTree(shaped).query(garment)
    near = np.exp(-np.maximum(distance - 0.006, 0.0) / 0.02)[:, None]
    root = np.eye(5)[:1]
    return np.concatenate([fine @ weights, near * weights[nearest] + (1.0 - near) * root])


def _joint_transforms(rotations: np.ndarray, joints: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Return the transform of each joint, from rest to world, shape [5, 4, 4]."""
    world: list[np.ndarray] = []
    for j, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0.0)
        world.append(world[parent] @ local if parent >= 0 else local)
    stacked = np.stack(world)
    # So far they map from the joint's own frame, whose origin is the joint: take the rest joint away first.
    stacked[:, :3, 3] -= np.einsum("jab,jb->ja", stacked[:, :3, :3], joints)
    return stacked
