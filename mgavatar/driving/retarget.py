"""From a driving sequence to an avatar's own poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mgavatar.avatar import Avatar
from mgavatar.driving.arkit import arkit_name, is_arkit
from mgavatar.driving.expression_map import ExpressionMap, listed, map_by_names
from mgavatar.driving.map_expressions import computed_map
from mgavatar.driving.motion import Driving
from mgavatar.head.model import HeadModel
from mgavatar.head.params import Pose

ExpressionMode = Literal["use", "ignore", "auto"]


def driving_expression(
    driving: Driving, *, n_expr: int, expr_basis: str, expr_names: tuple[str, ...], mode: ExpressionMode
) -> tuple[np.ndarray, str | None]:
    """Return the expression coefficients of a driving sequence for a head.

    Columns of another basis have another meaning. ``"use"`` takes the columns as they are, ``"ignore"`` none.
    ``"auto"`` matches them by name if both sides have names; else takes them if both have the same basis; else, if the
    file names no basis, takes them if the head is FLAME's (the field's convention), or if the file was evidently made
    for the head: its columns beyond the head's are zero.

    Args:
        driving: The motion.
        n_expr: Number of the head's expression directions.
        expr_basis: The head's basis.
        expr_names: Names of the head's directions, or an empty tuple.
        mode: Treatment of the columns.

    Returns:
        Coefficients, shape [T, n_expr], float32, and a note about ignored columns, or None.
    """
    nothing = np.zeros((len(driving), n_expr), np.float32)
    if mode == "ignore" or not driving.expr.any():
        return nothing, None
    if mode == "use":
        return _cut_or_padded(driving, n_expr)
    if driving.expr_names and expr_names:
        return _matched_by_name(driving, expr_names)
    reason = _mismatch(driving, n_expr, expr_basis)
    if reason is None:
        return _cut_or_padded(driving, n_expr)
    return nothing, f"{driving.path}: its expression is ignored, because {reason}; --expression use takes it as it is"


def _mismatch(driving: Driving, n_expr: int, expr_basis: str) -> str | None:
    """Return the reason why the file's expression columns may mean others than the head's, or None."""
    if driving.expr_basis is not None:
        same = driving.expr_basis == expr_basis
        return None if same else f"its basis is {driving.expr_basis} and the head's is {expr_basis}"
    if expr_basis.startswith("flame"):
        return None
    made_for_head = driving.expr.shape[1] >= n_expr and not driving.expr[:, n_expr:].any()
    if made_for_head and expr_basis != "procedural":
        return None
    return f"it does not name its basis, FLAME's is likely, and the head's is {expr_basis}"


def _cut_or_padded(driving: Driving, n_expr: int) -> tuple[np.ndarray, str | None]:
    expr, dropped = driving.expr[:, :n_expr], driving.expr[:, n_expr:]
    note = None
    if dropped.any():
        note = (
            f"{driving.path}: expression columns {n_expr} to {driving.expr.shape[1] - 1} are ignored, "
            f"because the head has {n_expr}; they reach {np.abs(dropped).max():.3g}"
        )
    return np.pad(expr, ((0, 0), (0, n_expr - expr.shape[1]))), note


def _matched_by_name(driving: Driving, expr_names: tuple[str, ...]) -> tuple[np.ndarray, str | None]:
    expr = np.zeros((len(driving), len(expr_names)), np.float32)
    column_of = {name: column for column, name in enumerate(expr_names)}
    unmatched = []
    for name, values in zip(driving.expr_names, driving.expr.T, strict=True):
        if name in column_of:
            expr[:, column_of[name]] = values
        else:
            unmatched.append(name)
    return expr, _unmatched_note(driving, unmatched)


def _unmatched_note(driving: Driving, names: list[str]) -> str | None:
    if not names:
        return None
    n = len(driving.expr_names)
    return f"{driving.path}: {len(names)} of {n} expressions are not the head's: {listed(names)}"


@dataclass(frozen=True, eq=False)
class HeadExpression:
    """The part of a motion that moves the face of a head, over T frames.

    Attributes:
        expr: Coefficients of the head's own directions, shape [T, E], float32.
        jaw_pose: Rotation vectors [rad], shape [T, 3].
        eyes_pose: Rotation vectors of left and right eye [rad], shape [T, 6].
        notes: What was not used, one line each.
    """

    expr: np.ndarray
    jaw_pose: np.ndarray
    eyes_pose: np.ndarray
    notes: tuple[str, ...]


def expression_on(
    driving: Driving, model: HeadModel, *, mode: ExpressionMode = "auto", expression_map: ExpressionMap | None = None
) -> HeadExpression:
    """Return the expression, jaw and eyes that a motion gives a head.

    ARKit's blendshapes go through a map: the one given, or that of the head's names, or else one that is computed from
    its surface. The motion's own jaw adds to that
    of the map; its own eyes, where a file has angles, take the place of those of the map. Everything else is taken as
    :func:`driving_expression` says.

    Args:
        driving: The motion.
        model: The head.
        mode: Treatment of the expression columns; with ``"ignore"`` blendshapes move jaw and eyes only.
        expression_map: Map from ARKit's blendshapes to the head.

    Raises:
        DataError: If the motion has blendshapes and no map to the head can be computed.
    """
    if not is_arkit(driving):
        expr, note = driving_expression(
            driving, n_expr=model.n_expr, expr_basis=model.expr_basis, expr_names=model.expr_names, mode=mode
        )
        return HeadExpression(expr, driving.jaw_pose, driving.eyes_pose, (note,) if note else ())
    mapped = expression_map or map_by_names(model) or computed_map(model)
    names = [arkit_name(name) or name for name in driving.expr_names]
    expr, jaw, eyes = mapped.apply(names, driving.expr)
    if mode == "ignore":
        expr = np.zeros_like(expr)
    moving = [name for name, column in zip(names, driving.expr.T, strict=True) if column.any()]
    without = {*mapped.unmapped, *(set(moving) - set(mapped.names))}
    note = _unmatched_note(driving, [name for name in moving if name in without])
    return HeadExpression(
        expr,
        driving.jaw_pose + jaw,
        driving.eyes_pose if driving.eyes_pose.any() else eyes,
        (note,) if note else (),
    )


HeadMotion = Literal["full", "neck", "none"]


def driving_notes(
    avatar: Avatar,
    driving: Driving,
    *,
    expression: ExpressionMode = "auto",
    expression_map: ExpressionMap | None = None,
) -> list[str]:
    """List what an avatar does not use of a driving sequence, one line each."""
    used = expression_on(driving, avatar.head_model, mode=expression, expression_map=expression_map)
    return [*driving.notes, *used.notes]


def poses_of(
    avatar: Avatar,
    driving: Driving,
    *,
    head_motion: HeadMotion = "full",
    expression: ExpressionMode = "auto",
    expression_map: ExpressionMap | None = None,
    frames: slice | None = None,
) -> list[Pose]:
    """Return the poses of an avatar under a driving sequence.

    Jaw, eyes and expressions are taken as they are. Root and neck depend on ``head_motion``:

    * ``"full"`` takes both, and shifts the whole sequence so that the mean place of the head is that in training;
    * ``"neck"`` keeps the shoulders at their mean in training and turns the neck by the driven root and neck together:
      the head looks where the driven one does;
    * ``"none"`` keeps both at their means in training.

    Args:
        avatar: The avatar.
        driving: The motion.
        head_motion: Treatment of root and neck.
        expression: Treatment of the expression columns, see :func:`driving_expression`.
        expression_map: Map from ARKit's blendshapes to the head, see :func:`expression_on`.
        frames: Frames to return; None returns all of them. Means are those of all frames in any case.

    Returns:
        Poses on the CPU.
    """
    mean = avatar.mean_pose()
    driving = _about_root(avatar, driving)
    face = expression_on(driving, avatar.head_model, mode=expression, expression_map=expression_map)
    rotation, neck = driving.rotation, driving.neck_pose
    if head_motion == "full":
        translation = driving.translation + _shift(avatar, driving, mean)
    else:
        translation = np.broadcast_to(mean.translation.numpy(), driving.translation.shape)
        own_root = Rotation.from_rotvec(mean.rotation.numpy())
        if head_motion == "neck":
            turned = Rotation.from_rotvec(rotation) * Rotation.from_rotvec(neck)
            neck = (own_root.inv() * turned).as_rotvec()
        else:
            neck = np.broadcast_to(mean.neck_pose.numpy(), neck.shape)
        rotation = np.broadcast_to(mean.rotation.numpy(), rotation.shape)
    chosen = frames or slice(None)
    columns = (face.expr, rotation, neck, face.jaw_pose, face.eyes_pose, translation)
    tensors = [torch.tensor(np.ascontiguousarray(column[chosen]), dtype=torch.float32) for column in columns]
    return [Pose(*row) for row in zip(*tensors, strict=True)]


def head_points(avatar: Avatar, rotation: np.ndarray, neck: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the place of a point between neck joint and eyes in T poses.

    Args:
        avatar: The avatar.
        rotation: Root rotation vectors [rad], shape [T, 3].
        neck: Neck rotation vectors [rad], shape [T, 3].
        translation: Translations [m], shape [T, 3].

    Returns:
        Points in world space [m], shape [T, 3].
    """
    joints = _joints(avatar)
    root, top = joints[0], joints[1]
    inside = (top + joints[3] + joints[4]) / 3.0
    turned = top + Rotation.from_rotvec(neck).apply(inside - top)
    return root + Rotation.from_rotvec(rotation).apply(turned - root) + translation


def _about_root(avatar: Avatar, driving: Driving) -> Driving:
    """Return the same motion with its rotation about the root joint of the avatar's own head.

    A rotation R about the origin followed by a translation t is one about the joint J by t + R J - J.
    """
    if driving.pivot == "root":
        return driving
    joint = _joints(avatar)[0]
    moved = Rotation.from_rotvec(driving.rotation).apply(joint) - joint
    translation = (driving.translation + moved).astype(np.float32)
    return replace(driving, translation=translation, pivot="root")


def _joints(avatar: Avatar) -> np.ndarray:
    """Return the rest joints of the avatar's head [m], shape [5, 3], float64."""
    head = avatar.head
    with torch.no_grad():
        return head.joints(head.canonical()).cpu().numpy().astype(np.float64)


def _shift(avatar: Avatar, driving: Driving, mean: Pose) -> np.ndarray:
    """Return the shift from the mean place of the driven head to that of the avatar's own [m], shape [3]."""
    own = head_points(avatar, *(value.numpy()[None] for value in (mean.rotation, mean.neck_pose, mean.translation)))
    driven = head_points(avatar, driving.rotation, driving.neck_pose, driving.translation)
    return (own.mean(axis=0) - driven.mean(axis=0)).astype(np.float32)
