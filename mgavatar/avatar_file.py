"""The avatar's file: everything that drawing a fitted person needs, as tensors and plain types."""

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
from mgavatar.appearance.model import Appearance, build_appearance
from mgavatar.camera import Camera
from mgavatar.capture.info import CaptureInfo
from mgavatar.config import ResolvedConfig, from_dict
from mgavatar.errors import DataError
from mgavatar.files import atomic_write, existing_file, one_line
from mgavatar.geometry.head import PersonalHead
from mgavatar.geometry.refine_net import N_POSE
from mgavatar.geometry.vertex_gaussians import VertexGaussians
from mgavatar.head.body import Body
from mgavatar.head.load import head_arrays, head_from_arrays
from mgavatar.head.params import HeadParams

FORMAT = "mgavatar/3"

_NOT_DRAWN = ("exp_avg", "exp_avg_sq", "step")
"""Parts of a state that only an optimizer needs."""


@dataclass(frozen=True, eq=False)
class AvatarParts:
    """The contents of an avatar file.

    Attributes:
        vertex_gaussians: The geometry stage's Gaussians on the personal head.
        appearance: The appearance, or None.
        capture: What the avatar was fitted to.
        config: How.
    """

    vertex_gaussians: VertexGaussians
    appearance: Appearance | None
    capture: CaptureInfo
    config: ResolvedConfig

    @property
    def n_gaussians(self) -> int:
        """Return the number of Gaussians."""
        return self.vertex_gaussians.head.body.n_verts if self.appearance is None else len(self.appearance.gaussians)


def write_avatar(path: Path, parts: AvatarParts) -> None:
    """Write ``avatar.pt``: tensors and plain types, read back with ``weights_only=True``. Atomic."""
    payload = {
        "format": FORMAT,
        "version": __version__,
        "config": dataclasses.asdict(parts.config),
        "head": {name: _plain(value) for name, value in head_arrays(parts.vertex_gaussians.head.body.model).items()},
        "capture": _capture_state(parts.capture),
        "geometry": {name: value.detach().cpu() for name, value in parts.vertex_gaussians.state_dict().items()},
        "appearance": None,
        "n_gaussians": parts.n_gaussians,
    }
    if parts.appearance is not None:
        state = parts.appearance.state_dict()
        payload["appearance"] = {
            name: value.detach().cpu()
            for name, value in state.items()
            if isinstance(value, Tensor) and not name.endswith(_NOT_DRAWN)
        }
    with atomic_write(path) as file:
        torch.save(payload, file)


def read_avatar(path: Path, *, device: torch.device | str = "cpu") -> AvatarParts:
    """Read and check an avatar file.

    Raises:
        DataError: If the file is missing, is not an avatar, or does not hold together.
    """
    existing_file(path)
    payload = _read(path)
    try:
        config = from_dict(payload["config"], ResolvedConfig)
        arrays = {
            name: value.numpy() if isinstance(value, Tensor) else np.array(value)
            for name, value in payload["head"].items()
        }
        subdivisions = config.geometry.subdivisions
        body = Body(head_from_arrays(arrays, path=path), subdivisions=subdivisions, device=device)
        capture = _capture_of(payload["capture"])
        head = PersonalHead(body, capture.tracked, config.geometry, train_rows=capture.train_timesteps)
        vertex_gaussians = VertexGaussians(head, config)
        _load_state(vertex_gaussians, payload["geometry"])
        appearance = None
        if payload["appearance"] is not None:
            appearance = _appearance(head, config, payload["appearance"], int(payload["n_gaussians"]))
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError, IndexError) as error:
        raise DataError(f"{path}: damaged avatar ({_brief(error)}); fit it again") from error
    for parameter in vertex_gaussians.parameters():
        parameter.requires_grad_(False)
    return AvatarParts(vertex_gaussians, appearance, capture, config)


def _read(path: Path) -> dict[str, Any]:
    try:
        with warnings.catch_warnings():  # torch remarks on pickles that it then refuses
            warnings.simplefilter("ignore", UserWarning)
            payload = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever another kind of file makes the unpickler raise
        raise DataError(f"{path}: not an MGAvatar avatar; give the avatar.pt that `mgavatar fit` wrote") from error
    if not isinstance(payload, dict) or not str(payload.get("format", "")).startswith("mgavatar/"):
        raise DataError(f"{path}: not an MGAvatar avatar; give the avatar.pt that `mgavatar fit` wrote")
    while payload["format"] != FORMAT:
        upgrade = _UPGRADES.get(payload["format"])
        if upgrade is None:
            known = ", ".join((*_UPGRADES, FORMAT))
            raise DataError(
                f"{path}: format {one_line(payload['format'], limit=40)}, this version reads {known}; "
                "fit the avatar again or use the mgavatar that wrote it"
            )
        try:
            payload = upgrade(payload)
        except (KeyError, TypeError, AttributeError) as error:
            raise DataError(f"{path}: damaged avatar ({_brief(error)}); fit it again") from error
    return payload


def _from_format_2(payload: dict[str, Any]) -> dict[str, Any]:
    """Upgrade a file of format 2: joints were called ``neck``, ``jaw``, ``eyes``, the last rate ``final_lr``."""
    for stage in ("geometry", "appearance"):
        table = payload["config"][stage]
        table["lr_final_factor"] = table.pop("final_lr")
    # Pose offsets were those of Eq. 2 itself, with all that poses have in common in them.
    payload["config"]["geometry"]["center_pose_offsets"] = False
    payload["geometry"]["head.refine.mean_pose"] = torch.zeros(N_POSE)
    for name in ("neck", "jaw", "eyes"):
        payload["geometry"][f"head.poses.{name}_pose"] = payload["geometry"].pop(f"head.poses.{name}")
    return payload | {"format": "mgavatar/3"}


_UPGRADES = {"mgavatar/2": _from_format_2}
"""From each past format to the next one."""


def _appearance(head: PersonalHead, config: ResolvedConfig, state: dict[str, Tensor], n: int) -> Appearance:
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


def _brief(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
