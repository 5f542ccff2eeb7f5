"""Adaptive density control of face-bound Gaussians (Section 3.2): clone, split, prune."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mgavatar.appearance.face_gaussians import FaceGaussians
from mgavatar.config import DensityConfig
from mgavatar.kernels.rasterize import Rendering


class DensityControl:
    """Collects image-space gradients and now and then refines where they are large.

    The yardstick is the mesh's diagonal, never the cameras: a monocular capture has all its cameras in one place.
    """

    def __init__(self, gaussians: FaceGaussians, config: DensityConfig, *, extent: float, seed: int) -> None:
        self.gaussians = gaussians
        self.config = config
        self.extent = extent
        self.generator = torch.Generator().manual_seed(seed)
        self.reset()

    def reset(self) -> None:
        """Forget what was collected."""
        device = self.gaussians.face_ids.device
        self.total = torch.zeros(len(self.gaussians), device=device)
        self.seen = torch.zeros(len(self.gaussians), device=device)

    def collect(self, screen_grads: Tensor, rendering: Rendering) -> None:
        """Add one view's gradients of the image-space means, in half image sizes as the field counts them."""
        height, width = rendering.alphas.shape
        half = torch.tensor([0.5 * width, 0.5 * height], device=screen_grads.device)
        self.total += torch.where(rendering.visible, (screen_grads * half).norm(dim=1), 0.0)
        self.seen += rendering.visible

    def due(self, before: float, now: float) -> bool:
        """Whether a round falls into the piece of the schedule after ``before`` up to ``now``, in iterations."""
        c = self.config
        last = now // c.every * c.every
        return last > before and c.start <= last <= c.stop

    def refine(self, optimizer: torch.optim.Adam, face_scales: Tensor) -> None:
        """Clone small Gaussians and split large ones where the gradient asks for it, then remove faint ones.

        Args:
            optimizer: Its groups hold the Gaussians' parameters, whose rows move along.
            face_scales: k of every canonical face [m], shape [F].
        """
        g, c = self.gaussians, self.config
        mean = self.total / self.seen.clamp(min=1.0)
        room = max(0, c.max_gaussians - len(g))
        wanted = mean >= c.gradient
        if int(wanted.sum()) > room:
            wanted = torch.zeros_like(wanted)
            wanted[torch.argsort(mean, descending=True, stable=True)[:room]] = True
        sigma = g.log_scales.detach().exp().amax(1) * face_scales[g.face_ids]
        split = wanted & (sigma > c.split_scale * self.extent)
        clone = wanted & ~split
        keep = ~split
        children = torch.cat([torch.nonzero(clone)[:, 0], torch.nonzero(split)[:, 0].repeat_interleave(2)])
        added = self._children(children, split)
        rows = torch.cat([torch.nonzero(keep)[:, 0], children])
        n_kept = int(keep.sum())
        alive = self._survivors(
            torch.sigmoid(torch.cat([g.opacity_logits.detach()[keep], added["opacity_logits"]])), g.face_ids[rows]
        )
        face_ids = g.face_ids[rows][alive]
        for name in g.parameter_names:
            old = getattr(g, name)
            new = nn.Parameter(torch.cat([old.detach()[keep], added[name]])[alive])
            _replace(optimizer, old, new, keep, n_kept, alive)
            setattr(g, name, new)
        g.face_ids = face_ids
        self.reset()

    def _children(self, parents: Tensor, split: Tensor) -> dict[str, Tensor]:
        """Copies of their parents; halves of a split are moved inside it and made smaller, in local units."""
        g = self.gaussians
        values = {name: getattr(g, name).detach()[parents].clone() for name in g.parameter_names}
        halves = split[parents]
        noise = torch.randn(len(parents), 3, generator=self.generator).to(parents.device)
        step = noise * values["log_scales"].exp()
        turned = step + 2.0 * _turn(torch.nn.functional.normalize(values["quats"], dim=1), step)
        values["local_means"] = torch.where(halves[:, None], values["local_means"] + turned, values["local_means"])
        smaller = values["log_scales"] - torch.log(torch.tensor(1.6)).item()
        values["log_scales"] = torch.where(halves[:, None], smaller, values["log_scales"])
        return values

    def _survivors(self, opacities: Tensor, face_ids: Tensor) -> Tensor:
        """Opaque enough, or the most opaque of a face (the first of equals): no face loses all its Gaussians."""
        order = torch.argsort(opacities, descending=True, stable=True)
        order = order[torch.argsort(face_ids[order], stable=True)]
        first = torch.ones_like(order, dtype=torch.bool)
        first[1:] = face_ids[order][1:] != face_ids[order][:-1]
        alive = opacities >= self.config.min_opacity
        alive[order[first]] = True
        return alive

    def state_dict(self) -> dict[str, Tensor]:
        return {"total": self.total, "seen": self.seen, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from a ``state_dict`` of any device, which is copied."""
        device = self.gaussians.face_ids.device
        self.total, self.seen = (state[name].to(device, copy=True) for name in ("total", "seen"))
        self.generator.set_state(state["generator"])


def _turn(q: Tensor, v: Tensor) -> Tensor:
    """Half of what a rotation by unit quaternions wxyz adds to vectors."""
    axis = q[:, 1:]
    t = torch.cross(axis, v, dim=1)
    return q[:, :1] * t + torch.cross(axis, t, dim=1)


def _replace(
    optimizer: torch.optim.Adam, old: Tensor, new: nn.Parameter, keep: Tensor, n_kept: int, alive: Tensor
) -> None:
    """Put ``new`` in the place of ``old``; survivors keep their moments, newcomers start without any."""
    state = optimizer.state.pop(old, None)
    for group in optimizer.param_groups:
        group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
    if state is None:
        return
    for key in ("exp_avg", "exp_avg_sq"):
        kept = state[key][keep]
        fresh = kept.new_zeros(len(alive) - n_kept, *kept.shape[1:])
        state[key] = torch.cat([kept, fresh])[alive]
    optimizer.state[new] = state
