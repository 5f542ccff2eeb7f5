"""Kernels in float32 and float64: written once, picked by the dtype of the tensors.

Fits run in float32; the float64 build lets tests check gradients against finite differences. Each build is a Warp
module of its own, so that a program that never asks for float64 does not compile it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import warp as wp
from torch import Tensor

_K = TypeVar("_K")


@dataclass(frozen=True)
class Real:
    """A floating point type and its vectors and matrices, as Warp, C++ snippets and torch call them."""

    name: str
    c_name: str  # not plain float: Warp makes float( a macro
    dtype: torch.dtype
    scalar: Any
    vec3: Any
    vec4: Any
    mat33: Any
    mat44: Any


_FLOAT32 = Real("float32", "wp::float32", torch.float32, wp.float32, wp.vec3f, wp.vec4f, wp.mat33f, wp.mat44f)
_FLOAT64 = Real("float64", "wp::float64", torch.float64, wp.float64, wp.vec3d, wp.vec4d, wp.mat33d, wp.mat44d)


def by_dtype(make: Callable[[Real], _K]) -> Mapping[torch.dtype, _K]:
    """Build a family of kernels for both types, keyed by torch's dtype."""
    return {real.dtype: make(real) for real in (_FLOAT32, _FLOAT64)}


def pick(kernels: Mapping[torch.dtype, _K], **tensors: Tensor) -> _K:
    """Return the build for the dtype of ``tensors``.

    Raises:
        ValueError: If the tensors are not all float32 or all float64, on one device.
    """
    (first_name, first), *others = tensors.items()
    if first.dtype not in kernels:
        raise ValueError(f"{first_name} has dtype {first.dtype}; float32 or float64 is needed")
    for name, tensor in others:
        if tensor.dtype != first.dtype or tensor.device != first.device:
            raise ValueError(
                f"{name} is {tensor.dtype} on {tensor.device} but {first_name} is {first.dtype} on {first.device}"
            )
    return kernels[first.dtype]
