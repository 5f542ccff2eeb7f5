"""Blend shapes, joints and linear blend skinning: the operations that pose a head model.

The adjoints are written by hand: sums over directions, vertices and joints are loops that Warp would not replay. They
add up in a fixed order, with one thread or many. Kernels of blend shapes and joints are in ``blend.py`` and
``joints.py``.
"""

from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels.blend import BlendShapes
from mgavatar.kernels.bridge import launch, launch_ranges
from mgavatar.kernels.joints import JointTransforms
from mgavatar.kernels.precision import Real, by_dtype, pick

_CHUNK = 128  # vertices per item in the gradient of a transform


def _kernels(real: Real) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3
    vec4, mat44 = real.vec4, real.mat44
    mat34 = wp.types.matrix((3, 4), scalar)
    module = f"{__name__}.{real.name}"

    @wp.func
    def blended(v: int, weights: wp.array2d[scalar], transforms: wp.array[mat44]) -> mat44:
        """Blend the joints' transforms by a vertex's weights."""
        total = mat44()
        for j in range(transforms.shape[0]):
            total += weights[v, j] * transforms[j]
        return total

    @wp.kernel(module=module, enable_backward=False)
    def skin_kernel(
        # In:
        first: int,
        verts: wp.array[vec3],  # [V]
        weights: wp.array2d[scalar],  # [V, J]
        transforms: wp.array[mat44],  # [J]
        # Out:
        out: wp.array[vec3],  # [V]
    ) -> None:
        v = first + wp.tid()
        p = verts[v]
        q = blended(v, weights, transforms) @ vec4(p[0], p[1], p[2], scalar(1.0))
        out[v] = vec3(q[0], q[1], q[2])

    @wp.kernel(module=module, enable_backward=False)
    def skin_verts_bwd_kernel(
        # In:
        first: int,
        weights: wp.array2d[scalar],  # [V, J]
        transforms: wp.array[mat44],  # [J]
        grad: wp.array[vec3],  # [V]
        # Out:
        grad_verts: wp.array[vec3],  # [V]
    ) -> None:
        v = first + wp.tid()
        g = grad[v]
        q = wp.transpose(blended(v, weights, transforms)) @ vec4(g[0], g[1], g[2], scalar(0.0))
        grad_verts[v] = vec3(q[0], q[1], q[2])

    @wp.kernel(module=module, enable_backward=False)
    def skin_transforms_bwd_kernel(
        # In:
        first: int,
        verts: wp.array[vec3],  # [V]
        weights: wp.array2d[scalar],  # [V, J]
        grad: wp.array[vec3],  # [V]
        # Out:
        partial: wp.array2d[mat34],  # [J, chunks]
    ) -> None:
        item = first + wp.tid()
        j = item // partial.shape[1]
        chunk = item % partial.shape[1]
        total = mat34()
        for v in range(chunk * wp.static(_CHUNK), wp.min((chunk + 1) * wp.static(_CHUNK), verts.shape[0])):
            p = verts[v]
            total += wp.outer(weights[v, j] * grad[v], vec4(p[0], p[1], p[2], scalar(1.0)))
        partial[j, chunk] = total

    @wp.kernel(module=module, enable_backward=False)
    def sum_transforms_kernel(
        # In:
        partial: wp.array2d[mat34],  # [J, chunks]
        # Out:
        grad_transforms: wp.array3d[scalar],  # [J, 4, 4]
    ) -> None:
        j, r, c = wp.tid()
        total = scalar(0.0)
        if r < 3:
            for chunk in range(partial.shape[1]):
                total += partial[j, chunk][r, c]
        grad_transforms[j, r, c] = total

    return SimpleNamespace(
        skin=skin_kernel,
        verts_bwd=skin_verts_bwd_kernel,
        transforms_bwd=skin_transforms_bwd_kernel,
        sum_transforms=sum_transforms_kernel,
    )


_KERNELS = by_dtype(_kernels)


class _Skin(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, verts: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
        ctx.save_for_backward(verts, weights, transforms)
        out = torch.empty_like(verts, memory_format=torch.contiguous_format)
        if len(verts):
            launch_ranges(
                _KERNELS[verts.dtype].skin, len(verts), (verts, weights, transforms), (out,), ranges_per_thread=1
            )
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        verts, weights, transforms = ctx.saved_tensors
        kernels = _KERNELS[grad.dtype]
        n_verts, n_joints = weights.shape
        grad_verts = torch.zeros_like(verts, memory_format=torch.contiguous_format)
        grad_transforms = torch.zeros_like(transforms, memory_format=torch.contiguous_format)
        if n_verts and ctx.needs_input_grad[0]:
            launch_ranges(kernels.verts_bwd, n_verts, (weights, transforms, grad), (grad_verts,), ranges_per_thread=1)
        if n_verts and ctx.needs_input_grad[2]:
            n_chunks = -(-n_verts // _CHUNK)
            partial = grad.new_empty(n_joints, n_chunks, 3, 4)
            launch_ranges(
                kernels.transforms_bwd, n_joints * n_chunks, (verts, weights, grad), (partial,), ranges_per_thread=1
            )
            launch(kernels.sum_transforms, (n_joints, 4, 4), (partial,), (grad_transforms,))
        return grad_verts, None, grad_transforms


def blend_shapes(v_template: Tensor, dirs: Tensor, coeffs: Tensor) -> Tensor:
    """Add directions to a template: ``v_template + sum_k coeffs[k] dirs[k]``.

    Differentiable in ``v_template`` and ``coeffs``, not in ``dirs``. A direction whose coefficient is exactly zero is
    not read by the forward; its coefficient still gets its gradient.

    Args:
        v_template: Vertices [m], shape [V, 3], float32 or float64.
        dirs: Directions [m per unit], contiguous, shape [K, V, 3].
        coeffs: Coefficients, shape [K].

    Returns:
        Vertices [m], shape [V, 3].

    Raises:
        ValueError: If shapes, dtypes or devices do not agree, or ``dirs`` wants a gradient or is not contiguous.
    """
    if v_template.ndim != 2 or dirs.shape[1:] != v_template.shape or tuple(coeffs.shape) != (len(dirs),):
        raise ValueError(
            f"blend shapes need v_template [V, 3], dirs [K, V, 3] and coeffs [K], got "
            f"{tuple(v_template.shape)}, {tuple(dirs.shape)} and {tuple(coeffs.shape)}"
        )
    if dirs.requires_grad:
        raise ValueError("dirs requires a gradient, but blend_shapes has none for it")
    if not dirs.is_contiguous():  # a copy would cost ten times what the blending does, in both directions
        raise ValueError(f"dirs must be contiguous, but its strides are {dirs.stride()}")
    pick(_KERNELS, v_template=v_template, dirs=dirs, coeffs=coeffs)
    return BlendShapes.apply(v_template, dirs, coeffs)


def skin(verts: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Skin vertices: move each by its joints' transforms, blended with its weights (linear blend skinning).

    Differentiable in ``verts`` and ``transforms``, not in ``weights``. Weights are not normalised: a vertex whose
    weights sum to less than 1 is drawn towards the origin, as the formula says.

    Args:
        verts: Rest vertices [m], shape [V, 3], float32 or float64.
        weights: Skinning weights, shape [V, J].
        transforms: Rest to posed space, last row 0 0 0 1 (its gradient is zero), shape [J, 4, 4].

    Returns:
        Posed vertices [m], shape [V, 3].

    Raises:
        ValueError: If shapes, dtypes or devices do not agree, or ``weights`` wants a gradient.
    """
    n_joints = len(transforms)
    if tuple(verts.shape) != (len(verts), 3) or tuple(weights.shape) != (len(verts), n_joints):
        raise ValueError(
            f"skinning needs verts [V, 3], weights [V, J] and transforms [J, 4, 4], got "
            f"{tuple(verts.shape)}, {tuple(weights.shape)} and {tuple(transforms.shape)}"
        )
    if tuple(transforms.shape[1:]) != (4, 4):
        raise ValueError(f"transforms must have shape [J, 4, 4], got {tuple(transforms.shape)}")
    if weights.requires_grad:
        raise ValueError("weights requires a gradient, but skin has none for it")
    pick(_KERNELS, verts=verts, weights=weights, transforms=transforms)
    return _Skin.apply(verts, weights, transforms)


def joint_transforms(joints: Tensor, poses: Tensor, parents: Tensor) -> tuple[Tensor, Tensor]:
    """Pose a kinematic chain: return each joint's transform of rest-pose points, and the pose correctives' feature.

    Each joint rotates about itself, the root about the root joint. Differentiable in ``joints`` and ``poses``, at any
    angle.

    Args:
        joints: Joints in the rest pose [m], shape [J, 3], float32 or float64.
        poses: Rotation vectors [rad], shape [J, 3].
        parents: Parent of each joint, which must come before it, or -1 for a root, shape [J], integers.

    Returns:
        Transforms from rest to posed space, shape [J, 4, 4], and ``R_j - I`` of joints 1 to J-1, row by row, shape
        [9 (J-1)].

    Raises:
        ValueError: If shapes, dtypes or devices do not agree, or a parent does not come before its child.
    """
    n = len(joints)
    if n == 0 or tuple(joints.shape) != (n, 3) or joints.shape != poses.shape or tuple(parents.shape) != (n,):
        raise ValueError(
            f"a chain needs joints [J, 3], poses [J, 3] and parents [J], got "
            f"{tuple(joints.shape)}, {tuple(poses.shape)} and {tuple(parents.shape)}"
        )
    if any(not -1 <= parent < j for j, parent in enumerate(parents.tolist())):
        raise ValueError(f"parents must be -1 or come before their child, got {parents.tolist()}")
    pick(_KERNELS, joints=joints, poses=poses)
    return JointTransforms.apply(joints, poses, parents.to(joints.device, torch.int32))
