"""The appearance on a frozen head: from a pose and a camera to Gaussians in the world (Section 3.2)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from mgavatar.appearance.color_net import ColorNet
from mgavatar.appearance.face_gaussians import PARAMETERS, FaceFrames, FaceGaussians, face_uvs
from mgavatar.appearance.offset_net import OffsetNet
from mgavatar.appearance.spherical_harmonics import sh_colors
from mgavatar.camera import Camera
from mgavatar.config import ResolvedConfig
from mgavatar.gaussians import Gaussians
from mgavatar.geometry.head import PersonalHead
from mgavatar.head.params import Pose
from mgavatar.kernels.binding import bind_to_faces, directions_on_faces
from mgavatar.kernels.face_frames import gather_matrix
from mgavatar.kernels.sparse import SparseMatrix, sparse_apply
from mgavatar.kernels.uv_map import UvMap, position_map, uv_map, uv_sampler

_CACHED_POSES = 256


@dataclass(frozen=True, eq=False)
class PosedMesh:
    """A frozen head in one pose.

    Attributes:
        verts: In world space [m], shape [V, 3].
        frames: Face frames of ``verts``.
        pose_map: ``M_pose``, positions without root motion in units of the head's size, shape [3, H, W], or empty.
        theta: Rotation vectors of the five joints [rad], shape [15].
    """

    verts: Tensor
    frames: FaceFrames
    pose_map: Tensor
    theta: Tensor


class FrozenHead:
    """The result of the geometry stage; nothing in it learns any more.

    Attributes:
        head: The personal head.
        body: Its subdivided head model.
        canonical: Vertices of the canonical head ``mu_c`` [m], shape [V, 3].
        frames: Face frames of the canonical head.
        low: Lowest corner of its bounding box [m], shape [3].
        high: Highest corner [m], shape [3].
        extent: Diagonal of its bounding box [m], with which density control compares sizes.
        face_vt: Texture coordinates of the faces' corners, shape [F, 3, 2].
        canonical_map: ``M_cano``, canonical positions in units of the head's size, shape [3, H, W], or empty.
    """

    def __init__(self, head: PersonalHead, *, uv_resolution: int | None) -> None:
        """Freeze a personal head.

        Args:
            head: The personal head.
            uv_resolution: Height and width of the position maps, or None without them.
        """
        self.head = head
        self.body = head.body
        fine = self.body.fine
        device = self.body.device
        for parameter in head.parameters():
            parameter.requires_grad_(False)
        with torch.no_grad():
            self.canonical = head.canonical()
            self.frames = FaceFrames.of(self.canonical, self.body.faces, corners=self.body.face_corners)
        low, high = self.canonical.min(0).values, self.canonical.max(0).values
        self.low, self.high = low, high
        self.extent = float((high - low).norm())
        vt, ft = torch.tensor(fine.vt, device=device), torch.tensor(fine.ft, dtype=torch.int32, device=device)
        self.face_vt = vt[ft.long()]
        self._uv: UvMap | None = None
        self.canonical_map = torch.zeros(3, 0, 0, device=device)
        if uv_resolution is not None:
            self._uv = uv_map(vt, ft, self.body.faces, self.body.n_verts, uv_resolution, uv_resolution)
            self.canonical_map = self._map(self.canonical)
        self.forget_poses()

    def move(self, fn: Callable[[Tensor], Tensor]) -> None:
        """Apply ``fn``, such as a move to another device, to every tensor of the head."""
        self.head._apply(fn)
        self.canonical, self.low, self.high = fn(self.canonical), fn(self.low), fn(self.high)
        self.frames = FaceFrames(*(fn(tensor) for tensor in self.frames.all))
        self.face_vt, self.canonical_map = fn(self.face_vt), fn(self.canonical_map)
        self._uv = self._uv.to(self.canonical.device) if self._uv is not None else None
        self.forget_poses()

    def forget_poses(self) -> None:
        """Drop the posed meshes that are kept; call it when the head's poses have changed."""
        self._posed: OrderedDict[int, PosedMesh] = OrderedDict()

    def _map(self, verts: Tensor) -> Tensor:
        if self._uv is None:
            return self.canonical_map
        # One scale for all axes, so that the largest side goes from -1 to 1 and distances keep their ratios.
        center, half = (self.low + self.high) / 2, (self.high - self.low).max() / 2
        return position_map(self._uv, (verts - center) / half)

    def posed(self, pose: Pose, *, maps_grad: bool = False) -> PosedMesh:
        """Return the head in any pose, differentiable in it.

        Args:
            pose: The pose.
            maps_grad: Keep the gradient through OffsetNet's inputs too; training does without it.
        """
        verts = self.head.posed(pose).verts
        # Training keeps no graph of the maps: the head is frozen, and tuned poses have their gradient through Eq. 8.
        with torch.set_grad_enabled(maps_grad and torch.is_grad_enabled()):
            still = self.head.posed(pose.without_root()).verts if self._uv is not None else verts
            theta = pose.joint_rotations().reshape(-1)
            pose_map = self._map(still)
        frames = FaceFrames.of(verts, self.body.faces, corners=self.body.face_corners)
        return PosedMesh(verts, frames, pose_map, theta)

    @torch.no_grad()
    def at_timestep(self, timestep: int) -> PosedMesh:
        """Return the head at a timestep of its capture, without a gradient; the most recently used ones are cached."""
        if timestep not in self._posed:
            if len(self._posed) >= _CACHED_POSES:
                self._posed.popitem(last=False)  # the least recently used one, because hits move to the end
            self._posed[timestep] = self.posed(self.head.pose(timestep))
        self._posed.move_to_end(timestep)
        return self._posed[timestep]


class Appearance(nn.Module):
    """Face-bound Gaussians with ColorNet (or spherical harmonics) and OffsetNet.

    Attributes:
        frozen: The head; no submodule, because its parameters are not the appearance's.
        gaussians: The Gaussians.
        color_net: ColorNet, or None if colours are spherical harmonics.
        offset_net: OffsetNet, or None if it is switched off.
        view_frame: Frame of the view directions: ``"canonical"``, ``"world"`` or ``"none"``.
    """

    def __init__(self, frozen: FrozenHead, config: ResolvedConfig, *, seed: int) -> None:
        """Bind one Gaussian to each face; ``seed`` is that of the hash grid's table."""
        super().__init__()
        a = config.appearance
        self.frozen = frozen
        self.config = config
        device = frozen.canonical.device
        self.gaussians = FaceGaussians(len(frozen.body.faces), a, device)
        # Gaussians may leave the surface by about their face's size; a twentieth of the head leaves room for all.
        margin = 0.05 * (frozen.high - frozen.low)
        self.color_net = (
            ColorNet(frozen.low - margin, frozen.high + margin, a.color_net, seed=seed).to(device)
            if a.colors == "color_net"
            else None
        )
        self.view_frame = a.color_net.view_frame if a.colors == "color_net" else a.sh.view_frame
        self.offset_net = OffsetNet(a.offset_net).to(device) if a.offset_net.enabled else None
        self._forget()
        # A loaded state brings other faces and texture coordinates.
        self.register_load_state_dict_post_hook(lambda module, _: module._forget())
        self.rebind()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Appearance:
        """Move the head with the parameters, although it is no part of them; torch calls this for ``to``."""
        super()._apply(fn, recurse)
        self.frozen.move(fn)
        self._forget()
        return self

    def _forget(self) -> None:
        """Drop what was prepared for the Gaussians' faces and texture coordinates, because they have changed."""
        self._sampler: SparseMatrix | None = None
        self._by_face: SparseMatrix | None = None

    def rebind(self) -> None:
        """Look up the Gaussians' texture coordinates anew; call it when their number has changed."""
        g, frozen = self.gaussians, self.frozen
        means = g.local_means.detach()
        g.uvs = face_uvs(means, g.face_ids, frozen.frames, frozen.canonical, frozen.body.faces, frozen.face_vt)
        self._forget()

    def resize(self, n: int) -> None:
        """Make room for ``n`` Gaussians, before a state of that many is loaded."""
        self.gaussians.resize(n)
        self._forget()

    def _order(self, posed: PosedMesh) -> SparseMatrix | None:
        """Gaussians by face, for the gradient of a head that still learns."""
        if self._by_face is None and posed.frames.quats.requires_grad:
            self._by_face = gather_matrix(self.gaussians.face_ids, self.gaussians.n_faces)
        return self._by_face

    def offsets(self, posed: PosedMesh) -> tuple[Tensor, Tensor] | None:
        """Return ``O_map`` of Eq. 10, [13, H, W], and the row of it that each Gaussian reads, [N, 13]."""
        if self.offset_net is None:
            return None
        # The sampler is kept until density control changes the Gaussians: until then, texture coordinates stay.
        maps = self.offset_net(self.frozen.canonical_map, posed.pose_map, posed.theta)
        if self._sampler is None:
            self._sampler = uv_sampler(self.gaussians.uvs, *maps.shape[1:])
        return maps, sparse_apply(self._sampler, maps.reshape(len(maps), -1).T.contiguous())

    def _directions(self, means: Tensor, posed: PosedMesh, camera: Camera) -> Tensor:
        """Unit view directions of Eq. 9, in the frame that ``view_frame`` names."""
        position = torch.tensor(camera.position, dtype=torch.float32, device=means.device)
        # No gradient: a Gaussian must not move in order to be seen from where its colour is better.
        means = means.detach()
        if self.view_frame in ("world", "none"):
            return torch.nn.functional.normalize(means - position, dim=1)
        quats = posed.frames.quats.detach(), self.frozen.frames.quats
        return directions_on_faces(means, position, self.gaussians.face_ids, *quats)

    def bound(self, posed: PosedMesh) -> tuple[Gaussians, Tensor | None]:
        """Compute the Gaussians of a pose, without the part of their colours that depends on the view.

        Args:
            posed: The head in the pose.

        Returns:
            The Gaussians, whose colours are OffsetNet's share, and ``O_map``, shape [13, H, W], or None without
            OffsetNet; its share is then zero.
        """
        g = self.gaussians
        offsets = self.offsets(posed)
        means, quats, scales, opacities, colors = bind_to_faces(
            posed.frames.all,
            g.face_ids,
            *(getattr(g, name) for name in PARAMETERS),
            offsets=offsets[1] if offsets else None,
            order=self._order(posed),
        )
        return Gaussians(means, quats, scales, opacities, colors), offsets[0] if offsets else None

    def view_colors(self, means: Tensor, posed: PosedMesh, camera: Camera) -> Tensor:
        """Compute the colours of Gaussians as a camera sees them, without OffsetNet's share (Eq. 9).

        Args:
            means: Centres in the world [m], shape [N, 3].
            posed: The head in the pose.
            camera: The camera, of which only the position matters.

        Returns:
            RGB, shape [N, 3].
        """
        g = self.gaussians
        directions = self._directions(means, posed, camera)
        if self.color_net is not None:
            return self.color_net(g.canonical_means(self.frozen.frames), directions)
        return sh_colors(g.sh_constant, g.sh_others, directions)

    def forward(self, posed: PosedMesh, camera: Camera) -> tuple[Gaussians, Tensor | None]:
        """Compute the Gaussians of one view.

        Args:
            posed: The head in the view's pose.
            camera: Camera of the view, on which colours depend.

        Returns:
            The Gaussians ``G_r`` of Section 3.2, and ``O_map``, shape [13, H, W], for its regulariser, or None without
            OffsetNet.
        """
        bound, maps = self.bound(posed)
        colors = self.view_colors(bound.means, posed, camera)
        if maps is not None:
            colors = colors + bound.colors
        return replace(bound, colors=colors), maps


def build_appearance(head: PersonalHead, config: ResolvedConfig, *, seed: int) -> Appearance:
    """Freeze the head and bind one Gaussian to each of its faces."""
    offset_net = config.appearance.offset_net
    frozen = FrozenHead(head, uv_resolution=offset_net.resolution if offset_net.enabled else None)
    return Appearance(frozen, config, seed=seed)
