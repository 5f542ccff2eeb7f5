"""JSON of LAM and LAM_Audio2Expression: names, and per frame the weights of ARKit's blendshapes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mgavatar.driving.arkit import FEWEST_NAMES, Weights, arkit_motion, n_arkit_names
from mgavatar.driving.motion import Driving, frame_rate
from mgavatar.driving.tables import json_content, json_numbers, json_times
from mgavatar.errors import DataError

UNDERSTOOD = "LAM's JSON"


def recognises(path: Path) -> bool:
    """Return True for an object with ARKit's names and frames of ``weights``."""
    content = json_content(path)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        return False
    return n_arkit_names(_names(content)) >= FEWEST_NAMES


def read(path: Path) -> Driving:
    """Read such a file; the errors are those of ``read_driving``."""
    content = json_content(path)
    names = _names(content)
    rows = []
    for index, frame in enumerate(content["frames"]):
        weights = frame.get("weights") if isinstance(frame, dict) else None
        if not isinstance(weights, list) or len(weights) != len(names):
            raise DataError(f"{path}: frame {index}: weights must be a list of {len(names)} numbers, one per name")
        rows.append(json_numbers(weights, where=f"{path}: frame {index}: weights"))
    metadata = content.get("metadata")
    rate = metadata.get("fps") if isinstance(metadata, dict) else None
    turned = any(frame.get("rotation") for frame in content["frames"])
    weights = Weights(
        names,
        np.array(rows, np.float64).reshape(len(rows), len(names)),
        times=json_times([frame.get("time") for frame in content["frames"]], where=f"{path}: time"),
        fps=None if rate is None else frame_rate(json_numbers([rate], where=f"{path}: fps"), path=path),
        notes=(f"{path}: not used: rotation",) if turned else (),
    )
    return arkit_motion(weights, path=path)


def _names(content: dict[str, Any]) -> list[str]:
    metadata = content.get("metadata")
    given = content.get("names") or (metadata.get("blendshape_names") if isinstance(metadata, dict) else None)
    return given if isinstance(given, list) and all(isinstance(name, str) for name in given) else []
