"""The avatar: everything that drawing a fitted person needs, in memory and as one file."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mgavatar import __version__
from mgavatar.appearance.model import Appearance, FrozenHead
from mgavatar.camera import Camera
from mgavatar.capture.subject import HeadParams, Subject
from mgavatar.config import FitConfig, check, from_dict, settled
from mgavatar.errors import DataError
from mgavatar.files import atomic_write, existing_file
from mgavatar.gaussians import Gaussians, draw
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.stage import VertexGaussians
from mgavatar.head.body import Body, Pose
from mgavatar.head.load import head_arrays, head_from_arrays
from mgavatar.head.model import HeadModel
from mgavatar.kernels.rasterize import Rendering

FORMAT = "mgavatar/2"

_NOT_DRAWN = ("exp_avg", "exp_avg_sq", "step")
"""Parts of a state that only an optimizer needs."""


@dataclass(frozen=True, eq=False)
class CaptureInfo:
    """What an avatar remembers of the capture that it was fitted to.

    Attributes:
        tracked: Parameters as the capture states them, all timesteps.
        timestep_ids: The capture's own numbers of the timesteps.
        train_timesteps: Rows that the fit has seen.
        cameras: Training cameras by their index.
        background: RGB, shape [3].
    """

    tracked: HeadParams
    timestep_ids: tuple[int, ...]
    train_timesteps: tuple[int, ...]
    cameras: dict[int, Camera]
    background: np.ndarray

    @staticmethod
    def of(subject: Subject) -> CaptureInfo:
        train = subject.frames["train"]
        cameras: dict[int, Camera] = {}
        for frame in train:
            cameras.setdefault(frame.camera_id, frame.camera)
        seen = tuple(sorted({frame.timestep for frame in train}))
        return CaptureInfo(subject.params, subject.timestep_ids, seen, cameras, subject.background)

    def mean_camera(self) -> Camera:
        """The training camera that is nearest to the middle of them all."""
        cameras = list(self.cameras.values())
        positions = np.stack([camera.position for camera in cameras])
        return cameras[int(np.argmin(((positions - positions.mean(0)) ** 2).sum(1)))]


class Avatar:
    """A fitted head with its appearance; before the appearance stage, its vertex-bound Gaussians.

    Attributes:
        head: The personal head; its ``poses`` are the capture's, as refined.
        vertex_gaussians: The geometry stage's Gaussians.
        appearance: The appearance, or None.
        capture: What the avatar was fitted to.
        config: How.
    """

    def __init__(
        self, vertex_gaussians: VertexGaussians, appearance: Appearance | None, capture: CaptureInfo, config: FitConfig
    ) -> None:
        self.vertex_gaussians = vertex_gaussians
        self.head: PersonalHead = vertex_gaussians.head
        self.appearance = appearance
        self.capture = capture
        self.config = config

    @property
    def head_model(self) -> HeadModel:
        return self.head.body.model

    @property
    def device(self) -> torch.device:
        return self.head.body.device

    @property
    def n_gaussians(self) -> int:
        return self.head.body.n_verts if self.appearance is None else len(self.appearance.gaussians)

    @torch.no_grad()
    def verts(self, pose: Pose) -> Tensor:
        """The personal mesh in a pose [m], shape [V, 3]."""
        return self.head.posed(pose.to(self.device)).verts

    @torch.no_grad()
    def gaussians(self, pose: Pose, camera: Camera) -> Gaussians:
        """World-space Gaussians in a pose as a camera sees them."""
        pose = pose.to(self.device)
        if self.appearance is None:
            return self.vertex_gaussians.bound(self.head.posed(pose), camera)
        return self.appearance(self.appearance.frozen.posed(pose), camera)[0]

    @torch.no_grad()
    def render(self, pose: Pose, camera: Camera, background: Tensor | None = None) -> Rendering:
        """Draw the avatar in a pose; the capture's background by default."""
        if background is None:
            background = torch.tensor(self.capture.background)
        return draw(
            self.gaussians(pose, camera), camera, background=background.to(self.device), config=self.config.raster
        )

    def save(self, path: Path) -> None:
        """Write ``avatar.pt``: tensors and plain types, read back with ``weights_only=True``. Atomic."""
        payload = {
            "format": FORMAT,
            "version": __version__,
            "config": dataclasses.asdict(self.config),
            "head": {name: _plain(value) for name, value in head_arrays(self.head_model).items()},
            "capture": _capture_state(self.capture),
            "geometry": {name: value.detach().cpu() for name, value in self.vertex_gaussians.state_dict().items()},
            "appearance": None,
            "n_gaussians": self.n_gaussians,
        }
        if self.appearance is not None:
            state = self.appearance.state_dict()
            payload["appearance"] = {
                name: value.detach().cpu()
                for name, value in state.items()
                if isinstance(value, Tensor) and not name.endswith(_NOT_DRAWN)
            }
        with atomic_write(path) as file:
            torch.save(payload, file)

    @staticmethod
    def load(path: Path, *, device: torch.device | str = "cpu") -> Avatar:
        """Read and check an avatar file.

        Raises:
            DataError: If the file is missing, is not an avatar, or does not hold together.
        """
        existing_file(path)
        payload = _read(path)
        try:
            config = _config(payload["config"])
            arrays = {
                name: value.numpy() if isinstance(value, Tensor) else np.array(value)
                for name, value in payload["head"].items()
            }
            body = Body(head_from_arrays(arrays, path=path), subdivisions=config.geometry.subdivisions, device=device)
            capture = _capture_of(payload["capture"])
            head = PersonalHead(body, capture.tracked, config.geometry)
            vertex_gaussians = VertexGaussians(head, config)
            _load_state(vertex_gaussians, payload["geometry"])
            appearance = None
            if payload["appearance"] is not None:
                appearance = _appearance(head, config, payload["appearance"], int(payload["n_gaussians"]))
        except (KeyError, TypeError, ValueError, AttributeError, RuntimeError, IndexError) as error:
            raise DataError(f"{path}: damaged avatar ({_brief(error)}); fit it again") from error
        for parameter in vertex_gaussians.parameters():
            parameter.requires_grad_(False)
        return Avatar(vertex_gaussians, appearance, capture, config)


def build_appearance(head: PersonalHead, config: FitConfig, *, seed: int) -> Appearance:
    """Freeze the head and bind one Gaussian to each of its faces."""
    offset_net = config.appearance.offset_net
    frozen = FrozenHead(head, uv_resolution=settled(offset_net.resolution) if offset_net.enabled else None)
    return Appearance(frozen, config, seed=seed)


def _read(path: Path) -> dict[str, Any]:
    try:
        with warnings.catch_warnings():  # torch remarks on pickles that it then refuses
            warnings.simplefilter("ignore", UserWarning)
            payload = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever another kind of file makes the unpickler raise
        raise DataError(f"{path}: not an MGAvatar avatar; give the avatar.pt that `mgavatar fit` wrote") from error
    if not isinstance(payload, dict) or not str(payload.get("format", "")).startswith("mgavatar/"):
        raise DataError(f"{path}: not an MGAvatar avatar; give the avatar.pt that `mgavatar fit` wrote")
    if payload["format"] != FORMAT:
        raise DataError(f"{path}: format {payload['format']}, this version reads {FORMAT}; use a matching mgavatar")
    return payload


def _appearance(head: PersonalHead, config: FitConfig, state: dict[str, Tensor], n: int) -> Appearance:
    appearance = build_appearance(head, config, seed=0)
    face_ids = state["gaussians.face_ids"]
    n_faces = len(head.body.faces)
    if len(face_ids) != n or (n and not 0 <= int(face_ids.min()) <= int(face_ids.max()) < n_faces):
        raise ValueError(f"face_ids do not fit {n} Gaussians on {n_faces} faces")
    appearance.resize(n)
    _load_state(appearance, state)
    for parameter in appearance.parameters():
        parameter.requires_grad_(False)
    return appearance


def _load_state(module: torch.nn.Module, state: dict[str, Tensor]) -> None:
    """Load tensors after checking names, shapes, types and finiteness; optimizer-only entries may be absent."""
    own = {name: value for name, value in module.state_dict().items() if isinstance(value, Tensor)}
    for name, value in own.items():
        if name not in state:
            if name.endswith(_NOT_DRAWN):
                continue
            raise ValueError(f"{name} is missing")
        given = state[name]
        if not isinstance(given, Tensor) or given.shape != value.shape or given.dtype != value.dtype:
            raise ValueError(f"{name} has another shape or type than its configuration says")
        if given.is_floating_point() and not bool(torch.isfinite(given).all()):
            raise ValueError(f"{name} is not finite")
        value.copy_(given)


def _plain(value: np.ndarray) -> Any:
    return value.tolist() if value.dtype.kind in "US" else torch.from_numpy(np.array(value))


def _capture_state(capture: CaptureInfo) -> dict[str, Any]:
    cameras = list(capture.cameras.values())
    tracked = {field.name: getattr(capture.tracked, field.name) for field in dataclasses.fields(HeadParams)}
    return {
        "tracked": {
            name: None if value is None else torch.from_numpy(np.array(value)) for name, value in tracked.items()
        },
        "timestep_ids": list(capture.timestep_ids),
        "train_timesteps": list(capture.train_timesteps),
        "camera_ids": list(capture.cameras),
        "viewmats": torch.from_numpy(np.stack([camera.viewmat for camera in cameras])),
        "Ks": torch.from_numpy(np.stack([camera.K for camera in cameras])),
        "sizes": [[camera.width, camera.height] for camera in cameras],
        "background": [float(value) for value in capture.background],
    }


def _capture_of(state: dict[str, Any]) -> CaptureInfo:
    tracked: dict[str, Any] = {
        name: None if value is None else value.numpy() for name, value in state["tracked"].items()
    }
    viewmats, Ks = state["viewmats"].numpy(), state["Ks"].numpy()
    arrays = {"viewmats": viewmats, "Ks": Ks, **{name: value for name, value in tracked.items() if value is not None}}
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} of the capture is not finite")
    if viewmats.shape[1:] != (4, 4) or Ks.shape[1:] != (3, 3) or min(map(min, state["sizes"])) < 1:
        raise ValueError("a camera has another shape than a camera has")
    cameras = {
        int(index): Camera(viewmat, K, int(width), int(height))
        for index, viewmat, K, (width, height) in zip(state["camera_ids"], viewmats, Ks, state["sizes"], strict=True)
    }
    background = np.array(state["background"], np.float32)
    ids, train = tuple(state["timestep_ids"]), tuple(state["train_timesteps"])
    if background.shape != (3,) or not np.isfinite(background).all():
        raise ValueError("the background is not a colour")
    if len(ids) != len(tracked["expr"]) or not all(0 <= timestep < len(ids) for timestep in train):
        raise ValueError("timesteps do not fit the tracked parameters")
    return CaptureInfo(HeadParams(**tracked), ids, train, cameras, background)


def _config(table: dict[str, Any]) -> FitConfig:
    config = from_dict(table)
    try:
        check(config)
    except DataError as error:
        raise ValueError(str(error)) from error
    return config


def _brief(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
