"""Adaptive density control of face-bound Gaussians (Section 3.2): clone, split, prune."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from mgavatar.appearance.face_gaussians import FaceGaussians
from mgavatar.config import DensityConfig
from mgavatar.kernels.rasterize import Rendering

SPLIT_SHRINK = 1.6
"""Both halves of a split Gaussian are smaller by this factor, as in 3D Gaussian splatting."""


class DensityControl:
    """Collect image-space gradients, and refine the Gaussians where they are large.

    Sizes are compared with the diagonal of the mesh, not with the spread of the cameras as in 3D Gaussian splatting:
    those of a monocular capture are all in one place.

    Attributes:
        gaussians: The Gaussians, whose parameters are replaced in every round.
        config: Thresholds and schedule.
        extent: Diagonal of the canonical mesh [m].
        generator: Generator on the CPU that draws the positions of split Gaussians.
        total: Sum of the gradients' norms over the views that show a Gaussian, in half image sizes, shape [N].
        seen: Number of these views, shape [N], float32.
    """

    def __init__(self, gaussians: FaceGaussians, config: DensityConfig, *, extent: float, seed: int) -> None:
        """Start without gradients; ``seed`` is that of the generator."""
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
            rendering: The view, for its size and the Gaussians that it shows.
        """
        height, width = rendering.alphas.shape
        # By positions in -1..1 over the image, as in 3D Gaussian splatting: the threshold then holds for every size.
        half = torch.tensor([0.5 * width, 0.5 * height], device=screen_grads.device)
        self.total += torch.where(rendering.visible, (screen_grads * half).norm(dim=1), 0.0)
        self.seen += rendering.visible

    def due(self, before: float, now: float) -> bool:
        """Return True if a round lies in the part of the schedule after ``before`` up to ``now``, in iterations.

        Steps of a fit with a budget can be shorter or longer than one iteration, so positions are not whole numbers.
        """
        c = self.config
        last_round = now // c.every * c.every  # the latest multiple of ``every`` that has been reached
        return last_round > before and c.start <= last_round <= c.stop

    def refine(self, optimizer: torch.optim.Adam, face_scales: Tensor) -> None:
        """Clone small Gaussians and split large ones where the mean gradient is large, then remove faint ones.

        Args:
            optimizer: Its groups hold the Gaussians' parameters; they are replaced, with the rows of their moments.
            face_scales: k of every canonical face [m], shape [F].
        """
        g = self.gaussians
        clone, split = self._choose(face_scales)
        # New order of rows: all that are not split, the clones, then two halves for each split Gaussian, which itself
        # is dropped. ``parents`` names the old row of each new Gaussian, ``rows`` that of each row before pruning.
        keep = ~split
        kept_rows, halves = torch.nonzero(keep)[:, 0], torch.nonzero(split)[:, 0].repeat_interleave(2)
        parents = torch.cat([torch.nonzero(clone)[:, 0], halves])
        rows = torch.cat([kept_rows, parents])
        added = self._children(parents, split)
        logits = torch.cat([g.opacity_logits.detach()[keep], added["opacity_logits"]])
        alive = self._survivors(torch.sigmoid(logits), g.face_ids[rows])
        face_ids = g.face_ids[rows][alive]
        for name in g.parameter_names:
            old = getattr(g, name)
            new = nn.Parameter(torch.cat([old.detach()[keep], added[name]])[alive])
            _replace(optimizer, old, new, kept_rows, alive)
            setattr(g, name, new)
        g.face_ids = face_ids
        self.reset()

    def _choose(self, face_scales: Tensor) -> tuple[Tensor, Tensor]:
        """Choose the Gaussians to clone and those to split, two masks of shape [N]."""
        g, c = self.gaussians, self.config
        mean = self.total / self.seen.clamp(min=1.0)  # Gaussians that no view has shown have a sum of 0
        wanted = mean >= c.gradient
        room = max(0, c.max_gaussians - len(g))  # a clone and a split both add one Gaussian
        if int(wanted.sum()) > room:
            # The largest gradients come first. The sort is stable, so that ties go to the lowest index and exactly
            # ``room`` are chosen on every run, which a threshold at the last chosen value would not do.
            wanted = torch.zeros_like(wanted)
            wanted[torch.argsort(mean, descending=True, stable=True)[:room]] = True
        sigma = g.log_scales.detach().exp().amax(1) * face_scales[g.face_ids]
        split = wanted & (sigma > c.split_scale * self.extent)
        return wanted & ~split, split

    def _children(self, parents: Tensor, split: Tensor) -> dict[str, Tensor]:
        """Build the new Gaussians: exact copies of cloned parents, smaller and displaced copies of split ones.

        Args:
            parents: Row of each child's parent, shape [M].
            split: Mask of the Gaussians that are split, shape [N].

        Returns:
            Values of every parameter, M rows each.
        """
        g = self.gaussians
        values = {name: getattr(g, name).detach()[parents].clone() for name in g.parameter_names}
        is_half = split[parents][:, None]
        # A half is drawn from its parent's own distribution: a step with its standard deviations along its axes, in
        # the local frame of the face. Drawn for clones too, so that the numbers do not depend on who is cloned.
        noise = torch.randn(len(parents), 3, generator=self.generator).to(parents.device)
        step = _rotate(values["quats"], noise * values["log_scales"].exp())
        values["local_means"] = torch.where(is_half, values["local_means"] + step, values["local_means"])
        smaller = values["log_scales"] - math.log(SPLIT_SHRINK)
        values["log_scales"] = torch.where(is_half, smaller, values["log_scales"])
        return values

    def _survivors(self, opacities: Tensor, face_ids: Tensor) -> Tensor:
        """Choose the Gaussians to keep: those that are opaque enough, and the most opaque of each face.

        No face loses all its Gaussians, because nothing would bring any back.

        Args:
            opacities: In 0..1, shape [M].
            face_ids: Shape [M].

        Returns:
            A mask of shape [M].
        """
        # Two stable sorts order by face, and within a face by falling opacity, equals by index: the second sort keeps
        # the order of the first among rows of one face. The first row of each run of equal faces is then its best.
        order = torch.argsort(opacities, descending=True, stable=True)
        order = order[torch.argsort(face_ids[order], stable=True)]
        sorted_faces = face_ids[order]
        starts_run = torch.ones_like(order, dtype=torch.bool)
        starts_run[1:] = sorted_faces[1:] != sorted_faces[:-1]
        alive = opacities >= self.config.min_opacity
        alive[order[starts_run]] = True
        return alive

    def state_dict(self) -> dict[str, Tensor]:
        """Return the collected gradients and the state of the random generator."""
        return {"total": self.total, "seen": self.seen, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from a ``state_dict`` of any device, which is copied."""
        device = self.gaussians.face_ids.device
        self.total, self.seen = (state[name].to(device, copy=True) for name in ("total", "seen"))
        self.generator.set_state(state["generator"])


def _rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors [N, 3] by quaternions wxyz of any length [N, 4]: ``v + 2 (w t + a x t)`` with ``t = a x v``."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    w, axis = unit[:, :1], unit[:, 1:]
    t = torch.cross(axis, vectors, dim=1)
    return vectors + 2.0 * (w * t + torch.cross(axis, t, dim=1))


def _replace(optimizer: torch.optim.Adam, old: Tensor, new: nn.Parameter, kept_rows: Tensor, alive: Tensor) -> None:
    """Put a parameter in the place of another; survivors keep their moments, new rows start with zeros.

    Args:
        optimizer: Has ``old`` in one of its groups.
        old: Parameter with N rows.
        new: Parameter with one row for each True in ``alive``.
        kept_rows: Rows of ``old`` that come first before pruning, shape [K].
        alive: Mask of the rows that are left after pruning, shape [M]; the K kept rows, then the new ones.
    """
    state = optimizer.state.pop(old, None)
    for group in optimizer.param_groups:
        group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
    if state is None:  # the optimizer has made no step yet
        return
    for key in ("exp_avg", "exp_avg_sq"):
        kept = state[key][kept_rows]
        fresh = kept.new_zeros(len(alive) - len(kept), *kept.shape[1:])
        state[key] = torch.cat([kept, fresh])[alive]
    optimizer.state[new] = state
