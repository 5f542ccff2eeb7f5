"""Face-bound Gaussians carried to the world in one pass: offsets, activations and Eq. 8, with a hand-written adjoint.

A dozen torch operations would compute the same, but here every number is read and written once.
"""

from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mgavatar.kernels import face_frames
from mgavatar.kernels.bridge import launch_ranges
from mgavatar.kernels.face_frames import gather_matrix
from mgavatar.kernels.precision import Real, by_dtype, pick
from mgavatar.kernels.sparse import SparseMatrix

N_OFFSETS = 13
"""Columns of the offsets: position 3, colour 3, rotation vector 3, log-scale 3, opacity logit 1."""


def _kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, vec4 = real.scalar, real.vec3, real.vec4
    zero, half, one, two = scalar(0.0), scalar(0.5), scalar(1.0), scalar(2.0)
    module = f"{__name__}.{real.name}"
    rotate, product = face_frames.KERNELS[real.dtype].rotate, face_frames.KERNELS[real.dtype].quat_product

    @wp.func
    def conjugate(q: vec4) -> vec4:
        return vec4(q[0], -q[1], -q[2], -q[3])

    @wp.func
    def place(q: vec4, k: scalar, center: vec3, local: vec3) -> vec3:
        """Compute the centre of Eq. 8, ``k R mu + T``."""
        return k * rotate(q, local) + center

    @wp.kernel(module=module, enable_backward=False)
    def bind_kernel(
        # In:
        first: int,
        face_quats: wp.array[vec4],  # [F]
        face_scales: wp.array[scalar],  # [F]
        face_centers: wp.array[vec3],  # [F]
        face_ids: wp.array[wp.int64],  # [N]
        local_means: wp.array[vec3],  # [N]
        local_quats: wp.array[vec4],  # [N]
        local_scales: wp.array[vec3],  # [N]
        offsets: wp.array[scalar],  # [13 N] or empty
        # Out:
        means: wp.array[vec3],  # [N]
        quats: wp.array[vec4],  # [N]
        scales: wp.array[vec3],  # [N]
        colors: wp.array[vec3],  # [N]
    ) -> None:
        n = first + wp.tid()
        f = face_ids[n]
        q = face_quats[f]
        k = face_scales[f]
        move, color, turn = vec3(), vec3(), vec4(one, zero, zero, zero)
        i = 13 * n
        if offsets.shape[0] > 0:
            move = vec3(offsets[i], offsets[i + 1], offsets[i + 2])
            color = vec3(offsets[i + 3], offsets[i + 4], offsets[i + 5])
            turn = vec4(one, half * offsets[i + 6], half * offsets[i + 7], half * offsets[i + 8])
        means[n] = place(q, k, face_centers[f], local_means[n] + move)
        quats[n] = product(q, product(local_quats[n], turn))
        scales[n] = k * local_scales[n]
        colors[n] = color

    @wp.kernel(module=module, enable_backward=False)
    def bind_bwd_kernel(
        # In:
        first: int,
        face_quats: wp.array[vec4],  # [F]
        face_scales: wp.array[scalar],  # [F]
        face_ids: wp.array[wp.int64],  # [N]
        local_means: wp.array[vec3],  # [N]
        local_quats: wp.array[vec4],  # [N]
        local_scales: wp.array[vec3],  # [N]
        opacities: wp.array[scalar],  # [N]
        offsets: wp.array[scalar],  # [13 N] or empty
        v_means: wp.array[vec3],  # [N]
        v_quats: wp.array[vec4],  # [N]
        v_scales: wp.array[vec3],  # [N]
        v_opacities: wp.array[scalar],  # [N]
        v_colors: wp.array[vec3],  # [N]
        # Out:
        v_local_means: wp.array[vec3],  # [N]
        v_local_quats: wp.array[vec4],  # [N]
        v_log_scales: wp.array[vec3],  # [N]
        v_logits: wp.array[scalar],  # [N]
        v_offsets: wp.array[scalar],  # [13 N] or empty
        v_frames: wp.array2d[scalar],  # [N, 8] each Gaussian's share: quaternion, scale, centre; or empty
    ) -> None:
        n = first + wp.tid()
        f = face_ids[n]
        q = face_quats[f]
        k = face_scales[f]
        move, turn = vec3(), vec4(one, zero, zero, zero)
        i = 13 * n
        if offsets.shape[0] > 0:
            move = vec3(offsets[i], offsets[i + 1], offsets[i + 2])
            turn = vec4(one, half * offsets[i + 6], half * offsets[i + 7], half * offsets[i + 8])
        s = local_scales[n]
        o = opacities[n]
        v_mean = k * rotate(conjugate(q), v_means[n])
        v_q = product(conjugate(q), v_quats[n])
        v_turn = product(conjugate(local_quats[n]), v_q)
        v_scale = k * wp.cw_mul(s, v_scales[n])
        v_logit = o * (one - o) * v_opacities[n]
        v_local_means[n] = v_mean
        v_local_quats[n] = product(v_q, conjugate(turn))
        v_log_scales[n] = v_scale
        v_logits[n] = v_logit
        if v_offsets.shape[0] > 0:
            v_color = v_colors[n]
            for c in range(3):
                v_offsets[i + c] = v_mean[c]
                v_offsets[i + 3 + c] = v_color[c]
                v_offsets[i + 6 + c] = half * v_turn[c + 1]
                v_offsets[i + 9 + c] = v_scale[c]
            v_offsets[i + 12] = v_logit
        if v_frames.shape[0] > 0:
            # The mean is k (p + 2 w (a x p) + 2 a x (a x p)) + T for the face's quaternion (w, a): v_w and v_a are
            # its derivatives times g, and v_face adds the path through the Gaussian's own quaternion.
            g = v_means[n]
            p = local_means[n] + move
            a = vec3(q[1], q[2], q[3])
            v_w = two * k * wp.dot(g, wp.cross(a, p))
            v_a = two * k * (q[0] * wp.cross(p, g) + wp.dot(a, p) * g + wp.dot(g, a) * p - two * wp.dot(g, p) * a)
            v_face = product(v_quats[n], conjugate(product(local_quats[n], turn)))
            v_frames[n, 0] = v_face[0] + v_w
            for c in range(3):
                v_frames[n, 1 + c] = v_face[1 + c] + v_a[c]
                v_frames[n, 5 + c] = g[c]
            v_frames[n, 4] = wp.dot(g, rotate(q, p)) + wp.dot(v_scales[n], s)

    @wp.kernel(module=module, enable_backward=False)
    def place_kernel(
        # In:
        first: int,
        face_quats: wp.array[vec4],  # [F]
        face_scales: wp.array[scalar],  # [F]
        face_centers: wp.array[vec3],  # [F]
        face_ids: wp.array[wp.int64],  # [N]
        local_means: wp.array[vec3],  # [N]
        # Out:
        means: wp.array[vec3],  # [N]
    ) -> None:
        n = first + wp.tid()
        f = face_ids[n]
        means[n] = place(face_quats[f], face_scales[f], face_centers[f], local_means[n])

    @wp.kernel(module=module, enable_backward=False)
    def directions_kernel(
        # In:
        first: int,
        means: wp.array[vec3],  # [N]
        position: wp.array[vec3],  # [1]
        face_ids: wp.array[wp.int64],  # [N]
        from_quats: wp.array[vec4],  # [F]
        to_quats: wp.array[vec4],  # [F]
        # Out:
        directions: wp.array[vec3],  # [N]
    ) -> None:
        n = first + wp.tid()
        f = face_ids[n]
        away = means[n] - position[0]
        along = away / wp.max(wp.length(away), scalar(1e-12))
        directions[n] = rotate(to_quats[f], rotate(conjugate(from_quats[f]), along))

    return SimpleNamespace(bind=bind_kernel, bind_bwd=bind_bwd_kernel, place=place_kernel, directions=directions_kernel)


_KERNELS = by_dtype(_kernels)


class _Bind(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, order: SparseMatrix | None, face_ids: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        face_quats, face_scales, face_centers, means, quats, log_scales, logits, offsets = tensors
        n = len(face_ids)
        # Torch computes the exponentials: its loops are vectorised, those of Warp's scalar code are not.
        more = offsets.split([9, 3, 1], dim=1) if len(offsets) else None
        scales = torch.exp(log_scales + more[1] if more else log_scales)
        opacities = torch.sigmoid(logits + more[2][:, 0] if more else logits)
        outputs = tuple(means.new_empty(n, k) for k in (3, 4, 3, 3))
        if n:
            inputs = (face_quats, face_scales, face_centers, face_ids, means, quats, scales, offsets.reshape(-1))
            launch_ranges(_KERNELS[means.dtype].bind, n, inputs, outputs, ranges_per_thread=1)
        ctx.save_for_backward(face_quats, face_scales, face_ids, means, quats, scales, opacities, offsets)
        ctx.order = order
        return *outputs[:3], opacities, outputs[3]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor) -> Any:
        _, face_scales, face_ids, *local, offsets = ctx.saved_tensors
        n = len(face_ids)
        v_local = [torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in local]
        v_offsets = offsets.new_empty(offsets.shape)
        wants_frames = any(ctx.needs_input_grad[2:5])
        shares = offsets.new_empty(n if wants_frames else 0, 8)
        if n:
            outputs = (*v_local, v_offsets.view(-1), shares)
            inputs = (*ctx.saved_tensors[:-1], offsets.reshape(-1), *v_outputs)
            launch_ranges(_KERNELS[offsets.dtype].bind_bwd, n, inputs, outputs, ranges_per_thread=1)
        v_frames: tuple[Tensor | None, ...] = (None, None, None)
        if wants_frames:
            order = gather_matrix(face_ids, len(face_scales)) if ctx.order is None else ctx.order
            v_frames = _by_face(shares, order)
        return None, None, *v_frames, *v_local, v_offsets


def _by_face(shares: Tensor, order: SparseMatrix) -> tuple[Tensor, Tensor, Tensor]:
    """Sum the Gaussians' shares of their faces' quaternions, scales and centres.

    Reading a face's row is a gather, so its adjoint is the transposed gather: each face adds up its own Gaussians in
    ascending order. ``index_put_(accumulate=True)`` would add with atomics and give other bits from run to run.
    """
    sums = order.T.multiply(shares)
    return sums[:, :4].contiguous(), sums[:, 4].contiguous(), sums[:, 5:].contiguous()


def bind_to_faces(
    frames: tuple[Tensor, Tensor, Tensor],
    face_ids: Tensor,
    local_means: Tensor,
    local_quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    *,
    offsets: Tensor | None = None,
    order: SparseMatrix | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Carry Gaussians with their offsets from their faces to the world (Eq. 8 to 10). Differentiable in all floats.

    Eq. 8 is ``k R mu + T`` for the centres, ``q_face q`` for the rotations and ``k s`` for the standard deviations. An
    offset's rotation vector r multiplies the local rotation from the right as the quaternion (1, r / 2).

    Args:
        frames: Unit quaternions wxyz [F, 4], scales k [m] [F] and centres [m] [F, 3] of all faces, float32 or float64.
        face_ids: Face of each Gaussian, shape [N], int64.
        local_means: Centres in units of k, shape [N, 3].
        local_quats: Rotations wxyz in the face's frame, shape [N, 4]; their length is carried through.
        log_scales: Logarithms of standard deviations in units of k, shape [N, 3].
        opacity_logits: Shape [N].
        offsets: Added to the local parameters, columns as in :data:`N_OFFSETS`, shape [N, 13]; nothing by default.
        order: :func:`~mgavatar.kernels.face_frames.gather_matrix` of ``face_ids``, read only by the gradient of
            ``frames``; without it, that gradient prepares it on every call.

    Returns:
        Centres [m] [N, 3], rotations wxyz [N, 4], standard deviations [m] [N, 3], opacities [N], and the offsets'
        colours [N, 3], zero without offsets.

    Raises:
        ValueError: If shapes, dtypes or devices do not agree.
    """
    n = len(face_ids)
    offsets = local_means.new_empty(0, N_OFFSETS) if offsets is None else offsets
    tensors = {
        "face_quats": frames[0], "face_scales": frames[1], "face_centers": frames[2], "local_means": local_means,
        "local_quats": local_quats, "log_scales": log_scales, "opacity_logits": opacity_logits, "offsets": offsets,
    }  # fmt: skip
    n_faces = len(frames[1])
    shapes = ((n_faces, 4), (n_faces,), (n_faces, 3), (n, 3), (n, 4), (n, 3), (n,), (len(offsets) and n, N_OFFSETS))
    for (name, tensor), shape in zip(tensors.items(), shapes, strict=True):
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}; {shape} is needed for {n} Gaussians")
    if order is not None and order.shape != (n, n_faces):
        raise ValueError(f"order has shape {order.shape}; {(n, n_faces)} is needed for {n} Gaussians")
    pick(_KERNELS, **tensors)
    return _Bind.apply(order, face_ids, *tensors.values())


def place_on_faces(frames: tuple[Tensor, Tensor, Tensor], face_ids: Tensor, local_means: Tensor) -> Tensor:
    """Carry centres alone from their faces to the world: ``k R mu + T`` (Eq. 8). No gradient.

    Args:
        frames: As in :func:`bind_to_faces`.
        face_ids: Shape [N], int64.
        local_means: Centres in units of k, shape [N, 3].

    Returns:
        Centres [m], shape [N, 3].
    """
    kernels = pick(_KERNELS, local_means=local_means, face_quats=frames[0])
    out = local_means.new_empty(local_means.shape)
    if len(face_ids):
        launch_ranges(kernels.place, len(face_ids), (*frames, face_ids, local_means), (out,), ranges_per_thread=1)
    return out


def directions_on_faces(
    means: Tensor, position: Tensor, face_ids: Tensor, from_quats: Tensor, to_quats: Tensor
) -> Tensor:
    """Compute directions from a point to Gaussians, and turn them with the Gaussians' faces. No gradient.

    A view direction in the posed mesh becomes one in the canonical mesh: out of the face's frame in the one, into its
    frame in the other.

    Args:
        means: Centres [m], shape [N, 3].
        position: The point [m], shape [3].
        face_ids: Shape [N], int64.
        from_quats: Face frames of the mesh that ``means`` and ``position`` belong to, unit quaternions wxyz, [F, 4].
        to_quats: Face frames of the mesh to turn the directions to, shape [F, 4].

    Returns:
        Unit directions, shape [N, 3].
    """
    kernels = pick(_KERNELS, means=means, position=position, from_quats=from_quats, to_quats=to_quats)
    out = means.new_empty(means.shape)
    if len(face_ids):
        inputs = (means, position[None], face_ids, from_quats, to_quats)
        launch_ranges(kernels.directions, len(face_ids), inputs, (out,), ranges_per_thread=1)
    return out
