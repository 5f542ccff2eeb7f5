"""The motion of a synthetic person, and the same motion with the errors of a tracker."""

from __future__ import annotations

import numpy as np

from mgavatar.head.model import HeadModel
from mgavatar.head.params import MOTION_KEYS, HeadParams
from mgavatar.synthetic.person import vertex_regions

_ACTIONS = {
    "smile": ("smile",),
    "brows": ("browinnerup", "browouterup", "browraise", "browup", "browsup"),
    "blink": ("blink", "eyeclose", "lidclose"),
    "round": ("pucker", "funnel"),
    "stretch": ("stretch",),
    "squint": ("squint", "cheekraise"),
}
"""Words in the names of expression directions, without case and punctuation, that tell an action."""

_REACH = {"smile": 0.9, "brows": 0.9, "blink": 1.0, "round": 0.6, "stretch": 0.5, "squint": 0.6}
"""Largest coefficient of each action."""
_LARGEST = 0.009
"""Largest motion of a vertex by a full expression [m], whatever the units of the directions; blinks have no limit."""


def perform(head: HeadModel, timesteps: int, rng: np.random.Generator, *, turn: float) -> HeadParams:
    """Make a smooth motion: turns and nods of the head, speech, expressions, gaze, sway of the body.

    Args:
        head: Head model whose expression directions are used.
        timesteps: Number of frames, T.
        rng: Generator that draws the phases.
        turn: Largest turn of the head to either side [rad].

    Returns:
        Parameters of T frames.
    """
    u = np.arange(timesteps) / max(timesteps - 1, 1)
    expr = _expressions(head, u, rng)
    phase = rng.uniform(-0.35, 0.35, 12)
    yaw = turn * np.sin(2 * np.pi * 1.45 * u + phase[0])
    pitch = 0.19 * np.sin(2 * np.pi * 1.0 * u + 0.9 + phase[1]) - 0.02
    roll = 0.12 * np.sin(2 * np.pi * 1.25 * u + 2.0 + phase[2])
    jaw = 0.02 + 0.17 * np.sin(np.pi * (2.6 * u + 0.15 + 0.2 * phase[3])) ** 4
    gaze_x = 0.12 * np.sin(2 * np.pi * 1.1 * u + 1.0 + phase[4])
    gaze_y = -0.35 * yaw + 0.16 * np.sin(2 * np.pi * 1.7 * u + phase[5])
    sway = np.sin(np.outer(u, [5, 7, 6]) + phase[6:9]) * [0.027, 0.045, 0.022]
    shift = np.sin(np.outer(u, [6, 8, 5]) + phase[9:12]) * [0.006, 0.003, 0.006]
    zero = 0.0 * u
    neck = np.stack([pitch, yaw, roll], axis=1)
    eyes = np.stack([gaze_x, gaze_y, zero, gaze_x, gaze_y, zero], axis=1)
    return HeadParams(
        expr=expr,
        rotation=sway,
        neck_pose=neck,
        jaw_pose=np.stack([jaw, 0.012 * np.sin(9 * u), zero], axis=1),
        eyes_pose=eyes,
        translation=shift,
    )


def tracked(motion: HeadParams, rng: np.random.Generator) -> HeadParams:
    """Add the errors of a tracker to a motion.

    Their standard deviations are 0.3 degrees, 0.5 mm and, for expression directions in use, 0.03.

    Args:
        motion: The true motion.
        rng: Generator that draws the errors.
    """
    used = motion.expr.any(axis=0)
    sigmas = dict.fromkeys(MOTION_KEYS, np.radians(0.3)) | {"expr": 0.03 * used, "translation": 5e-4}
    noisy: dict[str, list[np.ndarray]] = {name: [] for name in MOTION_KEYS}
    # Frame by frame, not key by key: the order of the draws decides which capture a seed makes.
    for frame in range(len(motion)):
        for name in MOTION_KEYS:
            values = getattr(motion, name)[frame]
            noisy[name].append(values + sigmas[name] * rng.standard_normal(values.shape))
    return HeadParams(**{name: np.stack(rows) for name, rows in noisy.items()})


def action_columns(head: HeadModel) -> dict[str, np.ndarray]:
    """Return the columns of each action's expression directions, found by name, or else by the region that they move.

    Args:
        head: The head model.

    Returns:
        Columns within ``expr`` by action; actions without a direction are left out.
    """
    names = ["".join(c for c in name.lower() if c.isalnum()) for name in head.expr_names]
    found = {}
    for action, words in _ACTIONS.items():
        columns = [column for column, name in enumerate(names) if any(word in name for word in words)]
        if columns:
            found[action] = np.array(columns, int)
    return found or _columns_by_region(head)


def _columns_by_region(head: HeadModel) -> dict[str, np.ndarray]:
    """Return the direction with the largest share of its motion in the mouth, in the brows and in the eyes."""
    motion = np.linalg.norm(head.shapedirs[:, :, head.n_shape :], axis=1)  # [V, E]
    points = head.v_template - (head.J_regressor @ head.v_template)[3:].mean(0)
    front = (points[:, 2] > -0.03) & vertex_regions(head)["skin"]
    height = points[:, 1]
    boxes = {
        "smile": front & (np.abs(height + 0.055) < 0.02),
        "brows": front & (np.abs(height - 0.022) < 0.012),
        "squint": front & (np.abs(height) < 0.01),
    }
    energy = np.maximum((motion**2).sum(0), 1e-20)
    taken: dict[str, np.ndarray] = {}
    for action, box in boxes.items():
        share = (motion[box] ** 2).sum(0) / energy
        for columns in taken.values():
            share[columns] = -1.0  # a direction serves one action
        if len(share) > len(taken):
            taken[action] = np.array([int(np.argmax(share))])
    return taken


def _expressions(head: HeadModel, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the coefficients at times ``u`` in 0..1, shape [T, n_expr]."""
    expr = np.zeros((len(u), head.n_expr))
    for i, (action, columns) in enumerate(action_columns(head).items()):
        phase = rng.uniform(0.0, 1.0)
        wave = np.sin(np.pi * ((1.3 + 0.45 * i) * u + phase)) ** 2
        if action == "blink":
            wave = np.clip(3.0 * np.sin(np.pi * (2.2 * u + 0.6 + 0.3 * phase)) ** 8 - 0.4, 0.0, 1.0)
        for column in columns:
            expr[:, column] += _REACH[action] * wave * _unit(head, int(column), action)
    return expr


def _unit(head: HeadModel, column: int, action: str) -> float:
    """Return the coefficient of a full expression: 1, or less where 1 moves a vertex further than ``_LARGEST``."""
    largest = float(np.linalg.norm(head.shapedirs[:, :, head.n_shape + column], axis=1).max())
    return 1.0 if action == "blink" else min(1.0, _LARGEST / max(largest, 1e-9))
