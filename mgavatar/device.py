"""The device of a computation, by name."""

from __future__ import annotations

import torch

from mgavatar.errors import DataError


def find_device(name: str | torch.device) -> torch.device:
    """Return a device that this machine has.

    Args:
        name: ``"auto"`` for CUDA where there is a device and else the CPU; otherwise a name of torch's, ``"cpu"``,
            ``"cuda"`` or ``"cuda:1"``.

    Raises:
        DataError: If the name is unknown or the machine has no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise DataError(f"--device {name}: unknown; give auto, cpu, cuda or cuda:N") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise DataError(f"--device {name}: this machine has no CUDA device that torch can use; give --device cpu")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise DataError(f"--device {name}: this machine has {torch.cuda.device_count()} CUDA devices, counted from 0")
    return device
