"""Adaptive density control of face-bound Gaussians (Section 3.2): clone, split, prune."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mgavatar.appearance.face_gaussians import FaceGaussians
from mgavatar.config import DensityConfig
from mgavatar.kernels.rasterize import Rendering


class DensityControl:
    """Collect image-space gradients, and refine the Gaussians where they are large.

    Sizes are compared with the diagonal of the mesh, not with the spread of the cameras: those of a monocular capture
    are all in one place.

    Attributes:
        gaussians: The Gaussians.
        config: Thresholds and times.
        extent: Diagonal of the canonical mesh [m].
        generator: Generator on the CPU that draws the noise of splits.
        total: Sum of the gradients' norms of each Gaussian, shape [N].
        seen: Number of views that drew it, shape [N].
    """

    def __init__(self, gaussians: FaceGaussians, config: DensityConfig, *, extent: float, seed: int) -> None:
        self.gaussians = gaussians
        self.config = config
        self.extent = extent
        self.generator = torch.Generator().manual_seed(seed)
        self.reset()

    def reset(self) -> None:
        """Forget the collected gradients."""
        device = self.gaussians.face_ids.device
        self.total = torch.zeros(len(self.gaussians), device=device)
        self.seen = torch.zeros(len(self.gaussians), device=device)

    def collect(self, screen_grads: Tensor, rendering: Rendering) -> None:
        """Add the gradients of one view.

        Args:
            screen_grads: Gradients of the loss by the image-space means [1/px], shape [N, 2].
            rendering: The view.
        """
        height, width = rendering.alphas.shape
        # By positions in -1..1 over the image, as in 3D Gaussian splatting: the threshold then holds for every size.
        half = torch.tensor([0.5 * width, 0.5 * height], device=screen_grads.device)
        self.total += torch.where(rendering.visible, (screen_grads * half).norm(dim=1), 0.0)
        self.seen += rendering.visible

    def due(self, before: float, now: float) -> bool:
        """Return True if a round falls after ``before`` and not after ``now``, places in the schedule in iterations."""
        c = self.config
        last = now // c.every * c.every
        return last > before and c.start <= last <= c.stop

    def refine(self, optimizer: torch.optim.Adam, face_scales: Tensor) -> None:
        """Clone small and split large Gaussians with large gradients, then remove faint ones.

        Args:
            optimizer: Optimizer of the Gaussians' parameters; the rows of its moments follow them.
            face_scales: k of every canonical face [m], shape [F].
        """
        g, c = self.gaussians, self.config
        mean = self.total / self.seen.clamp(min=1.0)
        room = max(0, c.max_gaussians - len(g))
        wanted = mean >= c.gradient
        if int(wanted.sum()) > room:  # each adds one Gaussian: the largest gradients first, ties by index
            wanted = torch.zeros_like(wanted)
            wanted[torch.argsort(mean, descending=True, stable=True)[:room]] = True
        sigma = g.log_scales.detach().exp().amax(1) * face_scales[g.face_ids]
        split = wanted & (sigma > c.split_scale * self.extent)
        clone = wanted & ~split
        # New rows are the old ones in their order without the split ones, then a copy of each clone and two halves of
        # each split one. ``parents`` are old rows; children inherit the face of their parent.
        keep = ~split
        parents = torch.cat([torch.nonzero(clone)[:, 0], torch.nonzero(split)[:, 0].repeat_interleave(2)])
        added = self._children(parents, split)
        rows = torch.cat([torch.nonzero(keep)[:, 0], parents])
        n_kept = int(keep.sum())
        logits = torch.cat([g.opacity_logits.detach()[keep], added["opacity_logits"]])
        alive = self._survivors(torch.sigmoid(logits), g.face_ids[rows])
        face_ids = g.face_ids[rows][alive]
        for name in g.parameter_names:
            old = getattr(g, name)
            new = nn.Parameter(torch.cat([old.detach()[keep], added[name]])[alive])
            _replace(optimizer, old, new, keep, n_kept, alive)
            setattr(g, name, new)
        g.face_ids = face_ids
        self.reset()

    def _children(self, parents: Tensor, split: Tensor) -> dict[str, Tensor]:
        """Return copies of the parents' parameters; halves of split ones are moved inside them and made smaller."""
        g = self.gaussians
        values = {name: getattr(g, name).detach()[parents].clone() for name in g.parameter_names}
        halves = split[parents]
        noise = torch.randn(len(parents), 3, generator=self.generator).to(parents.device)
        # A draw from the parent's own distribution: along its axes, then turned into the frame of its face.
        step = noise * values["log_scales"].exp()
        turned = step + 2.0 * _turn(torch.nn.functional.normalize(values["quats"], dim=1), step)
        values["local_means"] = torch.where(halves[:, None], values["local_means"] + turned, values["local_means"])
        smaller = values["log_scales"] - torch.log(torch.tensor(1.6)).item()
        values["log_scales"] = torch.where(halves[:, None], smaller, values["log_scales"])
        return values

    def _survivors(self, opacities: Tensor, face_ids: Tensor) -> Tensor:
        """Return True for Gaussians that stay, shape [N]: the opaque enough, and the most opaque one of each face."""
        # Stable sorts by opacity, then by face: within a face, opacities still fall and equal ones keep their order. So
        # the first of each face in ``order`` is its most opaque Gaussian.
        order = torch.argsort(opacities, descending=True, stable=True)
        order = order[torch.argsort(face_ids[order], stable=True)]
        first = torch.ones_like(order, dtype=torch.bool)
        first[1:] = face_ids[order][1:] != face_ids[order][:-1]
        alive = opacities >= self.config.min_opacity
        alive[order[first]] = True
        return alive

    def state_dict(self) -> dict[str, Tensor]:
        """Return the collected gradients and the state of the generator."""
        return {"total": self.total, "seen": self.seen, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Resume from a ``state_dict`` of any device, which is copied."""
        device = self.gaussians.face_ids.device
        self.total, self.seen = (state[name].to(device, copy=True) for name in ("total", "seen"))
        self.generator.set_state(state["generator"])


def _turn(q: Tensor, v: Tensor) -> Tensor:
    """Return half the difference that a rotation by unit quaternions (wxyz) makes to vectors, shape [N, 3]."""
    axis = q[:, 1:]
    t = torch.cross(axis, v, dim=1)
    return q[:, :1] * t + torch.cross(axis, t, dim=1)


def _replace(
    optimizer: torch.optim.Adam, old: Tensor, new: nn.Parameter, keep: Tensor, n_kept: int, alive: Tensor
) -> None:
    """Replace a parameter in an optimizer; rows that were kept keep their moments, new rows start with zeros."""
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
