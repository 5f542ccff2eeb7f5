"""An avatar without its networks: splats with spherical harmonics and a coloured mesh, in one pose.

Every file for other programs is made of these.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mgavatar.appearance.spherical_harmonics import sh_basis, sh_colors
from mgavatar.avatar import Avatar
from mgavatar.camera import Camera
from mgavatar.driving.retarget import head_points
from mgavatar.gaussians import SH_C0, Gaussians, draw
from mgavatar.head.params import Pose
from mgavatar.scoring.image_metrics import psnr

MARGIN_DEGREES = 15.0
"""Directions beside those of the training cameras that count as seen: the head is no point."""

_IN_CONE = 40
_ON_SPHERE = 40
_SPHERE_WEIGHT = 0.02
"""Weight of all directions on the sphere together, with that of those in the cone being 1."""
_FAR = 1e4
"""Distance of a point from which all Gaussians are seen along one direction [m]."""

_FLIP = (1.0, -1.0, -1.0)
"""Half a turn about the x axis."""


@dataclass(frozen=True, eq=False)
class Splats:
    """World-space Gaussians whose colours are spherical harmonics of the world's direction from the eye to them.

    Attributes:
        means: Centres [m], shape [N, 3].
        quats: Unit rotations wxyz, shape [N, 4].
        scales: Standard deviations [m], shape [N, 3].
        opacities: In 0..1, shape [N].
        sh: Coefficients, shape [N, (degree + 1)^2, 3]; colours are 0.5 plus their sum, at least 0.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Return the degree of the spherical harmonics."""
        return math.isqrt(self.sh.shape[1]) - 1

    def gaussians(self, camera: Camera) -> Gaussians:
        """Return the Gaussians as a camera sees them."""
        position = torch.tensor(camera.position, dtype=torch.float32, device=self.means.device)
        directions = torch.nn.functional.normalize(self.means - position, dim=1)
        colors = sh_colors(self.sh[:, 0], self.sh[:, 1:], directions)
        return Gaussians(self.means, self.quats, self.scales, self.opacities, colors)

    def upside_down(self) -> Splats:
        """Return the splats after half a turn about the x axis: y points down, as in most captures of scenes."""
        flip = torch.tensor(_FLIP, device=self.means.device)
        w, x, y, z = self.quats.unbind(1)
        turned = torch.stack([-x, w, -z, y], 1)  # the product of (0, 1, 0, 0) and the rotation
        # Each basis function is even or odd in y and in z, so the half turn changes at most its sign. One direction
        # at which none of them is zero shows which.
        probe = torch.nn.functional.normalize(torch.tensor([[0.9, 0.5, 0.3]], device=self.means.device), dim=1)
        signs = (sh_basis(probe * flip, self.degree) / sh_basis(probe, self.degree)).round()
        return replace(self, means=self.means * flip, quats=turned, sh=self.sh * signs[0, :, None])


@dataclass(frozen=True, eq=False)
class Mesh:
    """A coloured mesh.

    Attributes:
        verts: Vertices in the order of the head model and its subdivision [m], shape [V, 3], float32.
        faces: Vertex indices, counter-clockwise from outside, shape [F, 3], int32.
        normals: Unit normals, shape [V, 3], float32; zero at a vertex without a face.
        colors: RGB in 0..1, as a display shows them, shape [V, 3], float32.
        vt: Texture coordinates, v up, shape [U, 2], float32.
        ft: Texture indices of each face, shape [F, 3], int32.
    """

    verts: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    vt: np.ndarray
    ft: np.ndarray


@torch.no_grad()
def bake_splats(avatar: Avatar, pose: Pose, *, degree: int = 3) -> list[Splats]:
    """Return the Gaussians of a pose with colours of each degree up to ``degree``, the best of that degree.

    OffsetNet is evaluated at the pose. Colours are those of the avatar by weighted least squares: over directions from
    which training cameras see the head, which count most, and over all others, for which the avatar is a guess as well
    but a smooth one. Vertex-bound Gaussians lie behind the surface by their mean distance over the training cameras.

    Args:
        avatar: The avatar.
        pose: The pose, on any device.
        degree: Largest degree, 0 to 3.

    Returns:
        Splats of degree 0, 1, ... ``degree``, which differ in ``sh`` only.
    """
    pose = pose.to(avatar.device)
    appearance = avatar.appearance
    if appearance is None:
        posed = avatar.head.posed(pose)
        views = [avatar.vertex_gaussians.bound(posed, camera) for camera in cameras_around(avatar, pose)]
        bound = replace(views[0], means=torch.stack([view.means for view in views]).mean(0))
        constant = ((bound.colors - 0.5) / SH_C0)[:, None]
        fits = [torch.cat([constant, constant.new_zeros(len(constant), n * (n + 2), 3)], 1) for n in range(degree + 1)]
    else:
        mesh = appearance.frozen.posed(pose)
        bound = appearance.bound(mesh)[0]
        directions, weights = view_directions(avatar, pose)
        basis = sh_basis(torch.from_numpy(directions).double(), degree)
        sums = torch.zeros(len(bound.means), basis.shape[1], 3, device=avatar.device)
        for direction, weight, values in zip(directions, weights, basis, strict=True):
            colors = appearance.view_colors(bound.means, mesh, _far_camera(direction)) + bound.colors - 0.5
            sums += colors[:, None] * (weight * values).to(sums)[:, None]
        fits = [_solved(basis, weights, sums, n) for n in range(degree + 1)]
    quats = torch.nn.functional.normalize(bound.quats, dim=1)
    quats[quats.norm(dim=1) < 0.5] = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    return [Splats(bound.means, quats, bound.scales.contiguous(), bound.opacities, sh) for sh in fits]


def _far_camera(direction: np.ndarray) -> Camera:
    """Return a camera so far away that all Gaussians are seen along one direction."""
    viewmat = np.eye(4)
    viewmat[:3, 3] = _FAR * direction
    return Camera(viewmat, np.eye(3), 1, 1)


def _solved(basis: Tensor, weights: np.ndarray, sums: Tensor, degree: int) -> Tensor:
    """Solve the normal equations of one degree, of which those of lower degrees are the upper left part."""
    n = (degree + 1) ** 2
    weighted = basis[:, :n] * torch.from_numpy(weights)[:, None]
    inverse = torch.linalg.inv(weighted.T @ basis[:, :n]).to(sums)
    return torch.einsum("kl,nlc->nkc", inverse, sums[:, :n])


@torch.no_grad()
def bake_mesh(avatar: Avatar, pose: Pose) -> Mesh:
    """Return the personal mesh in a pose, with the colours that the geometry stage gave its vertices.

    Args:
        avatar: The avatar.
        pose: The pose, on any device.
    """
    body = avatar.head.body
    verts = avatar.verts(pose)
    colors = _vertex_colors(avatar, pose).clamp(0.0, 1.0)
    return Mesh(
        verts=verts.cpu().numpy(),
        faces=body.faces.cpu().numpy(),
        normals=body.normals(verts).cpu().numpy(),
        colors=colors.cpu().numpy(),
        vt=body.fine.vt,
        ft=body.fine.ft,
    )


def _vertex_colors(avatar: Avatar, pose: Pose) -> Tensor:
    """Return a colour for every vertex, shape [V, 3].

    Vertex-bound Gaussians are opaque and lie on the mesh, so their colours are its own. Where a fit had no geometry
    stage, which leaves them grey, it is the mean over the Gaussians of all faces around a vertex, weighted by opacity
    and cross-section: a blurred picture, because several transparent layers make up what the avatar shows.
    """
    own = 0.5 + SH_C0 * avatar.vertex_gaussians.colors
    if avatar.appearance is None or bool(avatar.vertex_gaussians.colors.any()):
        return own
    flat = bake_splats(avatar, pose, degree=0)[0]
    largest = flat.scales.topk(2, dim=1).values
    weights = flat.opacities * largest.prod(1)
    weights = weights / weights.mean().clamp(min=1e-30)
    colors = 0.5 + SH_C0 * flat.sh[:, 0]
    corners = avatar.head.body.faces.long()[avatar.appearance.gaussians.face_ids]
    # A vertex without a Gaussian around it stays grey.
    total = torch.full((len(own), 4), 1e-6, device=own.device) * torch.cat([own, torch.ones_like(own[:, :1])], 1)
    rows = torch.cat([colors, torch.ones_like(colors[:, :1])], 1) * weights[:, None]
    for corner in range(3):
        total.index_add_(0, corners[:, corner], rows)
    return total[:, :3] / total[:, 3:]


def baking_costs(avatar: Avatar, pose: Pose, baked: list[Splats]) -> list[float]:
    """Return the PSNR [dB] of each of the baked splats against the avatar, in the mean camera's view of the head."""
    camera = cameras_around(avatar, pose)[0]
    target = avatar.render(pose, camera).image.clamp(0.0, 1.0)
    background = torch.tensor(avatar.capture.background, device=avatar.device)
    images = [draw(s.gaussians(camera), camera, background=background, config=avatar.config.raster) for s in baked]
    return [psnr(image.image.clamp(0.0, 1.0), target) for image in images]


def cameras_around(avatar: Avatar, pose: Pose) -> list[Camera]:
    """Return the training cameras, moved with the head from its mean pose to ``pose``; the mean camera is the first."""
    mean = avatar.mean_pose()
    (turn, place), (mean_turn, mean_place) = (_head_frames(avatar, *_rows(given)) for given in (pose, mean))
    back = (mean_turn * turn.inv()).as_matrix()[0]
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = back, mean_place[0] - back @ place[0]
    first = avatar.capture.mean_camera()
    others = [camera for camera in avatar.capture.cameras.values() if camera is not first]
    return [replace(camera, viewmat=camera.viewmat @ moved) for camera in (first, *others)]


def view_directions(avatar: Avatar, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Return directions from eyes to the head in a pose, and their weights for a fit of colours.

    One half fills the cone of those from which training cameras saw the head, wherever it was turned, with a margin
    of ``MARGIN_DEGREES``. The other half is spread over the sphere, with little weight.

    Returns:
        Unit directions in the world, shape [M, 3], and weights whose sum is about 1, shape [M].
    """
    seen = _seen_directions(avatar, pose)
    axis = seen.mean(axis=0)
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-6 else np.array([0.0, 0.0, -1.0])
    widest = float(np.arccos(np.clip((seen @ axis).min(), -1.0, 1.0)))
    half_angle = min(math.pi, widest + math.radians(MARGIN_DEGREES))
    directions = np.concatenate([_spiral(axis, half_angle, _IN_CONE), _spiral(axis, math.pi, _ON_SPHERE)])
    weights = np.repeat([1.0 / _IN_CONE, _SPHERE_WEIGHT / _ON_SPHERE], [_IN_CONE, _ON_SPHERE])
    return directions, weights


def _seen_directions(avatar: Avatar, pose: Pose) -> np.ndarray:
    """Return the directions in which training cameras saw the head, turned with it to ``pose``, shape [M, 3]."""
    train = list(avatar.capture.train_timesteps)
    names = ("rotation", "neck_pose", "translation")
    rows = [avatar.head.poses[name].detach().cpu().numpy()[train] for name in names]
    turns, places = _head_frames(avatar, *rows)
    eyes = np.stack([camera.position for camera in avatar.capture.cameras.values()])
    now = _head_frames(avatar, *_rows(pose))[0]
    seen = [(now * turns.inv()).apply(places - eye) for eye in eyes]
    directions = np.concatenate(seen)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True).clip(min=1e-12)


def _rows(pose: Pose) -> list[np.ndarray]:
    return [value.cpu().numpy()[None] for value in (pose.rotation, pose.neck_pose, pose.translation)]


def _head_frames(
    avatar: Avatar, rotation: np.ndarray, neck: np.ndarray, translation: np.ndarray
) -> tuple[Rotation, np.ndarray]:
    """Return how the head is turned in T poses, and the place of a point inside of it [m], shape [T, 3]."""
    turns = Rotation.from_rotvec(rotation) * Rotation.from_rotvec(neck)
    return turns, head_points(avatar, rotation, neck, translation)


def _spiral(axis: np.ndarray, half_angle: float, n: int) -> np.ndarray:
    """Return ``n`` unit directions, evenly spread over the cone around ``axis``, shape [n, 3]."""
    golden = math.pi * (3.0 - math.sqrt(5.0))
    steps = np.arange(n) + 0.5
    height = 1.0 - (1.0 - math.cos(half_angle)) * steps / n  # equal steps in height have equal areas
    radius = np.sqrt(np.clip(1.0 - height**2, 0.0, None))
    local = np.stack([radius * np.cos(golden * steps), radius * np.sin(golden * steps), height], axis=1)
    turn, _ = Rotation.align_vectors(axis[None], [[0.0, 0.0, 1.0]])
    return turn.apply(local)
