"""The interface between the two stages of a fit and its loop."""

from __future__ import annotations

from typing import Any, Protocol

from torch import Tensor

from mgavatar.camera import Camera


class Stage(Protocol):
    """A stage of a fit.

    Attributes:
        name: ``"geometry"`` or ``"appearance"``.
        iterations: Iterations of its schedule, as configured.
        position: Place in its schedule, in configured iterations.
    """

    name: str
    iterations: int
    position: float

    def step(
        self, camera: Camera, timestep: int, target: Tensor, background: Tensor, schedule_step: float = 1.0
    ) -> dict[str, float]:
        """Take one optimizer step on one image.

        Args:
            camera: Camera of the image.
            timestep: Row of the capture's parameters.
            target: The image in 0..1, shape [3, H, W].
            background: Colour behind the subject, shape [3].
            schedule_step: Step through the schedule, in configured iterations; a budget makes it other than 1.

        Returns:
            Weighted terms of the loss by their names, and the number of ``gaussians``.
        """

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a later process needs to go on."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from the state of a stage with the same configuration."""
