"""The interface of a stage, as the loop and the checkpoint see it."""

from __future__ import annotations

from typing import Any, Protocol

from torch import Tensor

from mgavatar.camera import Camera


class Stage(Protocol):
    """What the loop needs of a stage: its schedule has ``iterations``, and it is at ``position`` of them."""

    name: str
    iterations: int
    position: float

    def step(
        self, camera: Camera, timestep: int, target: Tensor, background: Tensor, schedule_step: float = 1.0
    ) -> dict[str, float]: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...
