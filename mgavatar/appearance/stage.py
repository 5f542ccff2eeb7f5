"""The appearance stage: face-bound Gaussians, ColorNet and OffsetNet on the frozen mesh (Section 3.2, Eq. 8 to 11)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mgavatar.appearance.density import DensityControl
from mgavatar.appearance.face_gaussians import SH_PARAMETERS
from mgavatar.appearance.model import Appearance, PosedMesh
from mgavatar.appearance.offset_net import deterministic_convolutions
from mgavatar.camera import Camera
from mgavatar.config import ResolvedAppearanceConfig, ResolvedConfig
from mgavatar.gaussians import draw
from mgavatar.losses import image_loss


def binding_loss(
    local_means: Tensor, local_scales: Tensor, visible: Tensor, config: ResolvedAppearanceConfig
) -> Tensor:
    """Compute both hinges of Eq. 11, which keep Gaussians near their face and about as large as it.

    Both are norms over the three axes of a Gaussian, averaged over the visible Gaussians; up to epsilon they are zero.

    Args:
        local_means: Centres in units of their face's scale k, shape [N, 3].
        local_scales: Scales in the same units, shape [N, 3].
        visible: True for the Gaussians in the view, shape [N].
        config: Weights and epsilons.
    """
    seen = visible.float()
    n = seen.sum().clamp(min=1.0)
    away = torch.relu(local_means.norm(dim=1) - config.epsilon_position)
    large = torch.relu(local_scales - config.epsilon_scale).square().sum(1)
    # The derivative of sqrt is infinite at 0, where most Gaussians are. A small constant bounds it; the minimum stays.
    too_large = torch.sqrt(large + 1e-12) - 1e-6
    return (config.lambda_position * (away * seen).sum() + config.lambda_scale * (too_large * seen).sum()) / n


class AppearanceStage:
    """The stage that fits colours, Gaussians and OffsetNet, one optimizer step at a time.

    Attributes:
        appearance: The appearance on the frozen head.
        iterations: Configured iterations of the schedule.
        position: Place in the schedule of rates and density control, in configured iterations.
        decay: Factor of all rates per configured iteration.
        density: Density control.
    """

    name = "appearance"

    def __init__(self, appearance: Appearance, config: ResolvedConfig, *, seed: int) -> None:
        self.appearance = appearance
        self.config = config
        a = config.appearance
        self.iterations = a.iterations
        self.position = 0.0
        g = appearance.gaussians
        groups: list[dict[str, Any]] = [
            {"params": [g.local_means], "lr": a.lr_means},
            {"params": [g.log_scales], "lr": a.lr_scales},
            {"params": [g.quats], "lr": a.lr_quats},
            {"params": [g.opacity_logits], "lr": a.lr_opacities},
        ]
        if appearance.color_net is not None:
            groups.append({"params": list(appearance.color_net.mlp.parameters()), "lr": a.color_net.lr})
        else:
            groups.append({"params": [g.sh_constant], "lr": a.sh.lr})
            groups.append({"params": [g.sh_others], "lr": a.sh.lr / 20.0})  # the field's rates
        if appearance.offset_net is not None:
            groups.append({"params": list(appearance.offset_net.parameters()), "lr": a.offset_net.lr})
        self.poses = appearance.frozen.head.poses
        tuning = a.head_tuning
        if tuning.enabled:
            appearance.frozen.head.learn_poses()
            groups += [
                {"params": [self.poses["expr"]], "lr": tuning.lr_expr},
                {
                    "params": [self.poses[name] for name in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")],
                    "lr": tuning.lr_pose,
                },
                {"params": [self.poses["translation"]], "lr": tuning.lr_translation},
            ]
        # Adam's usual epsilon of 1e-8 would stop Gaussians that cover few pixels, whose gradients are as small.
        self.optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)
        self.decay = a.lr_final_factor ** (1.0 / max(1, a.iterations))
        self.density = DensityControl(g, a.density, extent=appearance.frozen.extent, seed=seed)

    def step(
        self, camera: Camera, timestep: int, target: Tensor, background: Tensor, schedule_step: float = 1.0
    ) -> dict[str, float]:
        """Take one optimizer step on Eq. 11, as in :meth:`mgavatar.fitting.stage.Stage.step`."""
        a, appearance = self.config.appearance, self.appearance
        with deterministic_convolutions():
            gaussians, maps = appearance(self._posed(timestep), camera)
            screen_grads = torch.zeros(len(gaussians.means), 2, device=target.device)
            rendering = draw(
                gaussians, camera, background=background, config=self.config.raster, screen_grads=screen_grads
            )
            image_term = image_loss(rendering.image, target, self.config.loss)
            g = appearance.gaussians
            binding_term = binding_loss(g.local_means, g.log_scales.exp(), rendering.visible, a)
            offset_term = a.offset_net.regularize * maps.square().mean() if maps is not None else 0.0 * image_term
            loss = image_term + binding_term + offset_term
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
        self.optimizer.step()
        if appearance.color_net is not None:
            # The grid's own optimizer has no group here, so its rate follows from the place in the schedule.
            appearance.color_net.grid.adam_step(a.color_net.lr * self.decay**self.position)
        for group in self.optimizer.param_groups:
            group["lr"] *= self.decay**schedule_step
        before = self.position
        self.position += schedule_step
        self._control_density(screen_grads, rendering, before)
        # One transfer from the device for all terms: each would wait for it on its own.
        terms = torch.stack([loss, image_term, binding_term, offset_term]).detach().tolist()
        return dict(zip(("loss", "image", "binding", "offset"), terms, strict=True)) | {"gaussians": len(g)}

    def _posed(self, timestep: int) -> PosedMesh:
        frozen = self.appearance.frozen
        if self.config.appearance.head_tuning.enabled:  # poses still change, so that none can be kept
            return frozen.posed(frozen.head.pose(timestep))
        return frozen.at_timestep(timestep)

    def _control_density(self, screen_grads: Tensor, rendering: Any, before: float) -> None:
        if before >= self.config.appearance.density.stop:
            return
        self.density.collect(screen_grads, rendering)
        if self.density.due(before, self.position):
            self.density.refine(self.optimizer, self.appearance.frozen.frames.scales)
            self.appearance.rebind()

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a later process needs to go on."""
        return {
            "n": len(self.appearance.gaussians),
            "appearance": self.appearance.state_dict(),
            "poses": self.poses.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "density": self.density.state_dict(),
            "position": self.position,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from the state of a stage with the same configuration, of any number of Gaussians."""
        if state["n"] != len(self.appearance.gaussians):
            self._resize(state["n"])
        self.appearance.load_state_dict(state["appearance"])
        self.poses.load_state_dict(state["poses"])
        self.appearance.frozen.forget_poses()
        self.optimizer.load_state_dict(state["optimizer"])
        self.density.load_state_dict(state["density"])
        self.position = state["position"]

    def _resize(self, n: int) -> None:
        g = self.appearance.gaussians
        self.appearance.resize(n)
        # The optimizer's first groups hold one parameter of the Gaussians each, in this order; those of the networks
        # follow and keep their parameters.
        names = ["local_means", "log_scales", "quats", "opacity_logits"]
        names += [name for name in SH_PARAMETERS if name in g.parameter_names]
        for name, group in zip(names, self.optimizer.param_groups, strict=False):
            group["params"] = [getattr(g, name)]
