"""From an avatar and a pose to a file for another program."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from mgavatar import __version__
from mgavatar.avatar import Avatar
from mgavatar.driving.expression_map import ExpressionMap
from mgavatar.driving.motion import DEFAULT_FPS, Driving
from mgavatar.driving.retarget import driving_notes, poses_of
from mgavatar.errors import DataError
from mgavatar.export.bake import Splats, bake_mesh, bake_splats, baking_costs
from mgavatar.export.mesh_files import write_obj, write_with_trimesh
from mgavatar.export.mesh_glb import write_mesh_glb
from mgavatar.export.ply import write_splats_ply
from mgavatar.export.rig import Rig, bake_rig, rig_error, training_poses
from mgavatar.export.rig_glb import write_rig_glb
from mgavatar.export.splats_glb import write_splats_glb
from mgavatar.files import check_writable
from mgavatar.head.params import HeadParams, Pose

Content = Literal["splats", "mesh", "rig"]
Up = Literal["y", "-y"]

CONTENTS: dict[str, tuple[Content, ...]] = {
    ".ply": ("splats", "mesh"),
    ".glb": ("mesh", "splats", "rig"),
    ".obj": ("mesh",),
    ".stl": ("mesh",),
}
"""Contents that a file can have, by its suffix; the first one is the default."""

MORPHS = 50
"""Number of a rig's expressions by default."""

CONVERTED = (".sog", ".spz", ".splat", ".ksplat")
"""Suffixes of other formats of splats, which a converter makes of a PLY."""


def content_of(out: Path, to: Content | None = None, *, up: Up = "y", overwrite: bool = False) -> Content:
    """Decide what to write at ``out``, and check that it can be written there.

    Args:
        out: The file; its suffix says the format.
        to: The content, or None for the usual one of the format.
        up: Direction that points upwards in the file.
        overwrite: Replace a file that is there.

    Raises:
        DataError: If the suffix is unknown or has no such content, or ``out`` cannot be written.
    """
    suffix = out.suffix.lower()
    if suffix in CONVERTED:
        raise DataError(
            f"{out}: write a .ply and convert it: npx @playcanvas/splat-transform {out.stem}.ply {out.name}"
        )
    if suffix not in CONTENTS:
        raise DataError(f"{out}: unknown suffix; give a name ending in .ply, .glb, .obj or .stl")
    content = to or CONTENTS[suffix][0]
    if content not in CONTENTS[suffix]:
        others = " or ".join(name for name, contents in CONTENTS.items() if content in contents)
        raise DataError(f"{out}: a {suffix} file cannot have {content}; give a name ending in {others}")
    if up == "-y" and (content, suffix) != ("splats", ".ply"):
        raise DataError(f"{out}: --up -y is for splats in a .ply; in this file y points up")
    if out.exists() and not overwrite:
        raise DataError(f"{out}: already exists; give --out another name, or --overwrite to replace it")
    check_writable(out)
    return content


def export(
    avatar: Avatar,
    out: Path | str,
    *,
    to: Content | None = None,
    pose: str = "neutral",
    driving: Driving | None = None,
    expression_map: ExpressionMap | None = None,
    degree: int = 3,
    morphs: int = MORPHS,
    up: Up = "y",
    overwrite: bool = False,
) -> list[str]:
    """Write an avatar for another program: splats or a coloured mesh in one pose, or a rig that can be posed.

    Args:
        avatar: The avatar.
        out: A name ending in ``.ply``, ``.glb``, ``.obj`` or ``.stl``.
        to: ``"splats"``, ``"mesh"`` or ``"rig"``; by default splats in a ``.ply`` and the mesh in other files.
        pose: ``"neutral"``, ``"mean"`` or the number of a frame; see :func:`export_pose`.
        driving: Motion that the frame is of, or a rig's animation.
        expression_map: Map from ARKit's blendshapes to the avatar's head; by default that of its names.
        degree: Degree of the splats' spherical harmonics, 0 to 3.
        morphs: Largest number of a rig's expressions.
        up: Axis of the file that points upwards; ``"-y"`` for splats in a ``.ply`` only.
        overwrite: Replace a file that is there already.

    Returns:
        Lines for the user: what is lost on the way to the file.

    Raises:
        DataError: If the file cannot be written or the pose does not exist.
    """
    out = Path(out)
    content = content_of(out, to, up=up, overwrite=overwrite)
    if morphs < 0:
        raise DataError(f"--morphs {morphs}: give a number of expressions, 0 or more")
    of_frame = None if content == "rig" else driving
    chosen, posed_as = export_pose(avatar, pose, of_frame, expression_map=expression_map)
    facts: dict[str, Any] = {"mgavatar": __version__, "pose": posed_as, "unit": "metre", "up": up}
    notes = driving_notes(avatar, driving, expression_map=expression_map) if driving is not None else []
    if avatar.appearance is None:
        notes.append("the avatar has no appearance stage: the colours are those of its vertex-bound Gaussians")
    if content == "rig":
        motion = poses_of(avatar, driving, expression_map=expression_map) if driving is not None else []
        rig = bake_rig(avatar, n_expr=morphs)
        fps = driving.fps if driving is not None else DEFAULT_FPS
        return [*notes, _write_rig(out, avatar, rig, chosen, motion, fps, facts)]
    if content == "mesh":
        _write_mesh(out, avatar, chosen, facts)
        return notes
    baked = bake_splats(avatar, chosen, degree=degree)
    costs = [round(cost, 2) for cost in baking_costs(avatar, chosen, baked)]
    facts |= {"splats": len(baked[-1]), "sh_degree": degree, "psnr_against_the_avatar_by_sh_degree": costs}
    _write_splats(out, baked[-1], facts, up)
    return [*notes, _cost_line(costs)]


def export_pose(
    avatar: Avatar, pose: str, driving: Driving | None = None, *, expression_map: ExpressionMap | None = None
) -> tuple[Pose, str]:
    """Return a pose by its name, and a line that describes it.

    Args:
        avatar: The avatar.
        pose: ``"neutral"``, upright at the origin of the head model with a neutral face; ``"mean"``, where the head was
            on average in the capture, with a neutral face; or a frame, counted from 0: of ``driving`` if it is given,
            else of the capture.
        driving: Motion that the frame is of.
        expression_map: As in :func:`export`.

    Raises:
        DataError: If there is no such pose.
    """
    if pose in ("neutral", "mean"):
        if driving is not None:
            raise DataError(f"--pose {pose}: is no frame of {driving.path}; give the number of a frame, counted from 0")
        neutral = HeadParams.neutral(n_frames=1, n_expr=avatar.head_model.n_expr)
        return (avatar.mean_pose() if pose == "mean" else neutral.pose(0)), pose
    n_frames = len(driving) if driving is not None else len(avatar.capture.timestep_ids)
    whose = str(driving.path) if driving is not None else "the capture"
    if not (pose.isascii() and pose.isdigit()):
        raise DataError(f"--pose {pose}: give neutral, mean or the number of a frame, counted from 0")
    frame = int(pose)
    if frame >= n_frames:
        raise DataError(f"--pose {pose}: {whose} has {n_frames} frames, 0 to {n_frames - 1}")
    if driving is not None:
        (driven,) = poses_of(avatar, driving, expression_map=expression_map, frames=slice(frame, frame + 1))
        return driven, f"frame {frame} of {driving.path.name}"
    with torch.no_grad():
        return avatar.head.pose(frame), f"frame {frame} of the capture"


def _write_mesh(out: Path, avatar: Avatar, pose: Pose, facts: dict[str, Any]) -> None:
    mesh = bake_mesh(avatar, pose)
    if out.suffix.lower() == ".glb":
        write_mesh_glb(out, mesh, extras=facts)
    elif out.suffix.lower() == ".obj":
        write_obj(out, mesh, comments=_comments(facts))
    else:
        write_with_trimesh(out, mesh)


def _write_rig(
    out: Path, avatar: Avatar, rig: Rig, pose: Pose, motion: list[Pose], fps: float, facts: dict[str, Any]
) -> str:
    """Write a rig and return the line about its error."""
    mean, largest = rig_error(avatar, rig, motion or training_poses(avatar))
    facts |= {"mean_mm_from_the_avatar": round(mean, 3), "largest_mm_from_the_avatar": round(largest, 3)}
    rest = replace(bake_mesh(avatar, pose), verts=rig.verts.cpu().numpy(), normals=_normals(avatar, rig))
    write_rig_glb(out, rest, rig, pose, motion=motion, fps=fps, extras=facts)
    whose = "of the motion" if motion else "of the capture"
    n = len(rig.expr_dirs)
    return f"rig with {n} expressions: {mean:.2f} mm from the avatar over poses {whose}, at most {largest:.1f} mm"


def _normals(avatar: Avatar, rig: Rig) -> np.ndarray:
    return avatar.head.body.normals(rig.verts).cpu().numpy()


def _write_splats(out: Path, splats: Splats, facts: dict[str, Any], up: Up) -> None:
    if out.suffix.lower() == ".glb":
        write_splats_glb(out, splats, extras=facts)
    else:
        write_splats_ply(out, splats if up == "y" else splats.upside_down(), comments=_comments(facts))


def _comments(facts: dict[str, Any]) -> list[str]:
    return [f"{name}: {value}" for name, value in facts.items()]


def _cost_line(costs: list[float]) -> str:
    """Return the line about what spherical harmonics cost."""
    listed = ", ".join(f"degree {degree} {cost:.1f} dB" for degree, cost in enumerate(costs))
    return f"spherical harmonics against the avatar's own colours, from the mean camera: {listed}"
