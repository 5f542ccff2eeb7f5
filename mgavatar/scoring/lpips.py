"""LPIPS with VGG16 (Zhang et al. 2018), from a weights file that the user names: nothing is ever downloaded."""

from __future__ import annotations

import pickle
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from mgavatar.errors import DataError
from mgavatar.files import existing_file, one_line

NO_WEIGHTS = "no weights given (--lpips-weights)"

_LAYERS = (
    (("net.slice1.0", 3, 64), ("net.slice1.2", 64, 64)),
    (("net.slice2.5", 64, 128), ("net.slice2.7", 128, 128)),
    (("net.slice3.10", 128, 256), ("net.slice3.12", 256, 256), ("net.slice3.14", 256, 256)),
    (("net.slice4.17", 256, 512), ("net.slice4.19", 512, 512), ("net.slice4.21", 512, 512)),
    (("net.slice5.24", 512, 512), ("net.slice5.26", 512, 512), ("net.slice5.28", 512, 512)),
)
"""VGG16's convolutions in five blocks with their channels, named as the ``lpips`` package names them."""


def weight_shapes() -> dict[str, tuple[int, ...]]:
    """Return the names and shapes in a file of weights, the state dict of ``lpips.LPIPS(net="vgg")``."""
    shapes: dict[str, tuple[int, ...]] = {f"scaling_layer.{name}": (1, 3, 1, 1) for name in ("shift", "scale")}
    for index, block in enumerate(_LAYERS):
        for name, n_in, n_out in block:
            shapes |= {f"{name}.weight": (n_out, n_in, 3, 3), f"{name}.bias": (n_out,)}
        shapes[f"lin{index}.model.1.weight"] = (1, block[-1][2], 1, 1)
    return shapes


class Lpips:
    """The distance of two images in VGG16's features."""

    def __init__(self, weights: dict[str, Tensor]) -> None:
        """Take checked weights; see :func:`load_lpips`."""
        self._weights = weights

    @torch.no_grad()
    def __call__(self, image: Tensor, target: Tensor) -> Tensor:
        """Distance of two images [3, H, W] in 0..1, a scalar; each side has at least 16 pixels.

        Raises:
            ValueError: If the shapes differ or an image is smaller.
        """
        if image.shape != target.shape or image.ndim != 3 or len(image) != 3 or min(image.shape[1:]) < 16:
            raise ValueError(f"images must be [3, H, W] of 16 pixels or more, got {image.shape} and {target.shape}")
        w = self._weights
        x = (2.0 * torch.stack([image, target]) - 1.0 - w["scaling_layer.shift"]) / w["scaling_layer.scale"]
        total = torch.zeros((), device=image.device)
        for index, block in enumerate(_LAYERS):
            x = functional.max_pool2d(x, 2) if index else x
            for name, _, _ in block:
                x = functional.conv2d(x, w[f"{name}.weight"], w[f"{name}.bias"], padding=1).relu_()
            unit = x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)
            difference = (unit[0] - unit[1]).square()
            total = total + (difference.mean(dim=(1, 2)) * w[f"lin{index}.model.1.weight"].reshape(-1)).sum()
        return total


def load_lpips(path: Path, *, device: torch.device | str = "cpu") -> Lpips:
    """Read the weights of LPIPS-VGG.

    Args:
        path: What ``torch.save(lpips.LPIPS(net="vgg").state_dict(), path)`` writes.
        device: Where to compute.

    Returns:
        The distance.

    Raises:
        DataError: If the file is missing or holds something else.
    """
    existing_file(path)
    remedy = 'it must be the state dict of lpips.LPIPS(net="vgg")'
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, IndexError, EOFError, ValueError, KeyError, OSError) as error:
        raise DataError(f"{path}: not a file of weights; {remedy}") from error
    if not isinstance(state, dict):
        raise DataError(f"{path}: holds no state dict; {remedy}")
    weights = {}
    for name, shape in weight_shapes().items():
        value = state.get(name)
        if not isinstance(value, Tensor) or not value.is_floating_point() or tuple(value.shape) != shape:
            found = f"of shape {tuple(value.shape)}" if isinstance(value, Tensor) else "missing"
            raise DataError(f"{path}: {one_line(name)} is {found}, {shape} is needed; {remedy}")
        if not bool(torch.isfinite(value).all()):
            raise DataError(f"{path}: {name} is not finite; save the weights again")
        weights[name] = value.to(device, torch.float32)
    return Lpips(weights)
