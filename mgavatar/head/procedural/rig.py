"""Joints, skinning weights, pose correctives and regions of the built-in head."""

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
JOINT_REACH = 0.05
"""Width of the bell of vertices from which a joint is regressed [m]."""


def both_sides(mesh: HeadMesh, group: str) -> Array:
    """Return the vertex ids of a group of the left half and of its mirror image, ascending."""
    ids = mesh.groups[group]
    return np.unique(np.concatenate([ids, mesh.mirror[ids]]))


def _ear_ids(mesh: HeadMesh) -> Array:
    """Return the vertex ids of both ears."""
    rings = [name for name in mesh.groups if name.startswith("ear_")]
    return np.concatenate([both_sides(mesh, name) for name in rings])


def _neighbours(mesh: HeadMesh) -> csr_matrix:
    """Return the inverse edge lengths between neighbours, symmetric, shape [V, V]."""
    sides = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = np.unique(np.sort(sides, axis=1), axis=0)
    weight = 1.0 / np.linalg.norm(mesh.verts[edges[:, 0]] - mesh.verts[edges[:, 1]], axis=1)
    rows, cols = np.concatenate([edges, edges[:, ::-1]]).T
    return coo_matrix((np.tile(weight, 2), (rows, cols)), shape=(len(mesh.verts),) * 2).tocsr()


def jaw_share(mesh: HeadMesh) -> Array:
    """Return the share of the jaw's motion in that of each vertex, 0..1, shape [V].

    It is 1 on the chin, 0 on the skull, and harmonic between: each vertex has the weighted mean of its neighbours, so
    that the field has no other extremes and no creases. The mouth is a hole of the skin: only there does it jump.
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
    total = np.asarray(neighbours.sum(axis=1)).ravel()
    share = below.astype(float)
    free = ~(below | above) & ((mesh.part == "skin") | socket)
    # Harmonic: L share = 0 at the free vertices. ``share`` is still 0 there, so that neighbours @ share holds the known
    # values alone, the right-hand side.
    laplacian = diags(total) - neighbours
    share[free] = spsolve(laplacian[free][:, free].tocsc(), neighbours[free] @ share)
    mean = diags(1.0 / total) @ neighbours
    for _ in range(6):
        share = 0.5 * share + 0.5 * (mean @ share)
    share[mesh.part == "lower_teeth"], share[mesh.part == "upper_teeth"] = 1.0, 0.0
    share = np.clip(share, 0.0, 1.0)
    return 0.5 * (share + share[mesh.mirror])  # the solver's rounding is not symmetric


def skinning_weights(mesh: HeadMesh, jaw: Array) -> Array:
    """Return the weights of root, neck, jaw and both eyes, shape [V, 5]; rows sum to 1."""
    head = smoothstep(-0.168, -0.088, mesh.verts[:, 1] + 0.12 * (mesh.verts[:, 2] + 0.04))
    weights = np.zeros((len(mesh.verts), 5))
    weights[:, 0], weights[:, 1], weights[:, 2] = 1.0 - head, head * (1.0 - jaw), head * jaw
    eye = mesh.part == "eye"
    weights[eye] = 0.0
    weights[eye & (mesh.verts[:, 0] > 0), 3] = 1.0
    weights[eye & (mesh.verts[:, 0] < 0), 4] = 1.0
    return weights


def _regress(verts: Array, joint: Array, support: Array) -> Array:
    """Return positive weights that sum to 1 and whose weighted mean of the vertices is the joint.

    They are a bell around the joint times exp(tilt . offset), normalized. The logarithm of their sum is convex in the
    tilt; its gradient is the weighted mean of the offsets, its Hessian their covariance. Newton's method finds the
    minimum, where the mean is zero; it exists if the joint lies inside the convex hull of its vertices.

    Args:
        verts: Vertices [m], shape [V, 3].
        joint: The joint [m], shape [3].
        support: True for the vertices that may have a weight, shape [V].

    Returns:
        Weights, shape [V].
    """
    offset = (verts[support] - joint) / JOINT_REACH
    bell = -0.5 * np.sum(offset**2, axis=1)
    tilt = np.zeros(3)
    for _ in range(30):
        logit = bell + offset @ tilt
        weight = np.exp(logit - logit.max())
        weight /= weight.sum()
        mean = weight @ offset
        covariance = (offset * weight[:, None]).T @ offset - np.outer(mean, mean)
        step = np.linalg.solve(covariance, mean)
        tilt -= step / max(1.0, np.linalg.norm(step))  # at most 1: far from the minimum a full step overshoots
    row = np.zeros(len(verts))
    row[support] = weight
    return row


def joint_regressor(mesh: HeadMesh) -> Array:
    """Return the joints as weighted means of nearby vertices, shape [5, V]."""
    skin = mesh.part == "skin"
    ears = np.zeros(len(mesh.verts), bool)
    ears[_ear_ids(mesh)] = True
    x, y, z = np.abs(mesh.verts[:, 0]), mesh.verts[:, 1], mesh.verts[:, 2]
    sides = skin & ~ears & (x > 0.045) & (np.abs(y + 0.002) < 0.025) & (z < 0.025) & (z > -0.075)
    root_section, neck_section = (skin & (np.abs(y - JOINTS_AT[j, 1]) < 0.022) for j in (0, 1))
    eye = mesh.part == "eye"
    left_eye, right_eye = eye & (mesh.verts[:, 0] > 0), eye & (mesh.verts[:, 0] < 0)
    supports = (root_section, neck_section, sides, left_eye, right_eye)
    rows = [_regress(mesh.verts, joint, support) for joint, support in zip(JOINTS_AT, supports, strict=True)]
    return np.stack(rows)


def pose_correctives(mesh: HeadMesh) -> Array:
    """Return offsets for the elements of R - I of neck, jaw, left and right eye, row by row, shape [V, 3, 36] [m].

    The neck bulges on the side to which it bends or turns, and the throat thickens when the head nods. The cheeks draw
    in and the angle of the jaw stands out when the jaw opens. The lids follow the gaze.
    """
    verts, skin = mesh.verts, mesh.part == "skin"
    normals = vertex_normals(verts, mesh.faces)
    out = np.zeros((len(verts), 3, 36))

    def bell(centre: tuple[float, float, float], width: tuple[float, float, float]) -> Array:
        """Return a bell on the skin, centre and widths in mm, shape [V]."""
        offset = (verts - np.array(centre) / 1000.0) / (np.array(width) / 1000.0)
        return skin * np.exp(-np.sum(offset**2, axis=1))

    def odd(field: Array) -> Array:
        """Return the field as an offset along the normals, its mirror image as one against them, shape [V, 3]."""
        return (field - field[mesh.mirror])[:, None] * normals

    side = bell((52, -125, -50), (26, 24, 34))
    strap = bell((36, -125, -24), (16, 34, 20))
    throat = bell((0, -106, -5), (42, 14, 30))
    nape = bell((0, -115, -108), (50, 22, 24))
    # Element 3 i + j of a joint's nine is (R - I)[i, j]. To first order R - I is the cross product with the rotation
    # vector r: R[2, 1] = -R[1, 2] = r_x, R[0, 2] = -R[2, 0] = r_y, R[1, 0] = -R[0, 1] = r_z.
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
    """Return the named vertex regions, shape [V] each, bool."""
    verts, part = mesh.verts, mesh.part
    skin, left = part == "skin", verts[:, 0] > 0
    x, y, z = np.abs(mesh.rest[:, 0]), mesh.rest[:, 1], mesh.rest[:, 2]
    ears = np.zeros(len(verts), bool)
    ears[_ear_ids(mesh)] = True
    boundary = np.zeros(len(verts), bool)
    boundary[both_sides(mesh, "rim")] = True
    neighbours = _neighbours(mesh)
    for _ in range(2):
        boundary |= neighbours @ boundary.astype(float) > 0
    front = (z > -0.018 + 0.10 * np.clip(-0.05 - y, 0.0, 0.02)) & (y < 0.082) & (mesh.level < 12.6)
    lips = np.zeros(len(verts), bool)
    for k in range(len(RED_RINGS)):
        lips[both_sides(mesh, f"lip_{k}")] = True
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
