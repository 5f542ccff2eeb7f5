"""The appearance stage: face-bound Gaussians, ColorNet and OffsetNet on the frozen mesh (Section 3.2, Eq. 8 to 11)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mgavatar.appearance.density import DensityControl
from mgavatar.appearance.model import Appearance
from mgavatar.camera import Camera
from mgavatar.config import AppearanceConfig, FitConfig
from mgavatar.gaussians import draw
from mgavatar.losses import image_loss


def binding_loss(local_means: Tensor, local_scales: Tensor, visible: Tensor, config: AppearanceConfig) -> Tensor:
    """The two hinges of Eq. 11: Gaussians stay near their face and of its size, with free room below epsilon.

    Both are norms over a Gaussian's three axes in units of k, averaged over the Gaussians that the view touches.
    """
    seen = visible.float()
    n = seen.sum().clamp(min=1.0)
    away = torch.relu(local_means.norm(dim=1) - config.epsilon_position)
    large = torch.relu(local_scales - config.epsilon_scale).square().sum(1)
    # sqrt has no slope at 0, where most Gaussians are; the small constant gives it one without moving the minimum.
    too_large = torch.sqrt(large + 1e-12) - 1e-6
    return (config.lambda_position * (away * seen).sum() + config.lambda_scale * (too_large * seen).sum()) / n


class AppearanceStage:
    """One optimizer step at a time."""

    name = "appearance"

    def __init__(self, appearance: Appearance, config: FitConfig, *, seed: int) -> None:
        self.appearance = appearance
        self.config = config
        a = config.appearance
        self.iterations = a.iterations
        self.iteration = 0
        g = appearance.gaussians
        groups: list[dict[str, Any]] = [
            {"params": [g.local_means], "lr": a.lr_means},
            {"params": [g.log_scales], "lr": a.lr_scales},
            {"params": [g.quats], "lr": a.lr_quats},
            {"params": [g.opacity_logits], "lr": a.lr_opacities},
            {"params": list(appearance.color_net.mlp.parameters()), "lr": a.color_net.lr},
        ]
        if appearance.offset_net is not None:
            groups.append({"params": list(appearance.offset_net.parameters()), "lr": a.offset_net.lr})
        self.optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)
        self.decay = a.final_lr ** (1.0 / max(1, a.iterations))
        self.density = DensityControl(g, a.density, extent=appearance.frozen.extent, seed=seed)

    def step(self, camera: Camera, timestep: int, target: Tensor, background: Tensor) -> dict[str, float]:
        """Eq. 11 for one image: target [3, H, W] in 0..1. Returns the terms of the loss."""
        a, appearance = self.config.appearance, self.appearance
        gaussians, maps = appearance(appearance.frozen.at_timestep(timestep), camera)
        screen_grads = torch.zeros(len(gaussians.means), 2, device=target.device)
        rendering = draw(gaussians, camera, background=background, config=self.config.raster, screen_grads=screen_grads)
        image_term = image_loss(rendering.image, target, self.config.loss)
        g = appearance.gaussians
        binding_term = binding_loss(g.local_means, g.log_scales.exp(), rendering.visible, a)
        offset_term = a.offset_net.regularize * maps.square().mean() if maps is not None else 0.0 * image_term
        loss = image_term + binding_term + offset_term
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        appearance.color_net.grid.adam_step(a.color_net.lr * self.decay**self.iteration)
        for group in self.optimizer.param_groups:
            group["lr"] *= self.decay
        self.iteration += 1
        self._control_density(screen_grads, rendering)
        terms = torch.stack([loss, image_term, binding_term, offset_term]).detach().tolist()
        return dict(zip(("loss", "image", "binding", "offset"), terms, strict=True)) | {"gaussians": len(g)}

    def _control_density(self, screen_grads: Tensor, rendering: Any) -> None:
        if self.iteration > self.config.appearance.density.stop:
            return
        self.density.collect(screen_grads, rendering)
        if self.density.due(self.iteration):
            self.density.refine(self.optimizer, self.appearance.frozen.frames.scales)
            self.appearance.rebind()

    def state_dict(self) -> dict[str, Any]:
        """Everything a later process needs to go on."""
        return {
            "n": len(self.appearance.gaussians),
            "appearance": self.appearance.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "density": self.density.state_dict(),
            "iteration": self.iteration,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if state["n"] != len(self.appearance.gaussians):
            self._resize(state["n"])
        self.appearance.load_state_dict(state["appearance"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.density.load_state_dict(state["density"])
        self.iteration = state["iteration"]

    def _resize(self, n: int) -> None:
        g = self.appearance.gaussians
        self.appearance.resize(n)
        names = ("local_means", "log_scales", "quats", "opacity_logits")
        for name, group in zip(names, self.optimizer.param_groups, strict=False):
            group["params"] = [getattr(g, name)]
