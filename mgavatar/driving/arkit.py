"""ARKit's blendshapes: their names in the spellings of many programs, and motion in their weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mgavatar.driving.motion import Driving, motion_of
from mgavatar.driving.timeline import Track, at_regular_times
from mgavatar.errors import DataError
from mgavatar.files import one_line

ARKIT_NAMES = tuple(
    """
    browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft
    cheekSquintRight eyeBlinkLeft eyeBlinkRight eyeLookDownLeft eyeLookDownRight eyeLookInLeft eyeLookInRight
    eyeLookOutLeft eyeLookOutRight eyeLookUpLeft eyeLookUpRight eyeSquintLeft eyeSquintRight eyeWideLeft
    eyeWideRight jawForward jawLeft jawOpen jawRight mouthClose mouthDimpleLeft mouthDimpleRight
    mouthFrownLeft mouthFrownRight mouthFunnel mouthLeft mouthLowerDownLeft mouthLowerDownRight mouthPressLeft
    mouthPressRight mouthPucker mouthRight mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper
    mouthSmileLeft mouthSmileRight mouthStretchLeft mouthStretchRight mouthUpperUpLeft mouthUpperUpRight
    noseSneerLeft noseSneerRight tongueOut
    """.split()  # noqa: SIM905  shorter to read than a list
)
"""All 52 in alphabetical order, which is that of MediaPipe, LAM and the public maps to FLAME."""

BASIS = "arkit"

FEWEST_NAMES = 10
"""A file with fewer of the names is not taken for ARKit's: ``jawOpen`` alone is in files of many kinds."""


def _spellings(name: str) -> list[str]:
    """Return a name in lower case without separators: in full, and with L or R in the place of Left or Right."""
    plain = name.lower()
    for side in ("left", "right"):
        if plain.endswith(side) and plain not in ("jawleft", "jawright", "mouthleft", "mouthright"):
            return [plain, plain.removesuffix(side) + side[0]]
    return [plain]


_NAME_OF = {spelling: name for name in ARKIT_NAMES for spelling in _spellings(name)}


def arkit_name(text: str) -> str | None:
    """Return ARKit's own spelling of a name, or None if it is none of its 52.

    ``EyeBlinkLeft``, ``eyeBlink_L``, ``eye_blink_left`` and ``blendShapes.EyeBlinkLeft`` are all ``eyeBlinkLeft``.
    """
    plain = text.strip().rpartition(".")[2].lower().replace("_", "").replace(" ", "")
    return _NAME_OF.get(plain)


def n_arkit_names(names: Sequence[str]) -> int:
    """Return the number of ARKit's 52 among some names."""
    return len({arkit_name(name) for name in names} - {None})


def is_arkit(driving: Driving) -> bool:
    """Return True if the expression columns are ARKit's blendshapes, by their names."""
    return driving.expr_basis == BASIS or n_arkit_names(driving.expr_names) >= max(FEWEST_NAMES, driving.expr.shape[1])


@dataclass(frozen=True)
class Weights:
    """Weights of named blendshapes over T frames, as a file has them.

    Attributes:
        names: Names in the file's spelling, N of them.
        values: Shape [T, N]; a row of NaN is a frame in which no face was found.
        times: Time of each frame [s], shape [T], or None if frames follow each other regularly.
        fps: Frames per second, or None if the times say it.
        head: Rotation of the head as rotation vectors [rad], shape [T, 3], or None.
        eyes: Rotations of left and right eye against the head, shape [T, 6], or None.
        notes: Lines for the user.
    """

    names: Sequence[str]
    values: np.ndarray
    times: np.ndarray | None = None
    fps: float | None = None
    head: np.ndarray | None = None
    eyes: np.ndarray | None = None
    notes: tuple[str, ...] = field(default=())


def arkit_motion(weights: Weights, *, path: Path) -> Driving:
    """Return motion in ARKit's weights: names in one spelling, regular times, the head's rotation in the neck.

    Args:
        weights: What the file has.
        path: The file.

    Raises:
        DataError: If names are doubled, values are not finite, or times are impossible.
    """
    columns: dict[str, int] = {}
    unknown = []
    for column, own_name in enumerate(weights.names):
        name = arkit_name(own_name)
        if name is None:
            unknown.append(one_line(own_name, limit=40))
        elif name in columns:
            raise DataError(f"{path}: {one_line(own_name, limit=40)} is there twice; keep one column of each name")
        else:
            columns[name] = column
    names = tuple(sorted(columns))
    values = weights.values[:, [columns[name] for name in names]]
    rotations = {"neck_pose": weights.head, "left": None, "right": None}
    if weights.eyes is not None:
        rotations |= {"left": weights.eyes[:, :3], "right": weights.eyes[:, 3:]}
    found = {key: value for key, value in rotations.items() if value is not None}
    track = at_regular_times(Track(weights.times, values, found), fps=weights.fps, path=path)
    rows = {"expr": track.values}
    if "neck_pose" in found:
        rows["neck_pose"] = track.rotations["neck_pose"]
    if "left" in found:
        rows["eyes_pose"] = np.concatenate([track.rotations["left"], track.rotations["right"]], axis=1)
    return motion_of(
        {key: value.astype(np.float32) for key, value in rows.items()},
        path=path,
        fps=track.fps,
        expr_basis=BASIS,
        expr_names=names,
        notes=(*weights.notes, *track.notes, *_notes(unknown, values, path=path)),
    )


def _notes(unknown: list[str], values: np.ndarray, *, path: Path) -> list[str]:
    notes = []
    if unknown:
        shown = ", ".join(unknown[:5]) + (", …" if len(unknown) > 5 else "")
        notes.append(f"{path}: not used, because they are none of ARKit's blendshapes: {shown}")
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if largest > 5.0:
        notes.append(f"{path}: weights reach {largest:.4g}, and 1 is fully on; divide percentages by 100")
    return notes
