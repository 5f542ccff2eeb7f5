"""ARTalk: ``*_motions.pt``, a bare tensor of 100 expressions, the root's and the jaw's rotation for each frame."""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mgavatar.driving.motion import MAX_FRAMES, Driving, motion_of, rows_of
from mgavatar.errors import DataError
from mgavatar.files import GIBIBYTE, npz_names, one_line

UNDERSTOOD = "ARTalk's .pt"

N_EXPR = 100

WIDTH = N_EXPR + 6

FPS = 25.0


def recognises(path: Path) -> bool:
    """Return True for a zip archive of ``torch.save``."""
    return any(name.rpartition("/")[2] == "data.pkl" for name in npz_names(path))


def read(path: Path) -> Driving:
    """Read such a file; the errors are those of ``read_driving``."""
    value = _loaded(path)
    if isinstance(value, dict):
        names = ", ".join(one_line(name, limit=30) for name in list(value)[:8])
        raise DataError(
            f"{path}: holds a dictionary of {names or 'nothing'}; ARTalk's motion is one tensor (T, {WIDTH})"
        )
    rows = rows_of(_array(value, path=path), where=f"{path}: its tensor", width=WIDTH)
    parts = {"expr": rows[:, :N_EXPR], "rotation": rows[:, N_EXPR : N_EXPR + 3], "jaw_pose": rows[:, N_EXPR + 3 :]}
    return motion_of(parts, path=path, fps=FPS)


def _loaded(path: Path) -> Any:
    """Return the contents of a file of tensors; nothing in it is run, and nothing is inflated."""
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
            if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
                raise DataError(f"{path}: is compressed, which torch.save does not do")
            if sum(info.file_size for info in infos) > GIBIBYTE:
                raise DataError(f"{path}: its tensors need more than {GIBIBYTE >> 20} MiB; too large to be motion")
        with warnings.catch_warnings():  # torch remarks on pickles that it then refuses
            warnings.simplefilter("ignore", UserWarning)
            return torch.load(path, map_location="cpu", weights_only=True)
    except DataError:
        raise
    except Exception as error:  # whatever a damaged archive makes zipfile and torch raise
        raise DataError(f"{path}: not a readable file of tensors ({one_line(error, limit=80)})") from error


def _array(value: Any, *, path: Path) -> np.ndarray:
    """Return a plain tensor as an array.

    Sparse, quantised and nested tensors and those without data are refused before they are touched: a sparse one with
    wild indices loads without an error. A strided one may claim more elements than its storage has.
    """
    if not isinstance(value, torch.Tensor):
        raise DataError(f"{path}: holds a {one_line(type(value).__name__)}; ARTalk's motion is one tensor (T, {WIDTH})")
    plain = value.layout == torch.strided and value.device.type == "cpu"
    if not plain or value.is_quantized or value.is_nested or value.is_complex():
        raise DataError(f"{path}: its tensor is not one of plain numbers")
    if value.numel() > MAX_FRAMES * WIDTH:
        raise DataError(f"{path}: its tensor has shape {tuple(value.shape)}; too large to be motion")
    return value.detach().to(torch.float32).contiguous().numpy()
