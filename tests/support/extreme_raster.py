"""The rasterizer's rows of the table of extremes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from extreme_cases import Case
from raster_scenes import Scene, ball_scene
from torch import Tensor
from twins import raster as twin

from mgavatar.kernels.rasterize import RasterSettings, rasterize

NEAR = 2.0**-7
"""A near plane that single precision has exactly."""

BAD = 15
"""Where the bad Gaussian sits among the good ones."""

TWIN_CANCELS: dict[str, Any] = {"gradient": 1e-4, "double": (1e-7, 1e-6)}
"""The twin inverts a covariance whose determinant cancels: in float64 it is the twin that is less exact."""

HIDDEN_BACKGROUND: dict[str, Any] = {"floor": 1e-20}
"""What is left of the background is 1e-30 here and 0 in the twin."""

THRESHOLD = float(torch.tensor(1 / 255))


def _ulps(value: float, n: int) -> float:
    """``value`` in single precision and ``n`` steps up."""
    bits = torch.tensor(value).view(torch.int32) + n
    return float(bits.view(torch.float32))


def _scene(n: int = 30, size: tuple[int, int] = (33, 21), sigma: float = 0.15) -> Scene:
    return ball_scene(n, size, seed=31, sigma=sigma).knobs(near=NEAR)


def _op(scene: Scene) -> Callable[..., Tensor]:
    def render(*tensors: Tensor, form: str = "auto") -> Tensor:
        *gaussians, viewmat, background = tensors
        K = scene.K.to(viewmat)
        settings = scene.knobs(form=form).settings
        out = rasterize(*gaussians, viewmat=viewmat, background=background, K=K, size=scene.size, settings=settings)
        return torch.cat([out.image, out.alphas[None], out.depths[None]])

    return render


def _equal(name: str, scene: Scene, change: Callable[..., None] | None = None, **expect: Any) -> Case:
    """A row where everything that is drawn agrees with the twin; ``change`` edits the inputs in place."""

    def inputs(_: torch.Generator) -> tuple[Tensor, ...]:
        tensors = tuple(tensor.clone().double() for tensor in scene.tensors)
        if change is not None:
            change(*tensors)
        return tensors

    def reference(*tensors: Tensor) -> Tensor:
        return twin.rasterize(*tensors, K=scene.K.double(), size=scene.size, settings=scene.settings)

    def mask(*tensors: Tensor) -> Tensor:
        return twin.decided(
            *tensors[:4], tensors[5], K=scene.K.double(), size=scene.size, settings=scene.settings, margin=1e-4
        )

    return Case(kernel="rasterize", name=name, inputs=inputs, op=_op(scene), twin=reference, mask=mask, **expect)


def _culled(name: str, change: Callable[..., None], scene: Scene | None = None) -> Case:
    """A row where one bad Gaussian among good ones is not drawn, changes nothing, and gets a zero gradient."""
    scene = scene or _scene()
    good = [i for i in range(len(scene.means)) if i != BAD]

    def inputs(_: torch.Generator) -> tuple[Tensor, ...]:
        tensors = tuple(tensor.clone().double() for tensor in scene.tensors)
        change(*tensors)
        return tensors

    def without(*tensors: Tensor, form: str = "auto") -> Tensor:
        return _op(scene)(*(tensor[good] for tensor in tensors[:5]), *tensors[5:], form=form)

    return Case(kernel="rasterize", name=name, inputs=inputs, op=_op(scene), twin=without, expect="culled")


def _set(column: int, value: Any) -> Callable[..., None]:
    """Give the bad Gaussian's input ``column`` (means, quats, scales, opacities, colours) a value."""

    def change(*tensors: Tensor) -> None:
        tensors[column][BAD] = torch.as_tensor(value, dtype=torch.float64)

    return change


def _at(depth: float) -> Callable[..., None]:
    """Put the bad Gaussian on the axis of a camera at the origin, as small as suits its depth."""

    def change(means: Tensor, _q: Tensor, scales: Tensor, _o: Tensor, _c: Tensor, viewmat: Tensor, _b: Tensor) -> None:
        viewmat.copy_(torch.eye(4, dtype=torch.float64))
        means[:, 2] += 4.0
        means[BAD] = torch.tensor([0.0, 0.0, depth], dtype=torch.float64)
        scales[BAD] = 0.05 * depth

    return change


def _with(**changes: Any) -> Scene:
    return replace(_scene(), **changes)


def _camera(focal: float, cx: float, cy: float) -> Scene:
    return _with(K=torch.tensor([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]]))


def _behind(means: Tensor, *_: Tensor) -> None:
    means[:, 2] -= 100.0


def _one_point(means: Tensor, *_: Tensor) -> None:
    means.copy_(means[:1].expand_as(means))


def _one_depth(means: Tensor, _q: Tensor, _s: Tensor, _o: Tensor, _c: Tensor, viewmat: Tensor, _b: Tensor) -> None:
    viewmat.copy_(torch.eye(4, dtype=torch.float64))
    means[:, 2] = 4.0


def _covering(_m: Tensor, _q: Tensor, scales: Tensor, *_: Tensor) -> None:
    scales[BAD] = torch.tensor([100.0, 80.0, 60.0], dtype=torch.float64)


def _opaque(_m: Tensor, _q: Tensor, scales: Tensor, opacities: Tensor, *_: Tensor) -> None:
    scales.copy_(torch.tensor([3.0, 2.5, 2.0]).expand_as(scales))
    opacities.fill_(1.0)


def _all(column: int, value: Any) -> Callable[..., None]:
    def change(*tensors: Tensor) -> None:
        tensors[column].copy_(torch.as_tensor(value, dtype=torch.float64).expand_as(tensors[column]))

    return change


def _times(column: int, factor: float) -> Callable[..., None]:
    def change(*tensors: Tensor) -> None:
        tensors[column].mul_(factor)

    return change


def _far_aside(means: Tensor, *_: Tensor) -> None:
    means[BAD, 0] = 1e30


def _too_many(size: tuple[int, int]) -> Case:
    """Every Gaussian in every tile of a huge image."""
    scene = ball_scene(1100, (8, 8), sigma=0.1)
    huge = Scene(**{**scene.__dict__, "size": size, "settings": RasterSettings(alpha_threshold=0.0)})

    def inputs(_: torch.Generator) -> tuple[Tensor, ...]:
        return tuple(tensor.double() for tensor in huge.tensors)

    message = r"\d+ pairs of tile and Gaussian are more than 2147483647: lower the image size"
    name = "more than 2^31 list entries"
    return Case(kernel="rasterize", name=name, inputs=inputs, op=_op(huge), expect="refused", message=message)


def cases() -> list[Case]:
    """All rows."""
    rows = [
        _equal("depth 1 ulp beyond the near plane", _scene(), _at(_ulps(NEAR, 1))),
        _equal("depth 1e6 m", _scene(), _at(1e6)),
        _equal("depth 1e17 m", _scene(), _at(1e17)),
        _culled("depth on the near plane", _at(NEAR)),
        _culled("depth 1 ulp before the near plane", _at(_ulps(NEAR, -1))),
        _culled("depth 1e-6 m", _at(1e-6)),
        _culled("depth 0", _at(0.0)),
        _culled("depth 1e19 m", _at(1e19)),
        _equal("quaternions of length 1e-10", _scene(), _times(1, 1e-10)),
        _equal("quaternions of length 1e10", _scene(), _times(1, 1e10)),
        _culled("quaternion 0", _set(1, [0.0, 0, 0, 0])),
        _culled("quaternion of length 1e-20", _set(1, [1e-20, 0, 0, 0])),
        _culled("quaternion of length 1e20", _set(1, [1e20, 0, 0, 0])),
        _equal("scales 0", _scene(), _all(2, 0.0)),
        _equal("one scale 0", _scene(), _set(2, [0.2, 0.0, 0.1])),
        _equal("scales 1e-12 m", _scene(), _all(2, [1e-12, 2e-12, 3e-12]), double=(1e-12, 1e-5)),
        _equal("scales 1e6 m", _scene(), _set(2, [1e6, 2e6, 3e6])),
        _equal("negative scale", _scene(), _set(2, [-0.2, 0.1, 0.1])),
        _equal("anisotropy 1e6, one long axis", _scene(), _set(2, [0.5, 5e-7, 5e-7])),
        _equal("anisotropy 1e6, one short axis", _scene(), _all(2, [0.3, 0.3, 3e-7])),
        _equal("anisotropy 1e6, all across the image", _scene(), _all(2, [1e3, 1e-3, 1e-3]), **TWIN_CANCELS),
        _culled("scales 0 without low-pass", _set(2, 0.0), _scene().knobs(low_pass=0.0)),
        _equal("smaller than a pixel without low-pass", _scene().knobs(low_pass=0.0), _all(2, [0.01, 0.02, 0.03])),
        _culled("opacity 0", _set(3, 0.0)),
        _culled("opacity negative", _set(3, -0.5)),
        _culled("opacity 1 ulp below the threshold", _set(3, _ulps(THRESHOLD, -1))),
        _equal("opacity at the threshold", _scene(), _set(3, THRESHOLD)),
        _equal("opacity 1 ulp above the threshold", _scene(), _set(3, _ulps(THRESHOLD, 1))),
        _equal("opacity at the cap", _scene(), _set(3, 0.9999)),
        _equal("opacity 1", _scene(), _all(3, 1.0)),
        _equal("opacity 5", _scene(), _all(3, 5.0)),
        _equal("colours 1e6", _scene(), _times(4, 1e6)),
        _equal("colours -1e6", _scene(), _times(4, -1e6)),
        _equal("colours 1e-20", _scene(), _times(4, 1e-20)),
        _culled("colour 1e19", _set(4, 1e19)),
        _equal("all behind the camera", _scene(), _behind),
        _equal("no Gaussian", _scene(0)),
        _equal("one Gaussian", _scene(1, sigma=0.5)),
        _equal("image 1 x 1", _scene(size=(1, 1))),
        _equal("image 1 x 31", _scene(size=(1, 31))),
        _equal("image 31 x 1", _scene(size=(31, 1))),
        _equal("image 13 x 7", _scene(size=(13, 7))),
        _equal("image 131 x 17", _scene(size=(131, 17))),
        _equal("a thousand Gaussians at one point", _scene(1000, (21, 13), sigma=0.05), _one_point),
        _equal("a thousand, opaque, no stop", _scene(1000, (9, 7)).knobs(stop=0.0), _opaque, **HIDDEN_BACKGROUND),
        _equal("equal depths", _scene(), _one_depth),
        _equal("one Gaussian covers the image", _scene(), _covering, gradient=1e-5),
        _equal("every Gaussian covers the image", _scene(), _all(2, [50.0, 40.0, 30.0])),
        _culled("1e30 m aside", _far_aside),
        _equal("no threshold, no stop", _scene().knobs(alpha_threshold=0.0, stop=0.0)),
        _equal("principal point 300 px outside", _camera(25.0, -300.0, 321.0), _all(2, [20.0, 16.0, 12.0])),
        _equal(
            "principal point 3000 px outside", _camera(25.0, 3e3, -3e3), _all(2, [200.0, 150.0, 90.0]), **TWIN_CANCELS
        ),
        _equal("focal length 1e-3 px", _camera(1e-3, 16.0, 10.0)),
        _equal("focal length 1e5 px", _camera(1e5, 16.0, 10.0), _all(2, 0.01)),
        _too_many((131072, 65536)),
    ]
    for column, name in enumerate(("mean", "quaternion", "scale", "opacity", "colour")):
        rows += [_culled(f"{name} {value}", _set(column, value)) for value in (math.nan, math.inf, -math.inf)]
    return rows
