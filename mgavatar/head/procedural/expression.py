"""Expression directions of the built-in head: local, smooth, in mirrored pairs."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from mgavatar.head.procedural import surface as form
from mgavatar.head.procedural.mesh import HeadMesh
from mgavatar.head.procedural.rig import JOINTS_AT, MIRROR_X
from mgavatar.head.procedural.surface import smoothstep

Array = np.ndarray
Zone = Literal["all", "upper", "lower"]

N_EXPR = 100
LID_REACH = (1.0, 0.86, 0.66, 0.42, 0.18, 0.0)
"""Share of the lid's rotation in each ring around the eye, from the edge of the lids outwards."""

SOCKET_SHARE = (0.9, 0.6, 0.3, 0.1, 0.0, 0.0)
"""Share of the motion of the lips' edge in each ring inside the mouth, from the lips inwards."""


class Pull(NamedTuple):
    """A displacement in one direction that falls off like a bell around a point of the featureless face.

    Attributes:
        at: Centre of the bell, x and y [mm].
        width: Width of the bell in x and y [mm].
        shift: Displacement in the centre [mm].
        zone: Restricts the displacement to the face above or below the mouth line.
    """

    at: tuple[float, float]
    width: tuple[float, float]
    shift: tuple[float, float, float]
    zone: Zone = "all"


# Left halves of mirrored pairs: name_L is as written here, name_R is its mirror image.
PAIRS: dict[str, tuple[Pull, ...]] = {
    "smile": (
        Pull((25, -46), (12, 12), (5.5, 6.5, -4)),
        Pull((36, -14), (15, 13), (1, 3, 2.5)),
        Pull((10, -47), (9, 10), (1, 0.8, -1)),
    ),
    "frown": (Pull((25, -49), (12, 11), (0.5, -7, -1)), Pull((18, -64), (12, 10), (0, -2, 0.5))),
    "upper_lip_raise": (Pull((11, -40), (10, 9), (0, 5.5, 1), "upper"), Pull((16, -22), (9, 9), (0, 2, 0.8))),
    "lower_lip_depress": (Pull((11, -55), (10, 9), (0, -5.5, 0.5), "lower"),),
    "dimple": (Pull((28, -47), (9, 10), (3, 0.5, -4.5)),),
    "lip_stretch": (Pull((27, -50), (14, 13), (6.5, -1.5, -3.5)),),
    "brow_down": (Pull((22, 42), (15, 9), (-2.5, -5.5, 0.5)),),
    "brow_inner_up": (Pull((13, 46), (11, 12), (0.5, 6.5, 0.5)),),
    "brow_outer_up": (Pull((42, 45), (14, 12), (0, 6.5, -0.5)),),
    "cheek_puff": (Pull((38, -42), (15, 16), (6, 0, 6)), Pull((20, -46), (12, 12), (0, 0, 2.5))),
    "cheek_suck": (Pull((40, -36), (13, 15), (-5, 0, -4)),),
    "cheek_raise": (Pull((38, 0), (14, 10), (0, 4, 2.5)),),
    "nose_sneer": (Pull((13, -12), (7, 12), (0.5, 4.5, 0.5)), Pull((12, -38), (9, 8), (0, 2.5, 0.5), "upper")),
    "nostril_flare": (Pull((14, -18), (6, 6), (2.2, 0.3, 0.3)),),
    "jaw_clench": (Pull((50, -56), (14, 16), (3, 0, 0.5)),),
}

# Directions that move both sides.
CENTRED: dict[str, tuple[Pull, ...]] = {
    "pucker": (
        Pull((24, -47), (12, 14), (-8.5, 0, 3.5)),
        Pull((-24, -47), (12, 14), (8.5, 0, 3.5)),
        Pull((0, -47), (17, 13), (0, 0, 6)),
    ),
    "funnel": (
        Pull((23, -47), (12, 14), (-6, 0, 3)),
        Pull((-23, -47), (12, 14), (6, 0, 3)),
        Pull((0, -40), (15, 9), (0, 4, 6), "upper"),
        Pull((0, -54), (15, 9), (0, -4.5, 6), "lower"),
    ),
    "lip_press": (
        Pull((0, -40), (22, 7), (0, -1.0, -3), "upper"),
        Pull((0, -54), (22, 7), (0, 1.4, -3), "lower"),
    ),
    "upper_lip_roll": (Pull((0, -42), (20, 6), (0, -1.2, -4), "upper"),),
    "lower_lip_roll": (Pull((0, -52), (20, 6), (0, 1.4, -4), "lower"),),
    "mouth_left": (Pull((0, -47), (30, 16), (8, 0, 0)),),
    "mouth_right": (Pull((0, -47), (30, 16), (-8, 0, 0)),),
    "chin_raise": (Pull((0, -76), (18, 12), (0, 4.5, 1)), Pull((0, -56), (18, 8), (0, 1.2, 1.5), "lower")),
}


def _details() -> list[tuple[str, tuple[Pull, ...]]]:
    """Return the left halves of finer pairs around mouth, brows, cheeks and chin."""
    out: list[tuple[str, tuple[Pull, ...]]] = []
    zones: tuple[tuple[Zone, float], ...] = (("upper", 4.0), ("lower", -4.5))
    for zone, offset in zones:
        for x in (5.0, 13.0, 21.0):
            for axis, shift in (("y", (0.0, 2.2, 0.0)), ("z", (0.0, 0.0, 2.2))):
                out.append((f"{zone}_lip_{x:.0f}_{axis}", (Pull((x, -47 + offset), (6, 6), shift, zone),)))
    for x in (14.0, 28.0, 42.0):
        out.append((f"brow_{x:.0f}_y", (Pull((x, 43), (7, 8), (0, 2.5, 0)),)))
        out.append((f"brow_{x:.0f}_z", (Pull((x, 43), (7, 8), (0, 0, 2.0)),)))
    for x, y in ((25.0, -10.0), (42.0, -12.0), (30.0, -30.0), (46.0, -34.0)):
        out.append((f"cheek_{x:.0f}_{-y:.0f}", (Pull((x, y), (9, 9), (0.8, 0, 2.2)),)))
    out.append(("chin_side", (Pull((14, -78), (9, 9), (0.5, 0, 2)),)))
    out.append(("nose_side", (Pull((12, 4), (7, 9), (1, 0, 1.5)),)))
    return out


class _Face:
    """The mesh as all directions see it.

    Attributes:
        mesh: The mesh.
        rest: Place of each vertex on the featureless face [m], shape [V, 3]; inside the mouth, that of the lip's edge.
        movable: Share of a pull in the motion of each vertex, 0..1, shape [V].
        upper: 1 above the mouth line, 0 below it, smooth between, shape [V].
    """

    def __init__(self, mesh: HeadMesh) -> None:
        self.mesh = mesh
        self.rest = np.nan_to_num(mesh.rest, nan=-1.0)
        height = np.abs(self.rest[:, 1])
        self.movable = smoothstep(-0.045, -0.005, self.rest[:, 2]) * (1.0 - smoothstep(0.085, 0.105, height))
        for k, share in enumerate(SOCKET_SHARE, start=1):
            ids, lips = mesh.groups[f"socket_{k}"], mesh.groups["lip_0"]
            for inner, outer in ((ids, lips), (mesh.mirror[ids], mesh.mirror[lips])):
                self.rest[inner], self.movable[inner] = self.rest[outer], share
        self.upper = smoothstep(-0.0042, 0.0042, self.rest[:, 1] - form.MOUTH_Y)
        from_eye = np.stack([np.abs(self.rest[:, 0]), self.rest[:, 1]], axis=1) - form.EYE[:2]
        # Only the lid directions move the lids: any other motion would push them into the eyeball.
        self.movable *= smoothstep(0.75, 1.45, np.linalg.norm(from_eye / [0.0175, 0.0105], axis=1))

    def pulls(self, pulls: tuple[Pull, ...]) -> Array:
        """Return the sum of some pulls, shape [V, 3] [m]."""
        out = np.zeros_like(self.rest)
        for pull in pulls:
            offset = (self.rest[:, :2] - np.array(pull.at) / 1000.0) / (np.array(pull.width) / 1000.0)
            weight = self.movable * np.exp(-np.sum(offset**2, axis=1))
            weight *= {"all": 1.0, "upper": self.upper, "lower": 1.0 - self.upper}[pull.zone]
            out += weight[:, None] * np.array(pull.shift) / 1000.0
        return out

    def left(self) -> Array:
        """Return 1 on the left, 0 on the right, smooth across the middle, shape [V, 1]."""
        return smoothstep(-0.007, 0.007, self.mesh.verts[:, :1])

    def mirrored(self, field: Array) -> Array:
        """Return the mirror image of a displacement, shape [V, 3]."""
        return field[self.mesh.mirror] * MIRROR_X


def _rotate_about_eye(points: Array, angle: Array) -> Array:
    """Return the displacement by a rotation about the x axis through the left eye; a positive one raises the front.

    Args:
        points: Shape [N, 3] [m].
        angle: Angle of each point [rad], shape [N].
    """
    y, z = points[:, 1] - form.EYE[1], points[:, 2] - form.EYE[2]
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.zeros_like(y), y * c + z * s - y, z * c - y * s - z], axis=1)


def lid_direction(mesh: HeadMesh, *, upper: float, lower: float) -> Array:
    """Return the displacement of the left lids, shape [V, 3] [m].

    Each point of their edge turns about the horizontal axis through the eye, and so stays outside the eyeball.

    Args:
        mesh: The mesh.
        upper: Turn of the upper lid; 1 takes it to the line where the lids meet, a negative one opens it further.
        lower: The same for the lower lid.
    """
    edge = mesh.groups["lid_0"]
    at = mesh.verts[edge] - form.EYE
    n = len(edge)
    # The ring is sampled evenly in its angle from 0 (outer corner) over pi (inner corner): the angles t and -t are one
    # above the other, so the partner of point i on the other lid is point n - i.
    opposite = at[(n - np.arange(n)) % n, 1]
    is_upper = np.arange(n) <= n // 2
    low, high = np.minimum(at[:, 1], opposite), np.maximum(at[:, 1], opposite)
    gap = np.where(is_upper, 0.00006, -0.00006) * (high - low > 1e-5)  # the closed lids do not touch
    meet = low + 0.30 * (high - low) + gap
    # The height of a point at angle a about the axis is radius * sin(a): the turn that brings it to ``meet`` follows.
    radius = np.hypot(at[:, 1], at[:, 2])
    turn = np.arcsin(np.clip(meet / radius, -1, 1)) - np.arctan2(at[:, 1], at[:, 2])
    turn *= np.where(is_upper, upper, lower)
    out = np.zeros_like(mesh.verts)
    shares = [(f"lid_{k}", share) for k, share in enumerate(LID_REACH)] + [("lid_margin", 1.0), ("lid_inner", 0.4)]
    for group, share in shares:
        ids = mesh.groups[group]
        out[ids] = _rotate_about_eye(mesh.verts[ids], turn * share)
    return out


def jaw_directions(mesh: HeadMesh, jaw: Array) -> list[tuple[str, Array]]:
    """Return named motions of the jaw and all that follows it, shape [V, 3] each [m].

    Args:
        mesh: The mesh.
        jaw: Share of the jaw's motion in that of each vertex, shape [V].
    """
    from_joint = mesh.verts - JOINTS_AT[2]
    c, s = np.cos(0.22), np.sin(0.22)
    x, y, z = from_joint.T
    opened = np.stack([x, y * c - z * s, y * s + z * c], axis=1)  # turned about the x axis
    motions = {"jaw_open": opened - from_joint}
    motions["jaw_left"] = np.broadcast_to(np.array([0.006, 0.0, 0.0]), from_joint.shape)
    motions["jaw_right"] = np.broadcast_to(np.array([-0.006, 0.0, 0.0]), from_joint.shape)
    motions["jaw_forward"] = np.broadcast_to(np.array([0.0, -0.0005, 0.006]), from_joint.shape)
    return [(name, jaw[:, None] * motion) for name, motion in motions.items()]


def expression_directions(mesh: HeadMesh, jaw: Array) -> tuple[Array, tuple[str, ...]]:
    """Return the expression directions and their names.

    Args:
        mesh: The mesh.
        jaw: Share of the jaw's motion in that of each vertex, shape [V].

    Returns:
        Directions, shape [V, 3, 100] [m]; a coefficient of 1 is the full expression. Names, 100 of them.
    """
    face = _Face(mesh)
    named: list[tuple[str, Array]] = []

    def add_pair(name: str, left: Array) -> None:
        named.extend([(f"{name}_L", left), (f"{name}_R", face.mirrored(left))])

    for name, pulls in PAIRS.items():
        add_pair(name, face.pulls(pulls) * face.left())
    add_pair("blink", lid_direction(mesh, upper=1.0, lower=1.0))
    add_pair("wide", lid_direction(mesh, upper=-0.32, lower=-0.25))
    squint = lid_direction(mesh, upper=0.22, lower=0.75)
    add_pair("squint", squint + face.pulls((Pull((34, 5), (14, 8), (0, 1.8, 1.2)),)) * face.left())
    add_pair("upper_lid_up", lid_direction(mesh, upper=-0.30, lower=0.0))
    named.extend((name, face.pulls(pulls)) for name, pulls in CENTRED.items())
    named.extend(jaw_directions(mesh, jaw))
    for name, pulls in _details():
        add_pair(name, face.pulls(pulls) * face.left())
    named.append(("chin_z", face.pulls((Pull((0, -80), (12, 10), (0, 0, 2)),))))
    named.append(("philtrum_z", face.pulls((Pull((0, -33), (8, 7), (0, 0, 1.5), "upper"),))))
    names = tuple(name for name, _ in named)
    return np.stack([field for _, field in named], axis=-1), names
