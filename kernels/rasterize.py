"""The rasterizer: 3D Gaussians and a camera to an image, differentiable in all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels import bridge, compositing, compositing_blocks, projection
from mgavatar.kernels.tiling import MAX_ISECTS, WorkLists, build_work_lists

Form = Literal["auto", "plain", "blocks"]

LEAST_STOP = 1e-30
"""Transmittance that ends a pixel where ``stop`` is 0: below it T would underflow, and the adjoint starts from T."""

LARGEST_CAP = 1.0 - 1e-6
"""Largest alpha cap: in single precision ``1 - alpha`` must keep some bits."""


@dataclass(frozen=True, kw_only=True)
class RasterSettings:
    """Approximations of the rasterizer; ``docs/lab/tradeoffs.md`` measures what each costs."""

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
    """``plain`` is one thread per pixel, on any device and dtype; ``blocks`` is the CPU's vector form in float32."""
    exp: Literal["polynomial", "exact"] = "polynomial"
    """Exponential of the ``blocks`` form: a polynomial of degree 6 in vectors, or the C library's, number by number."""


@dataclass(frozen=True)
class Rendering:
    """Images of one camera, or of several.

    Attributes:
        image: Composited colours, shape [3, H, W], or [B, 3, H, W] of several views.
        alphas: Opacity of each pixel, 1 minus its final transmittance, shape [H, W] or [B, H, W].
        depths: Sum of blending weight times depth [m], not divided by ``alphas``, shape [H, W] or [B, H, W].
        visible: True for the Gaussians that touch the image, shape [N], bool.
    """

    image: Tensor
    alphas: Tensor
    depths: Tensor
    visible: Tensor


_NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmat", "K", "background")


def _check(n: int, tensors: tuple[Tensor, ...], width: int, height: int, settings: RasterSettings) -> None:
    views = tuple(tensors[5].shape[:-2])
    if views == (0,):
        raise ValueError(f"viewmat has shape {tuple(tensors[5].shape)}, needs at least one view")
    views = views if len(views) == 1 else ()
    camera: tuple[tuple[int, ...], ...] = ((*views, 4, 4), (*views, 3, 3), (*views, 3))
    shapes: tuple[tuple[int, ...], ...] = ((n, 3), (n, 4), (n, 3), (n,), (n, 3), *camera)
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
    if settings.exp not in compositing_blocks.KERNELS:
        raise ValueError(f"exp must be one of {', '.join(compositing_blocks.KERNELS)}, got {settings.exp}")
    for name in ("alpha_threshold", "stop"):
        if not 0.0 <= getattr(settings, name) < 1.0:
            raise ValueError(f"{name} must be at least 0 and below 1, got {getattr(settings, name)}")


def _check_views(view_ids: Tensor | None, means: Tensor, viewmat: Tensor) -> None:
    if viewmat.ndim == 2:
        if view_ids is not None:
            raise ValueError(f"view_ids needs several views, but viewmat has shape {tuple(viewmat.shape)}")
        return
    if view_ids is None:
        raise ValueError(f"viewmat has shape {tuple(viewmat.shape)}, so view_ids must give each Gaussian's view")
    if tuple(view_ids.shape) != (len(means),):
        raise ValueError(f"view_ids has shape {tuple(view_ids.shape)}, needs {(len(means),)}")
    if view_ids.dtype != torch.int32 or view_ids.device != means.device:
        raise ValueError(f"view_ids is {view_ids.dtype} on {view_ids.device}, needs torch.int32 on {means.device}")
    if len(means):
        low, high = torch.stack(view_ids.aminmax()).tolist()
        if low < 0 or high >= len(viewmat):
            raise ValueError(f"view_ids lie in {low}..{high}, need 0..{len(viewmat) - 1}")


def _check_screen_grads(screen_grads: Tensor, means: Tensor) -> None:
    if tuple(screen_grads.shape) != (len(means), 2):
        raise ValueError(f"screen_grads has shape {tuple(screen_grads.shape)}, needs {(len(means), 2)}")
    if screen_grads.dtype != means.dtype or screen_grads.device != means.device or not screen_grads.is_contiguous():
        raise ValueError(f"screen_grads must be contiguous, {means.dtype} and on {means.device}")


def _form(settings: RasterSettings, means: Tensor) -> Form:
    blocks_fit = means.device.type == "cpu" and means.dtype == torch.float32
    if settings.form == "blocks" and not blocks_fit:
        raise ValueError(f"form 'blocks' needs float32 on a CPU, means is {means.dtype} on {means.device}")
    if settings.form == "auto":
        return "blocks" if blocks_fit else "plain"
    return settings.form


@dataclass(frozen=True)
class Work:
    """Projected Gaussians and the tiles that blend them: what the two halves of the rasterizer hand over.

    Attributes:
        splats: Footprints, columns ``projection.SPLAT``, shape [N, 16].
        lists: Intersections of each tile, by depth.
        form: ``plain`` or ``blocks``.
        n_columns: Tiles across the image.
        size: Image width and height [px].
        view_ids: View of each Gaussian, shape [N], int32; empty where there is one view.
        n_views: Number of views.
    """

    splats: Tensor
    lists: WorkLists
    form: Form
    n_columns: int
    size: tuple[int, int]
    view_ids: Tensor
    n_views: int = 1

    @property
    def n_tiles(self) -> int:
        """Return the number of tiles of all views' images."""
        return len(self.lists.isect_offsets) - 1

    @property
    def tiles_per_view(self) -> int:
        """Return the number of tiles of one view's image."""
        return self.n_tiles // self.n_views

    @property
    def inputs(self) -> list[Any]:
        """List the arrays that both directions of the blending read."""
        return [self.splats, self.lists.isect_offsets, self.lists.gaussian_ids]


def project(
    settings: RasterSettings, size: tuple[int, int], tensors: tuple[Tensor, ...], view_ids: Tensor | None = None
) -> Work:
    """Find each Gaussian's footprint and list the tiles' work.

    Args:
        settings: Truncations and form.
        size: Image width and height [px].
        tensors: Checked inputs in the order of :func:`rasterize`: means to colors, viewmat, K, background.
        view_ids: View of each Gaussian, shape [N], int32, or None for one view.

    Returns:
        The work of :func:`blend`.
    """
    *gaussians, viewmat, K, _ = tensors
    means = gaussians[0]
    width, height = size
    form = _form(settings, means)
    tile = (
        (compositing_blocks.TILE_WIDTH, compositing_blocks.TILE_HEIGHT) if form == "blocks" else (compositing.TILE,) * 2
    )
    n_columns, n_rows = -(-width // tile[0]), -(-height // tile[1])
    n = len(means)
    n_views = len(viewmat) if viewmat.ndim == 3 else 1
    view_ids = torch.empty(0, dtype=torch.int32, device=means.device) if view_ids is None else view_ids
    splats = means.new_empty(n, 16)
    tiles = torch.empty(n, 4, dtype=torch.int32, device=means.device)
    keys = torch.empty(n, dtype=torch.float32, device=means.device)
    if n:
        inputs = [*gaussians, viewmat.view(-1, 4, 4), K.view(-1, 3, 3), view_ids, width, height, *tile]
        inputs += [settings.near, settings.low_pass, settings.alpha_threshold]
        bridge.launch_ranges(projection.KERNELS[means.dtype][0], n, inputs, [splats, tiles, keys], ranges_per_thread=1)
    lists = build_work_lists(keys, tiles, n_columns, n_rows, view_ids=view_ids, n_views=n_views)
    return Work(splats, lists, form, n_columns, size, view_ids, n_views)


def _by_view(background: Tensor, *tensors: Tensor) -> list[Tensor]:
    """Give ``tensors`` the view as first axis, as the kernels take them; those of a single view do not have it yet."""
    return list(tensors) if background.ndim == 2 else [tensor[None] for tensor in tensors]


def blend(settings: RasterSettings, work: Work, background: Tensor) -> list[Tensor]:
    """Composite the Gaussians of each tile, front to back.

    Args:
        settings: Truncations and form.
        work: Made by :func:`project`.
        background: RGB, shape [3], or [B, 3] for several views; then all outputs have B as their first axis.

    Returns:
        Image [3, H, W], alphas, depths and final T [H, W], and the last entry that each pixel blended [H, W], int32.

    Raises:
        ValueError: If there are more than 2^31 - 1 pixels.
    """
    width, height = work.size
    if work.n_views * width * height > MAX_ISECTS:
        raise ValueError(f"{work.n_views} x {width} x {height} pixels are more than {MAX_ISECTS}: lower the image size")
    plane = (*background.shape[:-1], height, width)
    image = background.new_empty(*background.shape, height, width)
    planes = [background.new_empty(plane) for _ in range(3)]
    outputs = [image, *planes, torch.empty(plane, dtype=torch.int32, device=background.device)]
    knobs = [settings.alpha_threshold, max(settings.stop, LEAST_STOP), settings.alpha_cap]
    inputs = [*work.inputs, *_by_view(background, background), work.n_columns]
    written = _by_view(background, *outputs)
    if work.form == "blocks":
        bridge.launch_ranges(compositing_blocks.KERNELS[settings.exp][0], work.n_tiles, [*inputs, *knobs], written)
    else:
        inputs += [work.tiles_per_view, *knobs]
        bridge.launch(compositing.KERNELS[background.dtype][0], work.n_tiles * compositing.BLOCK, inputs, written)
    return outputs


def blend_backward(
    settings: RasterSettings, work: Work, background: Tensor, final_T: Tensor, last_ids: Tensor, v_planes: list[Tensor]
) -> Tensor:
    """Compute each intersection's share of its splat's gradient, shape [M, 10], columns ``projection.GRADIENT``.

    Args:
        settings: Truncations and form.
        work: Made by :func:`project`.
        background: As in :func:`blend`.
        final_T: From :func:`blend`.
        last_ids: From :func:`blend`.
        v_planes: Gradients of image, alphas and depths.
    """
    blocks = work.form == "blocks"
    # The blocks write every intersection; the plain form on a CPU adds up threads that run one after the other.
    partials = (background.new_empty if blocks else background.new_zeros)(len(work.lists.isect_ids), 10)
    inputs = [*work.inputs, work.lists.isect_ids, *_by_view(background, background), work.n_columns]
    rest = [settings.alpha_threshold, settings.alpha_cap, *_by_view(background, final_T, last_ids, *v_planes)]
    if blocks:
        bridge.launch_ranges(compositing_blocks.KERNELS[settings.exp][1], work.n_tiles, [*inputs, *rest], [partials])
    else:
        inputs += [work.tiles_per_view, *rest]
        kernel = compositing.KERNELS[background.dtype][1]
        bridge.launch(kernel, work.n_tiles * compositing.BLOCK, inputs, [partials])
    return partials


def _camera_gradient(shares: Tensor, view_ids: Tensor, viewmat: Tensor) -> Tensor:
    """Sum the Gaussians' shares [N, 12] of each view, in the order in which that view alone adds them."""
    v_viewmat = torch.zeros_like(viewmat)
    if viewmat.ndim == 2:
        v_viewmat[:3] = shares.sum(0).reshape(3, 4)
        return v_viewmat
    for b in range(len(viewmat)):
        v_viewmat[b, :3] = shares[view_ids == b].sum(0).reshape(3, 4)
    return v_viewmat


def _background_gradient(v_image: Tensor, final_T: Tensor) -> Tensor:
    """Return each view's background gradient; one sum per view has the same bits as that view alone."""
    if v_image.ndim == 3:
        return (v_image * final_T).sum((1, 2))
    return torch.stack([(v * T).sum((1, 2)) for v, T in zip(v_image, final_T, strict=True)])


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        settings: RasterSettings,
        size: tuple[int, int],
        screen_grads: Tensor | None,
        view_ids: Tensor | None,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        tensors = tuple(tensor.contiguous() for tensor in tensors)
        work = project(settings, size, tensors, view_ids)
        image, alphas, depths, final_T, last_ids = blend(settings, work, tensors[-1])
        ctx.save_for_backward(*tensors, work.view_ids, final_T, last_ids)
        ctx.work, ctx.settings, ctx.screen_grads = work, settings, screen_grads
        visible = work.lists.tiles_per_gauss > 0
        ctx.mark_non_differentiable(visible)
        return image, alphas, depths, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_alphas: Tensor, v_depths: Tensor, _: Tensor) -> Any:
        *tensors, _, final_T, last_ids = ctx.saved_tensors  # torch raises here if one was changed in place
        means, quats, scales, _, _, viewmat, K, background = tensors
        work: Work = ctx.work
        settings: RasterSettings = ctx.settings
        v_planes = [v.contiguous() for v in (v_image, v_alphas, v_depths)]
        partials = blend_backward(settings, work, background, final_T, last_ids, v_planes)
        grads = [torch.zeros_like(tensor) for tensor in tensors[:5]]
        means2d = ctx.screen_grads if ctx.screen_grads is not None else means.new_empty(len(means), 2)
        means2d.zero_()
        wants_camera = ctx.needs_input_grad[9]
        # In double precision: the camera's gradient is a sum over all Gaussians, which mostly cancels.
        v_views = torch.zeros(len(means) if wants_camera else 0, 12, dtype=torch.float64, device=means.device)
        if len(means):
            inputs = [means, quats, scales, viewmat.view(-1, 4, 4), K.view(-1, 3, 3), work.view_ids, *work.size]
            inputs += [settings.low_pass, work.lists.first_isects, work.lists.tiles_per_gauss, partials]
            kernel = projection.KERNELS[means.dtype][1]
            bridge.launch_ranges(kernel, len(means), inputs, [*grads, means2d, v_views], ranges_per_thread=2)
        v_viewmat = _camera_gradient(v_views, work.view_ids, viewmat) if wants_camera else None
        v_background = _background_gradient(v_planes[0], final_T) if ctx.needs_input_grad[11] else None
        return None, None, None, None, *grads, v_viewmat, None, v_background


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
    view_ids: Tensor | None = None,
) -> Rendering:
    """Draw Gaussians as a camera sees them (EWA splatting, front to back), or several cameras in one launch.

    Differentiable in the Gaussians, ``viewmat`` and ``background``; deterministic on every device and for any number
    of threads. A Gaussian with a NaN, an infinity or a zero quaternion is not drawn; its gradient is zero.

    With B views, each Gaussian belongs to one of them; a view's image and gradients are, bit for bit, what its
    Gaussians give alone. Gaussians that several views see are repeated by the caller.

    Args:
        means: Centres in world space [m], shape [N, 3], float32 or float64.
        quats: Rotations wxyz, normalised here, shape [N, 4]; Gaussians with norms outside 1e-12..1e12 are not drawn.
        scales: Standard deviations along the rotated axes [m], shape [N, 3].
        opacities: In 0..1, shape [N].
        colors: RGB, shape [N, 3].
        viewmat: World to camera, OpenCV axes, shape [4, 4], or [B, 4, 4] for several views.
        K: Intrinsics [px], shape [3, 3], or [B, 3, 3]; one may serve several views.
        size: Image width and height [px].
        background: RGB behind everything, black by default, shape [3], or [B, 3]; one may serve several views.
        settings: Truncations and form.
        screen_grads: Filled by the backward pass with the gradient of the image-space means [1/px], shape [N, 2].
        view_ids: View of each Gaussian where there are several, shape [N], int32.

    Returns:
        Image, alphas, depths and visibility; the first three by view where there are several.

    Raises:
        ValueError: If shapes, dtypes, devices or settings do not fit, ``view_ids`` has an index outside the views, or
            the work exceeds 2^31 - 1 intersections or pixels.
    """
    settings = settings or RasterSettings()
    background = means.new_zeros(*viewmat.shape[:-2], 3) if background is None else background
    if viewmat.ndim == 3:
        K = K.expand(len(viewmat), 3, 3) if K.shape == (3, 3) else K
        background = background.expand(len(viewmat), 3) if background.shape == (3,) else background
    tensors = (means, quats, scales, opacities, colors, viewmat, K, background)
    _check(len(means), tensors, *size, settings)
    _check_views(view_ids, means, viewmat)
    if screen_grads is not None:
        _check_screen_grads(screen_grads, means)
    return Rendering(*_Rasterize.apply(settings, size, screen_grads, view_ids, *tensors))
