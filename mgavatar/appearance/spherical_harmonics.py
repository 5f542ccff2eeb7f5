"""Real spherical harmonics up to degree 3, the usual colours of Gaussians, which ColorNet replaces."""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_DEGREE = 3

_Y0 = math.sqrt(1.0 / (4.0 * math.pi))
_Y1 = math.sqrt(3.0 / (4.0 * math.pi))
_Y2 = math.sqrt(15.0 / (4.0 * math.pi))
_Y20 = math.sqrt(5.0 / (16.0 * math.pi))
_Y3 = math.sqrt(35.0 / (32.0 * math.pi))
_Y31 = math.sqrt(21.0 / (32.0 * math.pi))
_Y32 = math.sqrt(105.0 / (4.0 * math.pi))
_Y30 = math.sqrt(7.0 / (16.0 * math.pi))


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate Y_lm, in the order and with the signs of 3D Gaussian splatting's files.

    Args:
        directions: Unit directions, shape [N, 3].
        degree: Largest degree, 0 to 3.

    Returns:
        Values, shape [N, (degree + 1)^2].
    """
    x, y, z = directions.unbind(1)
    values = [torch.full_like(x, _Y0)]
    if degree > 0:
        values += [-_Y1 * y, _Y1 * z, -_Y1 * x]
    if degree > 1:
        values += [
            _Y2 * x * y,
            -_Y2 * y * z,
            _Y20 * (3.0 * z * z - 1.0),
            -_Y2 * x * z,
            0.5 * _Y2 * (x * x - y * y),
        ]
    if degree > 2:
        values += [
            -_Y3 * y * (3.0 * x * x - y * y),
            _Y32 * x * y * z,
            -_Y31 * y * (5.0 * z * z - 1.0),
            _Y30 * z * (5.0 * z * z - 3.0),
            -_Y31 * x * (5.0 * z * z - 1.0),
            0.5 * _Y32 * z * (x * x - y * y),
            -_Y3 * x * (x * x - 3.0 * y * y),
        ]
    return torch.stack(values, 1)


def sh_colors(constant: Tensor, others: Tensor, directions: Tensor) -> Tensor:
    """Compute the colours ``0.5 + sum c_lm Y_lm(d)``, clamped at 0 as in 3D Gaussian splatting.

    Args:
        constant: Coefficients of Y_00, shape [N, 3].
        others: Coefficients of degrees 1 to 3, shape [N, K, 3]; K is 0, 3, 8 or 15.
        directions: Unit view directions, shape [N, 3].

    Returns:
        RGB, shape [N, 3].
    """
    degree = math.isqrt(others.shape[1] + 1) - 1
    basis = sh_basis(directions, degree)
    return torch.relu(0.5 + _Y0 * constant + (basis[:, 1:, None] * others).sum(1))
