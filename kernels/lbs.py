"""Blend shapes, joints and linear blend skinning, each with its own adjoint.

The adjoints are written by hand: sums over directions, vertices and joints are loops that Warp would not replay. All
of them add up in a fixed order, by one thread or many.
"""

from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels.bridge import launch, launch_ranges
from mgavatar.kernels.precision import Real, by_dtype, pick

_BLOCK = 2048  # numbers that one CPU item adds up, so that they stay in the first-level cache
_LANES = 64  # partial sums of a dot product, the same on a CPU (vector lanes) and on CUDA (threads)
_CHUNK = 128  # vertices whose share of a transform's gradient one item adds up

# Four directions a pass: a sum is loaded and stored once for four products. Directions whose coefficient is exactly
# zero are not read.
_BLEND_SNIPPET = """
    const long long n = out.shape[0];
    const int n_dirs = coeffs.shape[0];
    const long long begin = (long long)item * width;
    const long long count = (begin + width < n ? begin + width : n) - begin;
    const REAL* base = start.data + begin;
    REAL* __restrict__ sums = out.data + begin;
    for (long long i = 0; i < count; ++i)
        sums[i] = base[i];
    const REAL* d[4];
    REAL c[4];
    int filled = 0;
    for (int k = 0; k < n_dirs; ++k) {
        if (coeffs.data[k] != REAL(0)) {
            c[filled] = coeffs.data[k];
            d[filled] = dirs.data + k * n + begin;
            ++filled;
        }
        if (filled == 4) {
            const REAL c0 = c[0], c1 = c[1], c2 = c[2], c3 = c[3];
            const REAL *__restrict__ d0 = d[0], *__restrict__ d1 = d[1];
            const REAL *__restrict__ d2 = d[2], *__restrict__ d3 = d[3];
            for (long long i = 0; i < count; ++i)
                sums[i] += (c0 * d0[i] + c1 * d1[i]) + (c2 * d2[i] + c3 * d3[i]);
            filled = 0;
        }
    }
    for (int j = 0; j < filled; ++j)
        for (long long i = 0; i < count; ++i)
            sums[i] += c[j] * d[j][i];
"""

# Lane l of direction k adds up elements l, l + 64, ...: neighbouring lanes read neighbouring numbers on both devices.
_DOT_SNIPPET = """
    const long long n = grad.shape[0];
    const REAL* d = dirs.data + (long long)k * n;
    const REAL* g = grad.data;
    REAL* sums = partial.data + (long long)k * LANES;
    if (width == 1) {
        REAL sum = 0;
        for (long long i = lane; i < n; i += LANES)
            sum += d[i] * g[i];
        sums[lane] = sum;
        return;
    }
    REAL lanes[LANES];
    for (int l = 0; l < LANES; ++l)
        lanes[l] = 0;
    const long long whole = n - n % LANES;
    for (long long i = 0; i < whole; i += LANES)
        for (int l = 0; l < LANES; ++l)
            lanes[l] += d[i + l] * g[i + l];
    for (long long i = whole; i < n; ++i)
        lanes[i - whole] += d[i] * g[i];
    for (int l = 0; l < LANES; ++l)
        sums[l] = lanes[l];
"""


def _blend_kernels(real: Real, module: str) -> SimpleNamespace:
    scalar = real.scalar

    def native(snippet: str) -> Any:
        return wp.func_native(snippet.replace("REAL", real.c_name).replace("LANES", str(_LANES)))

    @native(_BLEND_SNIPPET)
    def add_directions(
        item: int,
        width: int,
        dirs: wp.array2d(dtype=scalar),
        coeffs: wp.array(dtype=scalar),
        start: wp.array(dtype=scalar),
        out: wp.array(dtype=scalar),
    ) -> None: ...

    @native(_DOT_SNIPPET)
    def dot_direction(
        k: int,
        lane: int,
        width: int,
        dirs: wp.array2d(dtype=scalar),
        grad: wp.array(dtype=scalar),
        partial: wp.array2d(dtype=scalar),
    ) -> None: ...

    @wp.kernel(module=module, enable_backward=False)
    def blend_kernel(
        first: int,
        # In:
        width: int,  # numbers an item owns
        dirs: wp.array2d(dtype=scalar),  # [K, 3V]
        coeffs: wp.array(dtype=scalar),  # [K]
        start: wp.array(dtype=scalar),  # [3V]
        # Out:
        out: wp.array(dtype=scalar),  # [3V]
    ) -> None:
        add_directions(first + wp.tid(), width, dirs, coeffs, start, out)

    @wp.kernel(module=module, enable_backward=False)
    def blend_bwd_kernel(
        first: int,
        # In:
        width: int,  # lanes an item owns, 1 or all
        dirs: wp.array2d(dtype=scalar),  # [K, 3V]
        grad: wp.array(dtype=scalar),  # [3V]
        # Out:
        partial: wp.array2d(dtype=scalar),  # [K, lanes]
    ) -> None:
        begin = (first + wp.tid()) * width
        dot_direction(begin // wp.static(_LANES), begin % wp.static(_LANES), width, dirs, grad, partial)

    @wp.kernel(module=module, enable_backward=False)
    def sum_kernel(
        # In:
        partial: wp.array2d(dtype=scalar),  # [M, N]
        # Out:
        out: wp.array(dtype=scalar),  # [M]
    ) -> None:
        m = wp.tid()
        total = scalar(0.0)
        for n in range(partial.shape[1]):
            total += partial[m, n]
        out[m] = total

    return SimpleNamespace(blend=blend_kernel, blend_bwd=blend_bwd_kernel, sum=sum_kernel)


def _skin_kernels(real: Real, module: str) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3
    vec4, mat44 = real.vec4, real.mat44
    mat34 = wp.types.matrix((3, 4), scalar)

    @wp.func
    def blended(v: int, weights: wp.array2d(dtype=scalar), transforms: wp.array(dtype=mat44)) -> mat44:
        """The transform of a vertex: its joints' transforms by their weights."""
        total = mat44()
        for j in range(transforms.shape[0]):
            total += weights[v, j] * transforms[j]
        return total

    @wp.kernel(module=module, enable_backward=False)
    def skin_kernel(
        first: int,
        # In:
        verts: wp.array(dtype=vec3),  # [V]
        weights: wp.array2d(dtype=scalar),  # [V, J]
        transforms: wp.array(dtype=mat44),  # [J]
        # Out:
        out: wp.array(dtype=vec3),  # [V]
    ) -> None:
        v = first + wp.tid()
        p = verts[v]
        q = blended(v, weights, transforms) @ vec4(p[0], p[1], p[2], scalar(1.0))
        out[v] = vec3(q[0], q[1], q[2])

    @wp.kernel(module=module, enable_backward=False)
    def skin_verts_bwd_kernel(
        first: int,
        # In:
        weights: wp.array2d(dtype=scalar),  # [V, J]
        transforms: wp.array(dtype=mat44),  # [J]
        grad: wp.array(dtype=vec3),  # [V]
        # Out:
        grad_verts: wp.array(dtype=vec3),  # [V]
    ) -> None:
        v = first + wp.tid()
        g = grad[v]
        q = wp.transpose(blended(v, weights, transforms)) @ vec4(g[0], g[1], g[2], scalar(0.0))
        grad_verts[v] = vec3(q[0], q[1], q[2])

    @wp.kernel(module=module, enable_backward=False)
    def skin_transforms_bwd_kernel(
        first: int,
        # In:
        verts: wp.array(dtype=vec3),  # [V]
        weights: wp.array2d(dtype=scalar),  # [V, J]
        grad: wp.array(dtype=vec3),  # [V]
        # Out:
        partial: wp.array2d(dtype=mat34),  # [J, chunks]
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
        partial: wp.array2d(dtype=mat34),  # [J, chunks]
        # Out:
        grad_transforms: wp.array3d(dtype=scalar),  # [J, 4, 4]
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


_BLEND = by_dtype(lambda real: _blend_kernels(real, f"{__name__}.blend.{real.name}"))
_SKIN = by_dtype(lambda real: _skin_kernels(real, f"{__name__}.skin.{real.name}"))


class _BlendShapes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, start: Tensor, dirs: Tensor, coeffs: Tensor) -> Tensor:
        ctx.save_for_backward(dirs)
        out = torch.empty_like(start, memory_format=torch.contiguous_format)
        width = 1 if start.is_cuda else _BLOCK
        n_items = -(-start.numel() // width)
        if n_items:
            inputs = (width, dirs.reshape(len(dirs), start.numel()), coeffs, start.reshape(-1))
            launch_ranges(_BLEND[start.dtype].blend, n_items, inputs, (out.view(-1),))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        (dirs,) = ctx.saved_tensors
        if not ctx.needs_input_grad[2]:
            return grad, None, None
        kernels = _BLEND[grad.dtype]
        n_dirs = len(dirs)
        partial = grad.new_zeros(n_dirs, _LANES)
        grad_coeffs = grad.new_zeros(n_dirs)
        width = 1 if grad.is_cuda else _LANES
        if dirs.numel():
            inputs = (width, dirs.reshape(n_dirs, -1), grad.reshape(-1))
            launch_ranges(kernels.blend_bwd, n_dirs * _LANES // width, inputs, (partial,))
            launch(kernels.sum, n_dirs, (partial,), (grad_coeffs,))
        return grad, None, grad_coeffs


class _Skin(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, verts: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
        ctx.save_for_backward(verts, weights, transforms)
        out = torch.empty_like(verts, memory_format=torch.contiguous_format)
        if len(verts):
            launch_ranges(_SKIN[verts.dtype].skin, len(verts), (verts, weights, transforms), (out,))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        verts, weights, transforms = ctx.saved_tensors
        kernels = _SKIN[grad.dtype]
        n_verts, n_joints = weights.shape
        grad_verts = torch.zeros_like(verts, memory_format=torch.contiguous_format)
        grad_transforms = torch.zeros_like(transforms, memory_format=torch.contiguous_format)
        if n_verts and ctx.needs_input_grad[0]:
            launch_ranges(kernels.verts_bwd, n_verts, (weights, transforms, grad), (grad_verts,))
        if n_verts and ctx.needs_input_grad[2]:
            n_chunks = -(-n_verts // _CHUNK)
            partial = grad.new_empty(n_joints, n_chunks, 3, 4)
            launch_ranges(kernels.transforms_bwd, n_joints * n_chunks, (verts, weights, grad), (partial,))
            launch(kernels.sum_transforms, (n_joints, 4, 4), (partial,), (grad_transforms,))
        return grad_verts, None, grad_transforms


def blend_shapes(v_template: Tensor, dirs: Tensor, coeffs: Tensor) -> Tensor:
    """Add directions to a template: ``v_template + sum_k coeffs[k] dirs[k]``.

    Differentiable in ``v_template`` and ``coeffs``, not in ``dirs``. A direction whose coefficient is exactly zero is
    not read by the forward; its coefficient still gets its gradient.

    Args:
        v_template: Vertices [m], shape [V, 3], float32 or float64.
        dirs: Directions [m per unit], each contiguous, shape [K, V, 3].
        coeffs: Coefficients, shape [K].

    Returns:
        Vertices [m], shape [V, 3].

    Raises:
        ValueError: If shapes, dtypes or devices do not agree, or ``dirs`` wants a gradient.
    """
    if v_template.ndim != 2 or dirs.shape[1:] != v_template.shape or tuple(coeffs.shape) != (len(dirs),):
        raise ValueError(
            f"blend shapes need v_template [V, 3], dirs [K, V, 3] and coeffs [K], got "
            f"{tuple(v_template.shape)}, {tuple(dirs.shape)} and {tuple(coeffs.shape)}"
        )
    if dirs.requires_grad:
        raise ValueError("dirs requires a gradient, but blend_shapes has none for it")
    pick(_BLEND, v_template=v_template, dirs=dirs, coeffs=coeffs)
    return _BlendShapes.apply(v_template, dirs, coeffs)


def skin(verts: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Linear blend skinning: each vertex moves by its joints' transforms, by their weights.

    Differentiable in ``verts`` and ``transforms``, not in ``weights``. Weights are used as they are: a vertex whose
    weights do not sum to 1 is drawn towards or away from the origin, as the formula says.

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
    pick(_SKIN, verts=verts, weights=weights, transforms=transforms)
    return _Skin.apply(verts, weights, transforms)


# One thread walks the few joints, in float64: a float32 angle of 1e4 rad is only good to 6e-4 rad once its length has
# been rounded, and the cost is that of a launch either way.
_F = wp.float64


@wp.func
def _sinc(x: _F) -> _F:
    """``sin(x) / x``."""
    if wp.abs(x) < _F(1e-4):
        return _F(1.0) - x * x / _F(6.0)
    return wp.sin(x) / x


@wp.func
def _skew(w: wp.vec3d) -> wp.mat33d:
    zero = _F(0.0)
    return wp.mat33d(zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero)


@wp.func
def _rotation_less_identity(w: wp.vec3d) -> wp.mat33d:
    """``R(w) - I = a K + b (w w^T - |w|^2 I)`` with ``a = sin t / t`` and ``b = (1 - cos t) / t^2`` (Rodrigues)."""
    angle = wp.length(w)
    half = _sinc(_F(0.5) * angle)
    b = _F(0.5) * half * half
    return _sinc(angle) * _skew(w) + b * (wp.outer(w, w) - angle * angle * wp.identity(3, dtype=_F))


@wp.func
def _rotation_bwd(w: wp.vec3d, grad: wp.mat33d) -> wp.vec3d:
    """Gradient of the rotation vector from that of its matrix.

    ``a' / t`` and ``b' / t`` lose their digits where their terms cancel, below an angle of 1: there they are series.
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


@wp.kernel(module=f"{__name__}.joints", enable_backward=False)
def _joints_kernel(
    # In:
    joints: wp.array(dtype=wp.vec3d),  # [J]
    poses: wp.array(dtype=wp.vec3d),  # [J]
    parents: wp.array(dtype=int),  # [J]
    # Out:
    transforms: wp.array(dtype=wp.mat44d),  # [J]
    feature: wp.array2d(dtype=_F),  # [J, 9], R - I of every joint
    rotations: wp.array(dtype=wp.mat33d),  # [J], of the joint in posed space
    posed: wp.array(dtype=wp.vec3d),  # [J], the joint in posed space
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


@wp.kernel(module=f"{__name__}.joints", enable_backward=False)
def _joints_bwd_kernel(
    # In:
    joints: wp.array(dtype=wp.vec3d),  # [J]
    poses: wp.array(dtype=wp.vec3d),  # [J]
    parents: wp.array(dtype=int),  # [J]
    rotations: wp.array(dtype=wp.mat33d),  # [J]
    grad_transforms: wp.array(dtype=wp.mat44d),  # [J]
    grad_feature: wp.array2d(dtype=_F),  # [J, 9]
    # Out, sums that start at zero:
    grad_joints: wp.array(dtype=wp.vec3d),  # [J]
    grad_poses: wp.array(dtype=wp.vec3d),  # [J]
    grad_rotations: wp.array(dtype=wp.mat33d),  # [J]
    grad_posed: wp.array(dtype=wp.vec3d),  # [J]
) -> None:
    n = joints.shape[0]
    for i in range(n):
        j = n - 1 - i  # children before parents
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


class _JointTransforms(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, joints: Tensor, poses: Tensor, parents: Tensor) -> Any:
        exact = joints.double().contiguous(), poses.double().contiguous()
        n = len(joints)
        transforms, feature, rotations, posed = (exact[0].new_zeros(n, *s) for s in ((4, 4), (9,), (3, 3), (3,)))
        launch(_joints_kernel, 1, (*exact, parents), (transforms, feature, rotations, posed))
        ctx.save_for_backward(*exact, parents, rotations)
        return transforms.to(joints.dtype), feature[1:].reshape(-1).to(joints.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_transforms: Tensor, grad_feature: Tensor) -> Any:
        joints, poses, parents, rotations = ctx.saved_tensors
        n = len(joints)
        grad_features = joints.new_zeros(n, 9)
        grad_features[1:] = grad_feature.reshape(n - 1, 9)
        sums = tuple(joints.new_zeros(n, *s) for s in ((3,), (3,), (3, 3), (3,)))
        inputs = (joints, poses, parents, rotations, grad_transforms.double(), grad_features)
        launch(_joints_bwd_kernel, 1, inputs, sums)
        return sums[0].to(grad_transforms.dtype), sums[1].to(grad_transforms.dtype), None


def joint_transforms(joints: Tensor, poses: Tensor, parents: Tensor) -> tuple[Tensor, Tensor]:
    """Pose a kinematic chain: what carries rest-pose points with each joint, and the pose correctives' feature.

    Each joint rotates about itself, the root about the root joint. Differentiable in ``joints`` and ``poses``, at any
    angle.

    Args:
        joints: Joints in the rest pose [m], shape [J, 3], float32 or float64.
        poses: Rotation vectors [rad], shape [J, 3].
        parents: Parent of each joint, before it in the list, -1 for a root, shape [J], integers.

    Returns:
        Rest to posed space, shape [J, 4, 4], and the row-major ``R_j - I`` of joints 1 to J-1, shape [9 (J-1)].

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
    pick(_SKIN, joints=joints, poses=poses)
    return _JointTransforms.apply(joints, poses, parents.to(joints.device, torch.int32))
