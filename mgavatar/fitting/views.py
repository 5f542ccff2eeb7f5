"""Training images in memory, and the order in which a fit sees them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import compress

import numpy as np
import torch
from torch import Tensor

from mgavatar.camera import Camera
from mgavatar.capture.images import read_images, read_masks
from mgavatar.capture.subject import Subject


@dataclass(frozen=True, eq=False)
class Views:
    """Training images in memory, as bytes.

    Attributes:
        images: Shape [N, 3, H, W], uint8, on the CPU.
        masks: Coverage, shape [N, H, W], uint8, or None if no view has a mask; all 255 for a view without one.
        cameras: N cameras at the size of ``images``.
        timesteps: N rows of the capture's parameters.
        has_mask: True for each of the N views that can be put on another background.
    """

    images: Tensor
    masks: Tensor | None
    cameras: list[Camera]
    timesteps: list[int]
    has_mask: list[bool]

    @staticmethod
    def of(subject: Subject, max_size: int, *, with_masks: bool) -> Views:
        """Decode the training split, reduced until its longer side has at most ``max_size`` pixels."""
        frames = subject.frames["train"]
        first = frames[0].camera
        scale = min(1.0, max_size / max(first.width, first.height))
        size = (max(1, round(first.width * scale)), max(1, round(first.height * scale)))
        cameras = [frame.camera.scaled(*size) for frame in frames]
        has_mask = [with_masks and frame.mask_path is not None for frame in frames]
        masks = None
        if any(has_mask):
            masks = read_masks(list(compress(frames, has_mask)), size=size)
        if masks is not None and not all(has_mask):
            some, masks = masks, torch.full((len(frames), *masks.shape[1:]), 255, dtype=torch.uint8)
            masks[torch.tensor(has_mask)] = some
        timesteps = [frame.timestep for frame in frames]
        return Views(read_images(frames, size=size), masks, cameras, timesteps, has_mask)

    def target(self, view: int, background: Tensor, new_background: Tensor) -> Tensor:
        """Return a training image with another background.

        Args:
            view: Number of the view.
            background: Colour behind the subject in the images, shape [3].
            new_background: Colour in its place, shape [3]; images without masks keep theirs.

        Returns:
            The image in 0..1, shape [3, H, W], on the device of ``background``.
        """
        image = self.images[view].to(background.device).float() / 255.0
        if self.masks is None:
            return image
        clear = 1.0 - self.masks[view].to(background.device).float() / 255.0
        return image + clear * (new_background - background)[:, None, None]


class ViewOrder:
    """Endless shuffled passes over the views."""

    def __init__(self, n_views: int, seed: int) -> None:
        self.n_views = n_views
        self.rng = np.random.default_rng(seed)
        self.left: list[int] = []

    def __iter__(self) -> Iterator[int]:
        while True:
            if not self.left:
                self.left = self.rng.permutation(self.n_views).tolist()
            yield self.left.pop()
