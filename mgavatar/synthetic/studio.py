"""Ray-traced images of a synthetic person: colours, cameras, ambient occlusion, one image."""

from __future__ import annotations

import colorsys

import numpy as np
import torch
import warp as wp
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from mgavatar.camera import Camera, look_at
from mgavatar.head.mesh_math import vertex_normals
from mgavatar.head.params import HeadParams
from mgavatar.kernels.portrait import N_SAMPLES, Look, View, portrait
from mgavatar.kernels.ray_cast import RayMesh, camera_rays
from mgavatar.synthetic.person import Person

_DISTANCE = 1.0
"""Distance of the cameras from the target [m]."""
_TARGET = np.array([0.0, -0.035, -0.02])
"""Point in the centre of all images [m]."""
_FIELD = 0.46
"""Length at the target that the shorter side of an image covers [m]."""
_FRONT_PITCH = -2.0
"""Pitch of the front and the side cameras; a negative one looks down [deg]."""


class Studio:
    """A person before the cameras, one timestep at a time.

    Attributes:
        person: The person.
        look: Colours of the person.
        mesh: The posed surface for ray casting.
        verts: Its vertices in world space [m], shape [V, 3], float64.
    """

    def __init__(self, person: Person, look: Look) -> None:
        """Prepare a person in the neutral pose; ambient occlusion is computed there, once."""
        self.person = person
        self.look = look
        verts, _ = person.posed(HeadParams.neutral(n_frames=1, n_expr=person.head.n_expr), 0)
        self.mesh = RayMesh(_tensor(verts), torch.from_numpy(person.faces))
        sky = open_sky(self.mesh, verts, vertex_normals(verts, person.faces))
        marks = np.column_stack([person.marks[:, :2], sky, person.marks[:, 2]])
        self._fixed = (
            torch.from_numpy(person.faces),
            torch.from_numpy(person.kinds),
            _tensor(person.rest),
            _tensor(marks),
        )
        self._flow = hair_flow(person.rest)
        self._samples = _tensor(qmc.Sobol(2, scramble=False).random(N_SAMPLES) + 0.5 / N_SAMPLES)
        self.verts = verts

    def stage(self, motion: HeadParams, frame: int) -> None:
        """Pose the person as in one frame of a motion; images follow with :meth:`shoot`."""
        self.verts, rotations = self.person.posed(motion, frame)
        self.mesh.move(_tensor(self.verts))
        flow = np.einsum("vab,vb->va", rotations, self._flow)
        self._moving = (_tensor(vertex_normals(self.verts, self.person.faces)), _tensor(flow))

    def shoot(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Ray-trace an image.

        Args:
            camera: Camera that sees the person as last staged.

        Returns:
            Image on white, shape [H, W, 3], and mask, shape [H, W], both uint8.
        """
        left, top, right, bottom = self._bounds(camera)
        picture = np.zeros((camera.height, camera.width, 4), np.float32)
        n_pixels = (right - left) * (bottom - top)
        view = _view(camera, left, top, right)
        surface = (*self._fixed, *self._moving)
        filled = portrait(self.mesh, view, self.look, samples=self._samples, n_pixels=n_pixels, surface=surface)
        picture[top:bottom, left:right] = filled.numpy().reshape(bottom - top, right - left, 4)
        cover = picture[..., 3:]
        image = np.rint(255.0 * (picture[..., :3] + 1.0 - cover)).clip(0, 255)
        return image.astype(np.uint8), np.rint(255.0 * cover[..., 0]).astype(np.uint8)

    def seen(self, camera: Camera) -> np.ndarray:
        """Return True for vertices of triangles that rays through the centres of the pixels hit, shape [V], bool."""
        rays = camera_rays(torch.from_numpy(camera.viewmat), torch.from_numpy(camera.K), camera.width, camera.height)
        _, face_ids, _ = self.mesh.cast(*rays)
        hit = np.unique(face_ids.numpy())
        seen = np.zeros(len(self.verts), bool)
        seen[self.person.faces[hit[hit >= 0]]] = True
        return seen

    def _bounds(self, camera: Camera) -> tuple[int, int, int, int]:
        """Return the pixels that the person's bounding box covers: left, top, right, bottom."""
        box = np.stack([self.verts.min(0), self.verts.max(0)])
        corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
        points = corners @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = (points @ camera.K.T)[:, :2] / points[:, 2:]
        size = np.array([camera.width, camera.height])
        low = np.clip(np.floor(pixels.min(0)).astype(int), 0, size)
        high = np.clip(np.ceil(pixels.max(0)).astype(int), 0, size)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def make_look(person: Person, rng: np.random.Generator) -> Look:
    """Draw the colours of skin, hair, eyes and garment.

    Args:
        person: The person.
        rng: Generator that draws the colours.
    """
    look = Look()
    tone = rng.uniform()
    light, dark = np.array([0.74, 0.43, 0.30]), np.array([0.22, 0.09, 0.045])
    skin = light * (dark / light) ** (tone**1.3)
    look.skin = wp.vec3(*skin)
    look.lips = wp.vec3(*(skin * np.array([0.86, 0.48, 0.50])))
    hair = _HAIR[int(rng.integers(len(_HAIR)))] if tone < 0.6 else _HAIR[int(rng.integers(2))]
    look.hair_dark, look.hair_light = (wp.vec3(*color) for color in hair)
    look.iris = wp.vec3(*_IRISES[int(rng.integers(len(_IRISES)))])
    hue = rng.uniform()
    look.cloth = wp.vec3(*(0.55 * np.array(colorsys.hsv_to_rgb(hue, rng.uniform(0.45, 0.8), rng.uniform(0.35, 0.9)))))
    look.print = wp.vec3(*np.array(colorsys.hsv_to_rgb((hue + 0.45) % 1.0, 0.25, 0.75)))
    look.freckles, look.stubble = float(rng.uniform(0.0, 0.9) * (tone < 0.55)), float(max(0.0, rng.uniform(-0.6, 0.6)))
    look.pattern = int(rng.integers(1, 4))
    eyes = (person.head.J_regressor @ person.head.v_template)[3:]
    ball = person.head.v_template[person.head.lbs_weights[:, 3] > 0.5]
    look.eye_offset = wp.vec3(*(eyes[0] - eyes.mean(0)))
    look.eye_radius = float(np.median(np.linalg.norm(ball - eyes[0], axis=1))) if len(ball) else 0.012
    look.seed = int(rng.integers(1, 1 << 30))
    return look


# Dark and light strands in linear RGB, from black to grey.
_HAIR = (
    ((0.018, 0.012, 0.009), (0.075, 0.048, 0.032)),
    ((0.045, 0.022, 0.011), (0.17, 0.088, 0.045)),
    ((0.12, 0.035, 0.012), (0.40, 0.14, 0.045)),
    ((0.22, 0.135, 0.055), (0.62, 0.43, 0.21)),
    ((0.14, 0.13, 0.125), (0.46, 0.45, 0.44)),
)
_IRISES = ((0.10, 0.17, 0.27), (0.10, 0.17, 0.08), (0.085, 0.040, 0.018), (0.20, 0.11, 0.03))


def open_sky(mesh: RayMesh, verts: np.ndarray, normals: np.ndarray, *, n_rays: int = 32) -> np.ndarray:
    """Return the ambient occlusion of each vertex by what lies within 10 cm: 0 in a cleft, 1 in the open, shape [V].

    Args:
        mesh: The surface.
        verts: Its vertices [m], shape [V, 3].
        normals: Its unit vertex normals, shape [V, 3].
        n_rays: Number of rays per vertex.
    """
    spread = qmc.Sobol(2, scramble=False).random(n_rays) + 0.5 / n_rays
    radius, turn = np.sqrt(spread[:, 0]), 2 * np.pi * spread[:, 1]
    # Points of a disc, evenly spread and lifted to the hemisphere above it: directions with the density of the cosine.
    local = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - radius**2)])
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    tangent = np.cross(helper, normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    frame = np.stack([tangent, np.cross(normals, tangent), normals], axis=1)
    starts, sky = _tensor(verts + 8e-4 * normals), np.zeros(len(verts))
    for ray in local:
        depths, _, _ = mesh.cast(starts, _tensor(ray @ frame))
        sky += np.minimum(depths.numpy().astype(np.float64) / 0.10, 1.0)
    return sky / n_rays


def hair_flow(rest: np.ndarray) -> np.ndarray:
    """Return the direction of the hair at points of the template: over the skull, away from the crown, shape [V, 3]."""
    arm = rest - np.array([0.0, 0.02, -0.075])
    arm /= np.linalg.norm(arm, axis=1, keepdims=True)
    down = np.array([0.0, -1.0, 0.0])
    flow = down - arm * (arm @ down)[:, None]
    return flow / np.maximum(np.linalg.norm(flow, axis=1, keepdims=True), 1e-9)


def frontal_arc(cameras: int, size: tuple[int, int]) -> list[Camera]:
    """Return two rows of cameras around the face, one looking down and one up; the held-out one is near the front.

    Args:
        cameras: Number of cameras.
        size: Image width and height [px].
    """
    n_lower = cameras // 2
    n_upper = cameras - n_lower
    lower_yaws = np.linspace(-52, 52, n_lower) if n_lower != 1 else [6.0]
    places = [(yaw, -13.0) for yaw in np.linspace(-60, 60, n_upper)] + [(yaw, 9.0) for yaw in lower_yaws]
    # The held-out number and that of the lower camera nearest to the front change places; 1e-6 prefers the left of two.
    held_out = held_out_camera(cameras)
    front = min(range(n_upper, cameras), key=lambda i: abs(places[i][0] - 1e-6), default=0)
    places[held_out], places[front] = places[front], places[held_out]
    return [_camera(yaw, pitch, size) for yaw, pitch in places]


def held_out_camera(cameras: int) -> int:
    """Return the index of the camera of the split of novel views: 8, as in the field, or else the last."""
    return 8 if cameras > 8 else cameras - 1


def front_camera(size: tuple[int, int]) -> Camera:
    """Return the one camera of a monocular capture; ``size`` is width and height [px]."""
    return _camera(0.0, _FRONT_PITCH, size)


def side_cameras(size: tuple[int, int]) -> list[Camera]:
    """Return cameras 60 degrees to either side, which see what the one of a monocular capture does not see."""
    return [_camera(yaw, _FRONT_PITCH, size) for yaw in (-60.0, 60.0)]


def _camera(yaw: float, pitch: float, size: tuple[int, int]) -> Camera:
    """Return a camera on a sphere around the target, at these angles [deg]."""
    turn = Rotation.from_euler("YX", [yaw, pitch], degrees=True).as_matrix()
    focal = min(size) * _DISTANCE / _FIELD
    position = _TARGET + _DISTANCE * turn[:, 2]
    return look_at(position, _TARGET, focal=focal, width=size[0], height=size[1])


def _view(camera: Camera, left: int, top: int, right: int) -> View:
    """Return a camera as the ray tracer takes it, for the pixels right of ``left`` and below ``top``."""
    view = View()
    view.origin = wp.vec3(*camera.position)
    view.to_world = wp.mat33(*camera.viewmat[:3, :3].T.ravel())
    view.focal = wp.vec2(camera.K[0, 0], camera.K[1, 1])
    view.center = wp.vec2(camera.K[0, 2], camera.K[1, 2])
    view.corner = wp.vec2(float(left), float(top))
    view.columns = max(right - left, 1)
    return view


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.array(values, np.float32))
