"""Joints, skinning weights, pose correctives and regions of the procedural head."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import spsolve

from mgavatar.head.mesh_math import vertex_normals
from mgavatar.head.procedural import surface as form
from mgavatar.head.procedural.mesh import HeadMesh
from mgavatar.head.procedural.sheet import RED_RINGS
from mgavatar.head.procedural.surface import smoothstep

Array = np.ndarray

PARENTS = np.array([-1, 0, 1, 1, 1], np.int32)
MIRROR_X = np.array([-1.0, 1.0, 1.0])
JOINTS_AT = np.array(
    [(0.0, -0.165, -0.045), (0.0, -0.120, -0.035), (0.0, -0.002, -0.030), form.EYE, form.EYE * MIRROR_X]
)
"""Root, neck, jaw, left eye, right eye [m]."""


def both_sides(mesh: HeadMesh, group: str) -> Array:
    """Ids of a group of the left half and of its mirror image."""
    ids = mesh.groups[group]
    return np.unique(np.concatenate([ids, mesh.mirror[ids]]))


def _neighbours(mesh: HeadMesh) -> csr_matrix:
    """Inverse edge lengths between neighbours, symmetric, shape [V, V]."""
    edges = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    weight = 1.0 / np.linalg.norm(mesh.verts[edges[:, 0]] - mesh.verts[edges[:, 1]], axis=1)
    rows, cols = np.concatenate([edges, edges[:, ::-1]]).T
    return coo_matrix((np.tile(weight, 2), (rows, cols)), shape=(len(mesh.verts),) * 2).tocsr()


def jaw_share(mesh: HeadMesh) -> Array:
    """How much each vertex follows the jaw: a harmonic field on the skin between chin and skull, smoothed, [V].

    The mouth is a hole of the mesh, so that the field jumps across it and nowhere else.
    """
    x, y, z = np.abs(mesh.rest[:, 0]), mesh.rest[:, 1], mesh.rest[:, 2]
    verts = mesh.verts
    below = (mesh.part == "skin") & (y < form.MOUTH_Y - 0.002) & (y > -0.088) & (z > 0.012) & (x < 0.022)
    below |= (mesh.part == "skin") & (y < -0.064) & (z > -0.004) & (mesh.level < 12.3)  # the body of the jaw
    socket = mesh.part == "socket"
    below |= socket & (verts[:, 1] < form.MOUTH_Y - 0.0055) & (verts[:, 2] > 0.010)
    above = (mesh.part == "skin") & (
        ((y > form.MOUTH_Y + 0.002) & (x < 0.020)) | (y > -0.012) | (z < -0.046) | (y < -0.112)
    )
    above |= socket & (
        (verts[:, 1] > form.MOUTH_Y + 0.0055) | (verts[:, 2] < 0.010) & (verts[:, 1] > form.MOUTH_Y - 0.004)
    )
    neighbours = _neighbours(mesh)
    share = below.astype(float)
    free = ~(below | above) & ((mesh.part == "skin") | socket)
    laplacian = diags(np.asarray(neighbours.sum(axis=1)).ravel()) - neighbours
    share[free] = spsolve(laplacian[free][:, free].tocsc(), neighbours[free] @ share)
    mean = diags(1.0 / np.asarray(neighbours.sum(axis=1)).ravel()) @ neighbours
    for _ in range(6):
        share = 0.5 * share + 0.5 * (mean @ share)
    share[mesh.part == "lower_teeth"], share[mesh.part == "upper_teeth"] = 1.0, 0.0
    share = np.clip(share, 0.0, 1.0)
    return 0.5 * (share + share[mesh.mirror])


def skinning_weights(mesh: HeadMesh, jaw: Array) -> Array:
    """Weights of root, neck, jaw and eyes, shape [V, 5], rows sum to 1."""
    head = smoothstep(-0.168, -0.088, mesh.verts[:, 1] + 0.12 * (mesh.verts[:, 2] + 0.04))
    weights = np.zeros((len(mesh.verts), 5))
    weights[:, 0], weights[:, 1], weights[:, 2] = 1.0 - head, head * (1.0 - jaw), head * jaw
    eye = mesh.part == "eye"
    weights[eye] = 0.0
    weights[eye & (mesh.verts[:, 0] > 0), 3] = 1.0
    weights[eye & (mesh.verts[:, 0] < 0), 4] = 1.0
    return weights


def _regress(verts: Array, joint: Array, support: Array, reach: float) -> Array:
    """Positive weights of ``support`` that sum to 1 and reproduce ``joint``: a bell around it, tilted exponentially.

    The tilt is the root of a convex problem, found by Newton's method.
    """
    offset = (verts[support] - joint) / reach
    bell = -0.5 * np.sum(offset**2, axis=1)
    tilt = np.zeros(3)
    for _ in range(30):
        logit = bell + offset @ tilt
        weight = np.exp(logit - logit.max())
        weight /= weight.sum()
        mean = weight @ offset
        step = np.linalg.solve((offset * weight[:, None]).T @ offset - np.outer(mean, mean), mean)
        tilt -= step / max(1.0, np.linalg.norm(step))
    row = np.zeros(len(verts))
    row[support] = weight
    return row


def joint_regressor(mesh: HeadMesh) -> Array:
    """Joints as weighted means of nearby vertices, shape [5, V]."""
    skin = mesh.part == "skin"
    ears = np.zeros(len(mesh.verts), bool)
    ears[np.concatenate([both_sides(mesh, g) for g in mesh.groups if g.startswith("ear_")])] = True
    x, y, z = np.abs(mesh.verts[:, 0]), mesh.verts[:, 1], mesh.verts[:, 2]
    sides = skin & ~ears & (x > 0.045) & (np.abs(y + 0.002) < 0.025) & (z < 0.025) & (z > -0.075)
    supports = [skin & (np.abs(y - JOINTS_AT[j, 1]) < 0.022) for j in (0, 1)] + [sides]
    eye = mesh.part == "eye"
    supports += [eye & (mesh.verts[:, 0] > 0), eye & (mesh.verts[:, 0] < 0)]
    reaches = (0.05, 0.05, 0.05, 0.05, 0.05)
    each = zip(JOINTS_AT, supports, reaches, strict=True)
    return np.stack([_regress(mesh.verts, joint, np.flatnonzero(s), reach) for joint, s, reach in each])


def pose_correctives(mesh: HeadMesh, jaw: Array) -> Array:
    """Offsets for the elements of R - I of neck, jaw, left and right eye, row by row, shape [V, 3, 36] [m].

    Neck: the side it bends or turns to bulges, the throat thickens when the head nods. Jaw: the cheeks draw in and
    the angle of the jaw stands out when it opens. Eyes: the lids follow the gaze.
    """
    verts, skin = mesh.verts, mesh.part == "skin"
    normals = vertex_normals(verts, mesh.faces)
    out = np.zeros((len(verts), 3, 36))

    def bell(centre: tuple[float, float, float], width: tuple[float, float, float]) -> Array:
        offset = (verts - np.array(centre) / 1000.0) / (np.array(width) / 1000.0)
        return skin * np.exp(-np.sum(offset**2, axis=1))

    def odd(field: Array) -> Array:
        return (field - field[mesh.mirror])[:, None] * normals

    side = bell((52, -125, -50), (26, 24, 34))
    strap = bell((36, -125, -24), (16, 34, 20))
    throat = bell((0, -106, -5), (42, 14, 30))
    nape = bell((0, -115, -108), (50, 22, 24))
    out[:, :, 3], out[:, :, 1] = -0.004 * odd(side), 0.004 * odd(side)  # roll
    out[:, :, 2], out[:, :, 6] = -0.003 * odd(strap), 0.003 * odd(strap)  # yaw
    out[:, :, 7] = ((0.005 * throat - 0.003 * nape)[:, None]) * normals  # nod
    out[:, :, 5] = -out[:, :, 7]
    cheek = bell((44, -38, 14), (16, 20, 24)) + bell((-44, -38, 14), (16, 20, 24))
    angle = bell((54, -58, -24), (14, 18, 20)) + bell((-54, -58, -24), (14, 18, 20))
    out[:, :, 9 + 7] = (0.004 * angle - 0.006 * cheek)[:, None] * normals
    out[:, :, 9 + 5] = -out[:, :, 9 + 7]
    slack = bell((30, -48, 30), (14, 18, 20))
    out[:, :, 9 + 2], out[:, :, 9 + 6] = 0.003 * odd(slack), -0.003 * odd(slack)
    for k, sign in ((2, 1.0), (3, -1.0)):
        reach = np.exp(-np.sum(((mesh.rest[:, :2] - form.EYE[:2] * [sign, 1.0]) / [0.011, 0.007]) ** 2, axis=1))
        lids = np.where(skin, np.nan_to_num(reach), 0.0)
        out[:, 1, 9 * k + 7], out[:, 1, 9 * k + 5] = -0.0025 * lids, 0.0025 * lids
    return out


def regions(mesh: HeadMesh) -> dict[str, Array]:
    """Named vertex regions, shape [V] each, bool."""
    verts, part = mesh.verts, mesh.part
    skin, left = part == "skin", verts[:, 0] > 0
    x, y, z = np.abs(mesh.rest[:, 0]), mesh.rest[:, 1], mesh.rest[:, 2]
    ears = np.zeros(len(verts), bool)
    ears[np.concatenate([both_sides(mesh, g) for g in mesh.groups if g.startswith("ear_")])] = True
    boundary = np.zeros(len(verts), bool)
    boundary[both_sides(mesh, "rim")] = True
    neighbours = _neighbours(mesh)
    for _ in range(2):
        boundary |= neighbours @ boundary.astype(float) > 0
    front = (z > -0.018 + 0.10 * np.clip(-0.05 - y, 0.0, 0.02)) & (y < 0.082) & (mesh.level < 12.6)
    lips = np.zeros(len(verts), bool)
    lips[np.concatenate([both_sides(mesh, f"lip_{k}") for k in range(len(RED_RINGS))])] = True
    face, shoulders = skin & front & ~ears, skin & (mesh.level > 15.6)
    scalp = skin & ~front & ~ears & (y - 0.25 * (z + 0.05) > -0.01) & (mesh.level < 8.5)
    eye = part == "eye"
    masks = {
        "face": face,
        "scalp": scalp,
        "neck": skin & ~(face | scalp | ears | shoulders),
        "boundary": boundary,
        "eyeballs": eye,
        "left_eyeball": eye & left,
        "right_eyeball": eye & ~left,
        "teeth": (part == "upper_teeth") | (part == "lower_teeth"),
        "upper_teeth": part == "upper_teeth",
        "lower_teeth": part == "lower_teeth",
        "lips": lips,
        "ears": ears,
        "nose": skin & (x < 0.019) & (y < 0.024) & (y > -0.029) & (z > 0.02),
        "forehead": skin & front & (y > 0.048),
        "mouth_socket": part == "socket",
        "shoulders": shoulders,
    }
    return {name: np.asarray(mask, bool) for name, mask in masks.items()}
