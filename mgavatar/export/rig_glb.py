"""Rigs as GLB files: a skin, morph targets and an animation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mgavatar.export.bake import Mesh
from mgavatar.export.glb import Glb, as_float32
from mgavatar.export.mesh_glb import add_mesh
from mgavatar.export.rig import MAX_WEIGHTS, Rig
from mgavatar.head.model import JOINTS
from mgavatar.head.params import Pose


def write_rig_glb(
    path: Path,
    mesh: Mesh,
    rig: Rig,
    pose: Pose,
    *,
    motion: Sequence[Pose] = (),
    fps: float = 25.0,
    extras: dict[str, Any],
) -> None:
    """Write a skinned mesh with a morph target per expression, in a pose, and a motion as its animation; atomic.

    Args:
        path: The file.
        mesh: Faces, normals, colours and texture of the mesh; its vertices are those of the rig at rest.
        rig: The rig.
        pose: Pose in which the file opens.
        motion: Poses of the animation; without any there is none.
        fps: Poses per second.
        extras: Notes for readers of the file.

    Raises:
        DataError: If the file cannot be written.
    """
    glb = Glb(extras)
    corners = add_mesh(glb, mesh)
    primitive = glb.tree["meshes"][0]["primitives"][0]
    primitive["attributes"] |= _skin_attributes(glb, rig, corners)
    weights = _morph_weights(rig, [pose])[0]
    if len(weights):
        moved = as_float32(rig.expr_dirs)[:, corners]
        primitive["targets"] = [{"POSITION": glb.add(as_float32(target), bounds=True)} for target in moved]
        glb.tree["meshes"][0] |= {"weights": weights.tolist(), "extras": {"targetNames": list(rig.expr_names)}}
    _add_joints(glb, rig, pose)
    if motion:
        _add_animation(glb, rig, motion, fps)
    glb.write(path)


def _skin_attributes(glb: Glb, rig: Rig, corners: np.ndarray) -> dict[str, int]:
    values, indices = rig.weights.topk(MAX_WEIGHTS, dim=1)
    # An unused place names joint 0: glTF forbids other joints where the weight is zero.
    indices = indices.where(values > 0.0, 0)
    return {
        "JOINTS_0": glb.add(indices.cpu().numpy().astype(np.uint8)[corners]),
        "WEIGHTS_0": glb.add(as_float32(values)[corners]),
    }


def _add_joints(glb: Glb, rig: Rig, pose: Pose) -> None:
    """Add a node per joint in the pose, and the skin. Node 0 has the mesh, node ``1 + j`` is joint ``j``."""
    rotations = _rotations([pose])[0]
    joints = rig.joints.cpu().double().numpy()
    for joint, parent in enumerate(rig.parents.tolist()):
        place = _root_places(rig, [pose])[0] if parent < 0 else joints[joint] - joints[parent]
        node = {"name": JOINTS[joint], "translation": place.tolist(), "rotation": rotations[joint].tolist()}
        children = [1 + index for index, above in enumerate(rig.parents.tolist()) if above == joint]
        glb.tree["nodes"].append(node | ({"children": children} if children else {}))
    inverse = np.tile(np.eye(4), (len(joints), 1, 1))
    inverse[:, 3, :3] = -joints  # glTF stores columns: the last row here is the translation
    skin = {"inverseBindMatrices": glb.add(as_float32(inverse), target=None), "skeleton": 1}
    glb.tree["skins"] = [{"name": "head", "joints": [1 + joint for joint in range(len(joints))], **skin}]
    glb.tree["nodes"][0]["skin"] = 0
    glb.tree["scenes"][0]["nodes"].append(1)


def _add_animation(glb: Glb, rig: Rig, motion: Sequence[Pose], fps: float) -> None:
    times = glb.add(as_float32(np.arange(len(motion)) / fps), target=None, bounds=True)
    rotations, places = _rotations(motion), _root_places(rig, motion)
    curves = [(1 + joint, "rotation", rotations[:, joint]) for joint in range(len(rig.joints))]
    curves.append((1, "translation", places))
    weights = _morph_weights(rig, motion)
    if weights.size:
        curves.append((0, "weights", weights.reshape(-1)))
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for node, name, values in curves:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": name}})
        samplers.append({"input": times, "output": glb.add(as_float32(values), target=None)})
    glb.tree["animations"] = [{"name": "motion", "samplers": samplers, "channels": channels}]


def _morph_weights(rig: Rig, poses: Sequence[Pose]) -> np.ndarray:
    """Return the expressions of T poses, shape [T, K]."""
    return np.stack([as_float32(pose.expr[: len(rig.expr_dirs)]) for pose in poses])


def _root_places(rig: Rig, poses: Sequence[Pose]) -> np.ndarray:
    """Return the places of the root joint in T poses [m], shape [T, 3]."""
    root = rig.joints[0].cpu().double().numpy()
    return np.stack([root + pose.translation.cpu().double().numpy() for pose in poses])


def _rotations(poses: Sequence[Pose]) -> np.ndarray:
    """Return the joints' quaternions xyzw in T poses, shape [T, 5, 4], each on the side of the one before it."""
    vectors = np.stack([pose.joint_rotations().cpu().double().numpy() for pose in poses])
    quats = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_quat().reshape(*vectors.shape[:2], 4)
    for before, after in pairwise(quats):
        after[(before * after).sum(axis=1) < 0.0] *= -1.0  # q and -q are one rotation, but interpolation is not
    return quats
