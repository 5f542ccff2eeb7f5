"""Kernels of the kinematic chain: rotation vectors to transforms, and back.

One thread walks the few joints, in float64: float32 rounds the angle of a rotation vector of 1e4 rad to 6e-4 rad, and
with five joints the launch costs more than the mathematics.
"""

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels.bridge import launch

_F = wp.float64


@wp.func
def _sinc(x: _F) -> _F:
    """Return ``sin(x) / x``, by its series near zero."""
    if wp.abs(x) < _F(1e-4):
        return _F(1.0) - x * x / _F(6.0)
    return wp.sin(x) / x


@wp.func
def _skew(w: wp.vec3d) -> wp.mat33d:
    zero = _F(0.0)
    return wp.mat33d(zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero)


@wp.func
def _rotation_less_identity(w: wp.vec3d) -> wp.mat33d:
    """Return ``R(w) - I = a K + b (w w^T - |w|^2 I)``, a = sin t / t, b = (1 - cos t) / t^2 (Rodrigues).

    Without the identity nothing cancels for small angles. With half = sinc(t / 2), b is half^2 / 2: no 0 / 0 at zero.
    """
    angle = wp.length(w)
    half = _sinc(_F(0.5) * angle)
    b = _F(0.5) * half * half
    return _sinc(angle) * _skew(w) + b * (wp.outer(w, w) - angle * angle * wp.identity(3, dtype=_F))


@wp.func
def _rotation_bwd(w: wp.vec3d, grad: wp.mat33d) -> wp.vec3d:
    """Return the gradient of a rotation vector from that of its matrix.

    ``da = a' / t`` and ``db = b' / t`` lose their digits to cancellation below an angle of 1: there they are Taylor
    series in Horner's form, accurate to float64.
    """
    t2 = wp.dot(w, w)
    angle = wp.sqrt(t2)
    a = _sinc(angle)
    half = _sinc(_F(0.5) * angle)
    b = _F(0.5) * half * half
    if t2 < _F(1.0):
        da = -t2 / _F(93405312000.0) + _F(1.0) / _F(518918400.0)
        da = t2 * (t2 * (t2 * (t2 * da - _F(1.0) / _F(3991680.0)) + _F(1.0) / _F(45360.0)) - _F(1.0) / _F(840.0))
        da = t2 * (da + _F(1.0) / _F(30.0)) - _F(1.0) / _F(3.0)
        db = -t2 / _F(1494484992000.0) + _F(1.0) / _F(7264857600.0)
        db = t2 * (t2 * (t2 * (t2 * db - _F(1.0) / _F(47900160.0)) + _F(1.0) / _F(453600.0)) - _F(1.0) / _F(6720.0))
        db = t2 * (db + _F(1.0) / _F(180.0)) - _F(1.0) / _F(12.0)
    else:
        da = (wp.cos(angle) - a) / t2
        db = (a - _F(2.0) * b) / t2
    spin = wp.vec3d(grad[2, 1] - grad[1, 2], grad[0, 2] - grad[2, 0], grad[1, 0] - grad[0, 1])
    trace = wp.trace(grad)
    grad_a = wp.dot(w, spin)
    grad_b = wp.dot(w, grad @ w) - t2 * trace
    outer = (grad + wp.transpose(grad)) @ w - _F(2.0) * trace * w
    return a * spin + b * outer + (da * grad_a + db * grad_b) * w


@wp.kernel(enable_backward=False)
def _joints_kernel(
    # In:
    joints: wp.array[wp.vec3d],  # [J]
    poses: wp.array[wp.vec3d],  # [J]
    parents: wp.array[int],  # [J]
    # Out:
    transforms: wp.array[wp.mat44d],  # [J]
    feature: wp.array2d[_F],  # [J, 9], R - I of every joint
    rotations: wp.array[wp.mat33d],  # [J], of the joint in posed space
    posed: wp.array[wp.vec3d],  # [J], the joint in posed space
) -> None:
    zero = _F(0.0)
    for j in range(joints.shape[0]):
        less = _rotation_less_identity(poses[j])
        rotation = less + wp.identity(3, dtype=_F)
        place = joints[j]
        if parents[j] >= 0:
            parent = rotations[parents[j]]
            place = parent @ (joints[j] - joints[parents[j]]) + posed[parents[j]]
            rotation = parent @ rotation
        rotations[j] = rotation
        posed[j] = place
        t = place - rotation @ joints[j]
        for r in range(3):
            for c in range(3):
                feature[j, 3 * r + c] = less[r, c]
        x, y, z = rotation[0], rotation[1], rotation[2]
        transforms[j] = wp.mat44d(
            x[0], x[1], x[2], t[0], y[0], y[1], y[2], t[1], z[0], z[1], z[2], t[2], zero, zero, zero, _F(1.0)
        )


@wp.kernel(enable_backward=False)
def _joints_bwd_kernel(
    # In:
    joints: wp.array[wp.vec3d],  # [J]
    poses: wp.array[wp.vec3d],  # [J]
    parents: wp.array[int],  # [J]
    rotations: wp.array[wp.mat33d],  # [J]
    grad_transforms: wp.array[wp.mat44d],  # [J]
    grad_feature: wp.array2d[_F],  # [J, 9]
    # Out:
    grad_joints: wp.array[wp.vec3d],  # [J] zero at first: children add to their parents
    grad_poses: wp.array[wp.vec3d],  # [J]
    grad_rotations: wp.array[wp.mat33d],  # [J] zero at first
    grad_posed: wp.array[wp.vec3d],  # [J] zero at first
) -> None:
    n = joints.shape[0]
    for i in range(n):
        # Children before parents: a joint's gradient is complete once all its descendants have added to it.
        j = n - 1 - i
        g = grad_transforms[j]
        g_t = wp.vec3d(g[0, 3], g[1, 3], g[2, 3])
        g_block = wp.mat33d(g[0, 0], g[0, 1], g[0, 2], g[1, 0], g[1, 1], g[1, 2], g[2, 0], g[2, 1], g[2, 2])
        g_rotation = grad_rotations[j] + g_block - wp.outer(g_t, joints[j])
        g_posed = grad_posed[j] + g_t
        g_joint = grad_joints[j] - wp.transpose(rotations[j]) @ g_t
        g_local = g_rotation
        if parents[j] >= 0:
            p = parents[j]
            parent = rotations[p]
            local = wp.transpose(parent) @ rotations[j]
            reach = wp.transpose(parent) @ g_posed
            grad_rotations[p] = (
                grad_rotations[p] + g_rotation @ wp.transpose(local) + wp.outer(g_posed, joints[j] - joints[p])
            )
            grad_posed[p] = grad_posed[p] + g_posed
            grad_joints[p] = grad_joints[p] - reach
            g_joint += reach
            g_local = wp.transpose(parent) @ g_rotation
        else:
            g_joint += g_posed
        f = grad_feature[j]
        g_local += wp.mat33d(f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8])
        grad_joints[j] = g_joint
        grad_poses[j] = _rotation_bwd(poses[j], g_local)


class JointTransforms(torch.autograd.Function):
    """A node of torch's graph: the kinematic chain. ``lbs.joint_transforms`` checks its inputs."""

    @staticmethod
    def forward(ctx: Any, joints: Tensor, poses: Tensor, parents: Tensor) -> Any:
        """Return transforms [J, 4, 4] and the pose feature [9 (J-1)] of joints [J, 3] and rotation vectors [J, 3]."""
        exact = joints.double().contiguous(), poses.double().contiguous()
        n = len(joints)
        transforms, feature, rotations, posed = (exact[0].new_zeros(n, *s) for s in ((4, 4), (9,), (3, 3), (3,)))
        launch(_joints_kernel, 1, (*exact, parents), (transforms, feature, rotations, posed))
        ctx.save_for_backward(*exact, parents, rotations)
        return transforms.to(joints.dtype), feature[1:].reshape(-1).to(joints.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_transforms: Tensor, grad_feature: Tensor) -> Any:
        """Return the gradients of joints and rotation vectors, each [J, 3]."""
        joints, poses, parents, rotations = ctx.saved_tensors
        n = len(joints)
        grad_features = joints.new_zeros(n, 9)
        grad_features[1:] = grad_feature.reshape(n - 1, 9)
        sums = tuple(joints.new_zeros(n, *s) for s in ((3,), (3,), (3, 3), (3,)))
        inputs = (joints, poses, parents, rotations, grad_transforms.double(), grad_features)
        launch(_joints_bwd_kernel, 1, inputs, sums)
        return sums[0].to(grad_transforms.dtype), sums[1].to(grad_transforms.dtype), None
