"""Drivable Gaussian head avatars on a personal mesh (MGAvatar).

The names of ``__all__`` are the public interface; each is imported when it is first used. ``docs/python.md`` shows how
to fit, render and score with them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mgavatar.avatar import Avatar
    from mgavatar.camera import Camera
    from mgavatar.capture.read import read_capture
    from mgavatar.driving.read import read_driving
    from mgavatar.driving.render import render
    from mgavatar.errors import DataError
    from mgavatar.head.find import load_head_model
    from mgavatar.pipeline import fit
    from mgavatar.presets import preset
    from mgavatar.scoring.evaluate import evaluate

__version__ = "0.1.0"

__all__ = [
    "Avatar",
    "Camera",
    "DataError",
    "evaluate",
    "fit",
    "load_head_model",
    "preset",
    "read_capture",
    "read_driving",
    "render",
]

_HOMES = {
    "Avatar": "mgavatar.avatar",
    "Camera": "mgavatar.camera",
    "DataError": "mgavatar.errors",
    "evaluate": "mgavatar.scoring.evaluate",
    "fit": "mgavatar.pipeline",
    "load_head_model": "mgavatar.head.find",
    "preset": "mgavatar.presets",
    "read_capture": "mgavatar.capture.read",
    "read_driving": "mgavatar.driving.read",
    "render": "mgavatar.driving.render",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use: ``import mgavatar`` alone loads neither torch nor Warp."""
    if name not in _HOMES:
        raise AttributeError(f"module 'mgavatar' has no attribute '{name}'")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
