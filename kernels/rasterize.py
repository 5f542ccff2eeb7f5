"""The rasterizer: 3D Gaussians and a camera to an image, differentiable in all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels import bridge, compositing, compositing_rows, projection
from mgavatar.kernels.tiling import WorkLists, build_work_lists

Form = Literal["auto", "plain", "rows"]

LEAST_STOP = 1e-30
"""Where ``stop = 0`` ends a pixel: past it the transmittance would underflow and the adjoint could not walk back."""

LARGEST_CAP = 1.0 - 1e-6
"""In single precision ``1 - alpha`` needs some bits left."""


@dataclass(frozen=True, kw_only=True)
class RasterSettings:
    """What the rasterizer leaves out, and where; ``docs/numerics.md`` has the price of each."""

    alpha_threshold: float = 1.0 / 255.0
    """Contributions below this alpha are skipped; 0 blends every Gaussian with every pixel."""
    stop: float = 1e-4
    """A pixel ends after the Gaussian that takes its transmittance below this; 0 means 1e-30."""
    alpha_cap: float = 0.9999
    """Largest alpha of one Gaussian at one pixel."""
    low_pass: float = 0.3
    """Variance added to both image axes [px^2]."""
    near: float = 0.01
    """Gaussians nearer than this are not drawn [m]."""
    form: Form = "auto"
    """``plain`` is one thread a pixel, on any device and dtype; ``rows`` is the CPU's vector form in float32."""


@dataclass(frozen=True)
class Rendering:
    """What one camera sees.

    Attributes:
        image: Composited colours, shape [3, H, W].
        alpha: Coverage, shape [H, W].
        depth: Sum of blending weight times depth [m], not divided by alpha, shape [H, W].
        visible: Which Gaussians touch the image, shape [N], bool.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    visible: Tensor


_NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmat", "K", "background")


def _check(n: int, tensors: tuple[Tensor, ...], width: int, height: int, settings: RasterSettings) -> None:
    shapes: tuple[tuple[int, ...], ...] = ((n, 3), (n, 4), (n, 3), (n,), (n, 3), (4, 4), (3, 3), (3,))
    for name, tensor, shape in zip(_NAMES, tensors, shapes, strict=True):
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, needs {shape}")
        if tensor.dtype != tensors[0].dtype or tensor.device != tensors[0].device:
            raise ValueError(
                f"{name} is {tensor.dtype} on {tensor.device}, means is {tensors[0].dtype} on {tensors[0].device}"
            )
    if tensors[0].dtype not in projection.KERNELS:
        raise ValueError(f"means is {tensors[0].dtype}, needs float32 or float64")
    if width < 1 or height < 1:
        raise ValueError(f"image size must be positive, got {width} x {height}")
    if not 0.0 < settings.alpha_cap <= LARGEST_CAP:
        raise ValueError(f"alpha_cap must lie between 0 and {LARGEST_CAP}, got {settings.alpha_cap}")
    if not settings.near > 0.0:
        raise ValueError(f"near must be positive, got {settings.near}")
    if not settings.low_pass >= 0.0:
        raise ValueError(f"low_pass must be at least 0, got {settings.low_pass}")
    for name in ("alpha_threshold", "stop"):
        if not 0.0 <= getattr(settings, name) < 1.0:
            raise ValueError(f"{name} must be at least 0 and below 1, got {getattr(settings, name)}")


def _check_screen_grads(screen_grads: Tensor, means: Tensor) -> None:
    if tuple(screen_grads.shape) != (len(means), 2):
        raise ValueError(f"screen_grads has shape {tuple(screen_grads.shape)}, needs {(len(means), 2)}")
    if screen_grads.dtype != means.dtype or screen_grads.device != means.device or not screen_grads.is_contiguous():
        raise ValueError(f"screen_grads must be contiguous, {means.dtype} and on {means.device}")


def _form(settings: RasterSettings, means: Tensor) -> Form:
    rows_fit = means.device.type == "cpu" and means.dtype == torch.float32
    if settings.form == "rows" and not rows_fit:
        raise ValueError(f"form 'rows' needs float32 on a CPU, means is {means.dtype} on {means.device}")
    if settings.form == "auto":
        return "rows" if rows_fit else "plain"
    return settings.form


@dataclass(frozen=True)
class Work:
    """Projected Gaussians and who blends them, between the two halves of the rasterizer.

    Attributes:
        splats: Footprints, columns ``projection.SPLAT``, shape [N, 16].
        lists: Depth-sorted splats of each tile.
        form: ``plain`` or ``rows``.
        n_columns: Tiles across the image.
        size: Image width and height [px].
    """

    splats: Tensor
    lists: WorkLists
    form: Form
    n_columns: int
    size: tuple[int, int]

    @property
    def n_tiles(self) -> int:
        """Tiles of the image."""
        return len(self.lists.tile_begin)

    @property
    def inputs(self) -> list[Any]:
        """What both directions of the blending read."""
        lists = self.lists
        return [self.splats, lists.tile_begin, lists.tile_end, lists.items, lists.item_splat]


def project(settings: RasterSettings, size: tuple[int, int], tensors: tuple[Tensor, ...]) -> Work:
    """Find each Gaussian's footprint and list the tiles' work; ``tensors`` are checked and in the order of the op."""
    *gaussians, viewmat, K, _ = tensors
    means = gaussians[0]
    width, height = size
    form = _form(settings, means)
    tile = (compositing_rows.TILE_WIDTH, compositing_rows.TILE_HEIGHT) if form == "rows" else (compositing.TILE,) * 2
    n_columns, n_rows = -(-width // tile[0]), -(-height // tile[1])
    n = len(means)
    splats = means.new_empty(n, 16)
    tiles = torch.empty(n, 4, dtype=torch.int32, device=means.device)
    keys = torch.empty(n, dtype=torch.float32, device=means.device)
    if n:
        inputs = [*gaussians, viewmat[None], K[None], width, height, *tile]
        inputs += [settings.near, settings.low_pass, settings.alpha_threshold]
        bridge.launch_ranges(projection.KERNELS[means.dtype][0], n, inputs, [splats, tiles, keys])
    return Work(splats, build_work_lists(keys, tiles, n_columns, n_rows), form, n_columns, size)


def blend(settings: RasterSettings, work: Work, background: Tensor) -> list[Tensor]:
    """Composite: image [3, H, W], coverage, depth, final T [H, W] and the last entry that each pixel accepted."""
    width, height = work.size
    image = background.new_empty(3, height, width)
    planes = [background.new_empty(height, width) for _ in range(3)]
    outputs = [image, *planes, torch.empty(height, width, dtype=torch.int32, device=background.device)]
    knobs = [settings.alpha_threshold, max(settings.stop, LEAST_STOP), settings.alpha_cap]
    inputs = [*work.inputs, background, work.n_columns, *knobs]
    if work.form == "rows":
        bridge.launch_ranges(compositing_rows.composite_rows_kernel, work.n_tiles, inputs, outputs)
    else:
        bridge.launch(compositing.KERNELS[background.dtype][0], work.n_tiles * compositing.BLOCK, inputs, outputs)
    return outputs


def blend_backward(
    settings: RasterSettings, work: Work, background: Tensor, final_T: Tensor, last: Tensor, v_planes: list[Tensor]
) -> Tensor:
    """Gradient of each item's splat, columns ``projection.GRADIENT``, shape [M, 10]."""
    rows = work.form == "rows"
    # The rows write every item; the plain form on a CPU adds up threads that run one after the other.
    partials = (background.new_empty if rows else background.new_zeros)(len(work.lists.items), 10)
    inputs = [*work.inputs, background, work.n_columns, settings.alpha_threshold, settings.alpha_cap, final_T, last]
    inputs += v_planes
    if rows:
        bridge.launch_ranges(compositing_rows.composite_rows_bwd_kernel, work.n_tiles, inputs, [partials])
    else:
        kernel = compositing.KERNELS[background.dtype][1]
        bridge.launch(kernel, work.n_tiles * compositing.BLOCK, inputs, [partials])
    return partials


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, settings: RasterSettings, size: tuple[int, int], screen_grads: Tensor | None, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        tensors = tuple(tensor.contiguous() for tensor in tensors)
        work = project(settings, size, tensors)
        image, coverage, depth, final_T, last = blend(settings, work, tensors[-1])
        ctx.save_for_backward(*tensors, final_T, last)
        ctx.work, ctx.settings, ctx.screen_grads = work, settings, screen_grads
        visible = work.lists.n_items > 0
        ctx.mark_non_differentiable(visible)
        return image, coverage, depth, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_coverage: Tensor, v_depth: Tensor, _: Tensor) -> Any:
        *tensors, final_T, last = ctx.saved_tensors
        means, quats, scales, _, _, viewmat, K, background = tensors
        work: Work = ctx.work
        settings: RasterSettings = ctx.settings
        v_planes = [v.contiguous() for v in (v_image, v_coverage, v_depth)]
        partials = blend_backward(settings, work, background, final_T, last, v_planes)
        grads = [torch.zeros_like(tensor) for tensor in tensors[:5]]
        means2d = ctx.screen_grads if ctx.screen_grads is not None else means.new_empty(len(means), 2)
        means2d.zero_()
        wants_camera = ctx.needs_input_grad[8]
        # In double precision: the camera's gradient is a sum over all Gaussians, which mostly cancels.
        v_views = torch.zeros(len(means) if wants_camera else 0, 12, dtype=torch.float64, device=means.device)
        if len(means):
            inputs = [means, quats, scales, viewmat[None], K[None], *work.size, settings.low_pass]
            inputs += [work.lists.first_item, work.lists.n_items, partials]
            kernel = projection.KERNELS[means.dtype][1]
            bridge.launch_ranges(kernel, len(means), inputs, [*grads, means2d, v_views])
        v_viewmat = None
        if wants_camera:
            v_viewmat = torch.zeros_like(viewmat)
            v_viewmat[:3] = v_views.sum(0).reshape(3, 4)
        v_background = (v_image * final_T).sum((1, 2)) if ctx.needs_input_grad[10] else None
        return None, None, None, *grads, v_viewmat, None, v_background


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    *,
    viewmat: Tensor,
    K: Tensor,
    size: tuple[int, int],
    background: Tensor | None = None,
    settings: RasterSettings | None = None,
    screen_grads: Tensor | None = None,
) -> Rendering:
    """Draw Gaussians as a camera sees them (EWA splatting, front to back).

    Differentiable in the Gaussians, ``viewmat`` and ``background``; deterministic on every device and for any number
    of threads. A Gaussian with a NaN, an infinity or a zero quaternion is not drawn and gets a zero gradient.

    Args:
        means: Centres in world space [m], shape [N, 3], float32 or float64.
        quats: Rotations wxyz, normalised here; norms outside 1e-12..1e12 are not drawn, shape [N, 4].
        scales: Standard deviations along the rotated axes [m], shape [N, 3].
        opacities: In 0..1, shape [N].
        colors: RGB, shape [N, 3].
        viewmat: World to camera, OpenCV axes, shape [4, 4].
        K: Intrinsics [px], shape [3, 3].
        size: Image width and height [px].
        background: RGB behind everything, black by default, shape [3].
        settings: Truncations and form.
        screen_grads: Filled by the backward pass with the gradient of the image-space means [1/px], shape [N, 2].

    Returns:
        Image, coverage, depth and visibility.

    Raises:
        ValueError: If shapes, dtypes, devices or settings do not fit, or the work exceeds 2^31 - 1 items.
    """
    settings = settings or RasterSettings()
    background = means.new_zeros(3) if background is None else background
    tensors = (means, quats, scales, opacities, colors, viewmat, K, background)
    _check(len(means), tensors, *size, settings)
    if screen_grads is not None:
        _check_screen_grads(screen_grads, means)
    return Rendering(*_Rasterize.apply(settings, size, screen_grads, *tensors))
