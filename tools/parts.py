"""Measure what the parts of a fitted avatar contribute: pose offsets, OffsetNet, and the binding of its Gaussians.

python tools/parts.py --avatar run --json parts.json
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from command_line import run
from torch import Tensor

from mgavatar.avatar import Avatar
from mgavatar.files import write_json
from mgavatar.head.params import Pose
from mgavatar.reporting.markdown import markdown_table

GROUPS = {"position [k]": slice(0, 3), "colour": slice(3, 6), "rotation [rad]": slice(6, 9), "log-scale": slice(9, 12)}
"""Columns of the offsets that each Gaussian reads from OffsetNet's maps."""

SCALE_SLACK = 0.1
"""Excess over epsilon_s [k] that counts as none: Eq. 11 is a weight, not a wall."""


def training_poses(avatar: Avatar) -> list[Pose]:
    """Return the refined poses of the training timesteps."""
    return [avatar.head.pose(timestep) for timestep in avatar.capture.train_timesteps]


def variable_share(values: Tensor) -> float:
    """Return the share of the energy of values [P, ...] that is not the same in all P poses, 0..1."""
    total = values.square().sum()
    constant = len(values) * values.mean(0).square().sum()
    return float((total - constant) / total.clamp(min=1e-30))


@torch.no_grad()
def offset_parts(avatar: Avatar) -> dict[str, Any]:
    """Return mean lengths [mm] of identity and pose offsets, and the share of the latter that depends on the pose."""
    posed = [avatar.head.posed(pose) for pose in training_poses(avatar)]
    by_pose = torch.stack([head.pose_offsets for head in posed])
    return {
        "identity_mm": 1e3 * float(posed[0].identity_offsets.norm(dim=1).mean()),
        "pose_mm": 1e3 * float(by_pose.norm(dim=2).mean()),
        "pose_constant_mm": 1e3 * float(by_pose.mean(0).norm(dim=1).mean()),
        "pose_share": variable_share(by_pose),
    }


@torch.no_grad()
def offset_net_parts(avatar: Avatar) -> dict[str, Any] | None:
    """Return, per kind of offset, root mean squares of its mean over poses and of the rest; None without OffsetNet."""
    appearance = avatar.appearance
    if appearance is None or appearance.offset_net is None:
        return None
    found = [appearance.offsets(appearance.frozen.posed(pose)) for pose in training_poses(avatar)]
    rows = torch.stack([offsets[1] for offsets in found if offsets is not None])
    parts = {}
    for name, columns in GROUPS.items():
        values = rows[:, :, columns]
        mean = values.mean(0)
        parts[name] = {
            "constant": float(mean.square().mean().sqrt()),
            "varying": float((values - mean).square().mean().sqrt()),
            "share": variable_share(values),
        }
    return parts


@torch.no_grad()
def binding_parts(avatar: Avatar) -> dict[str, float] | None:
    """Return the shares of drawn Gaussians beyond Eq. 11's free position and free scale, over the training poses.

    They are those of the Gaussians as drawn, with OffsetNet's offsets; None without an appearance.
    """
    appearance = avatar.appearance
    if appearance is None:
        return None
    a, g = avatar.config.appearance, appearance.gaussians
    away, large = [], []
    for pose in training_poses(avatar):
        offsets = appearance.offsets(appearance.frozen.posed(pose))
        rows = offsets[1] if offsets is not None else g.local_means.new_zeros(len(g), 13)
        away.append((g.local_means + rows[:, :3]).norm(dim=1) > a.epsilon_position)
        large.append(((g.log_scales + rows[:, 9:12]).exp() > a.epsilon_scale + SCALE_SLACK).any(1))
    return {
        "beyond_position": float(torch.stack(away).float().mean()),
        "beyond_scale": float(torch.stack(large).float().mean()),
    }


def parts(avatar: Path, json: Path | None = None) -> str:
    """Measure what the parts of an avatar contribute over its training poses.

    Args:
        avatar: The avatar, or the folder of its fit.
        json: Also write the numbers to this file.
    """
    loaded = Avatar.load(avatar)
    offsets, offset_net, binding = offset_parts(loaded), offset_net_parts(loaded), binding_parts(loaded)
    if json is not None:
        write_json(json, {"offsets": offsets, "offset_net": offset_net, "binding": binding})
    rows = [
        ["identity offsets, mean length", f"{offsets['identity_mm']:.2f} mm"],
        ["pose offsets, mean length", f"{offsets['pose_mm']:.2f} mm"],
        ["pose offsets that are the same in all poses", f"{offsets['pose_constant_mm']:.2f} mm"],
        ["pose offsets, energy that depends on the pose", f"{100 * offsets['pose_share']:.1f} %"],
    ]
    for name, part in (offset_net or {}).items():
        text = f"{part['constant']:.4f} constant, {part['varying']:.4f} varying ({100 * part['share']:.1f} %)"
        rows.append([f"OffsetNet, {name}", text])
    if binding is not None:
        rows.append(["drawn Gaussians beyond epsilon_mu", f"{100 * binding['beyond_position']:.1f} %"])
        rows.append(["drawn Gaussians beyond epsilon_s + 0.1", f"{100 * binding['beyond_scale']:.1f} %"])
    return markdown_table(["part", "over the training poses"], rows)


if __name__ == "__main__":
    run(parts)
