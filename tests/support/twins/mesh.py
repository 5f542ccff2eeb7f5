"""Twins of the mesh kernels: skinning, Laplacian, binding, UV maps and hash features, as their formulas read."""

from __future__ import annotations

import torch
from torch import Tensor


def sparse_apply(rows: Tensor, cols: Tensor, values: Tensor, n_rows: int, x: Tensor) -> Tensor:
    """Sum ``values * x[cols]`` by row."""
    products = values.to(x.dtype).reshape(-1, *[1] * (x.ndim - 1)) * x[cols]
    return x.new_zeros(n_rows, *x.shape[1:]).index_add(0, rows, products)


def laplacian(faces: Tensor, x: Tensor) -> Tensor:
    """Each value minus the mean of its neighbours', vertex after vertex."""
    neighbours: list[set[int]] = [set() for _ in range(len(x))]
    for face in faces.tolist():
        for a in face:
            neighbours[a] |= set(face) - {a}
    rows = [x[i] - x[sorted(near)].mean(0) if near else 0 * x[i] for i, near in enumerate(neighbours)]
    return torch.stack(rows)


def face_normals(verts: Tensor, faces: Tensor) -> Tensor:
    """Cross product of two edges over its length, face after face; zero where it has none."""
    normals = []
    for i, j, k in faces.tolist():
        across = torch.linalg.cross(verts[j] - verts[i], verts[k] - verts[i])
        normals.append(across / across.norm() if across.norm() > 1e-18 else 0 * across)
    return torch.stack(normals)


def vertex_normals(verts: Tensor, faces: Tensor) -> Tensor:
    """Sum of the adjacent faces' normals times their areas, over its length; zero where there is no face."""
    sums = [torch.zeros(3, dtype=verts.dtype) for _ in verts]
    for face in faces.tolist():
        a, b, c = verts[face]
        for i in face:
            sums[i] = sums[i] + torch.linalg.cross(b - a, c - a)
    return torch.stack([s / s.norm() if s.norm() > 1e-18 else s for s in sums])


def vertex_edge_lengths(verts: Tensor, faces: Tensor) -> Tensor:
    """Mean over a vertex's faces of the mean of their three edges; zero where there is no face."""
    lengths: list[list[Tensor]] = [[] for _ in verts]
    for face in faces.tolist():
        a, b, c = verts[face]
        mean = ((b - a).norm() + (c - b).norm() + (a - c).norm()) / 3
        for i in face:
            lengths[i].append(mean)
    return torch.stack([torch.stack(near).mean() if near else verts.new_zeros(()) for near in lengths])


def blend_shapes(v_template: Tensor, dirs: Tensor, coeffs: Tensor) -> Tensor:
    """Template plus weighted directions."""
    return v_template + torch.einsum("k,kvc->vc", coeffs, dirs)


def rotations(poses: Tensor) -> Tensor:
    """Rotation matrices of rotation vectors, by the matrix exponential, shape [J, 3, 3]."""
    x, y, z = poses.unbind(1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    return torch.linalg.matrix_exp(skew)


def joint_transforms(joints: Tensor, poses: Tensor, parents: list[int]) -> tuple[Tensor, Tensor]:
    """The chain as products of 4 x 4 matrices: turn about each joint, parents after children."""
    turns = rotations(poses)
    eye = torch.eye(4, dtype=joints.dtype)
    transforms: list[Tensor] = []
    for j, parent in enumerate(parents):
        place = (turns[j] @ -joints[j] + joints[j])[:, None]
        about = torch.cat([torch.cat([turns[j], place], 1), eye[3:]])
        transforms.append(transforms[parent] @ about if parent >= 0 else about)
    return torch.stack(transforms), (turns[1:] - eye[:3, :3]).reshape(-1)


def skin(verts: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Weighted sum of every joint's image of every vertex."""
    images = torch.einsum("jrc,vc->vjr", transforms[:, :3, :3], verts) + transforms[:, :3, 3]
    return torch.einsum("vj,vjr->vr", weights, images)


def quat_matrix(quats: Tensor) -> Tensor:
    """Matrices of quaternions wxyz, times their squared length, shape [N, 3, 3]."""
    w, x, y, z = quats.unbind(-1)
    rows = [
        w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z,
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


def face_frames(verts: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation matrices, scales and centroids of faces with an area."""
    a, b, c = verts[faces.long()].unbind(1)
    edge = torch.nn.functional.normalize(b - a, dim=1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    third = torch.linalg.cross(edge, normal)
    scales = ((b - a).norm(dim=1) + ((c - a) * third).sum(1).abs()) / 2
    return torch.stack([edge, normal, third], 2), scales, (a + b + c) / 3


def uv_cover(vt: Tensor, ft: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """First face over each texel centre, -1 for none [H, W], and its barycentric weights [H, W, 3]."""
    ids = torch.full((height, width), -1, dtype=torch.int32)
    weights = torch.zeros(height, width, 3, dtype=torch.float64)
    for j in range(height):
        for i in range(width):
            place = torch.tensor([(i + 0.5) / width, 1 - (j + 0.5) / height, 1.0], dtype=torch.float64)
            for f, corners in enumerate(vt.double()[ft.long()]):
                system = torch.cat([corners.T, torch.ones(1, 3, dtype=torch.float64)])
                if abs(float(torch.linalg.det(system))) < 1e-14:
                    continue
                solved = torch.linalg.solve(system, place)
                if float(solved.min()) >= -1e-9:
                    ids[j, i], weights[j, i] = f, solved
                    break
    return ids, weights


def sample_map(maps: Tensor, uv: Tensor) -> Tensor:
    """Torch's own bilinear sampler, with its border mode and v turned downwards."""
    grid = torch.stack([2 * uv[:, 0] - 1, 1 - 2 * uv[:, 1]], 1)[None, None]
    sampled = torch.nn.functional.grid_sample(maps[None], grid, align_corners=False, padding_mode="border")
    return sampled[0, :, 0].T


def hash_encode(points: Tensor, table: Tensor, levels: Tensor) -> Tensor:
    """Interpolate the eight vertices of each level's cell; 64-bit integers and a remainder instead of wrapping."""
    features = []
    for resolution, first, n_entries in levels.tolist():
        x = points.clamp(0, 1) * resolution
        cell = x.detach().floor().clamp(max=resolution - 1)
        part, cell = x - cell, cell.long()
        total = 0
        for corner in range(8):
            bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2])
            a, b, c = (cell + bits).unbind(1)
            side = resolution + 1
            if side**3 <= n_entries:
                entry = a + side * (b + side * c)
            else:
                entry = (a ^ (b * 2654435761 % 2**32) ^ (c * 805459861 % 2**32)) % n_entries
            weight = torch.where(bits.bool(), part, 1 - part).prod(1, keepdim=True)
            total = total + weight * table[first + entry]
        features.append(total)
    return torch.cat(features, 1)


def quat_product(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton product of quaternions wxyz."""
    pw, pv, qw, qv = p[:, :1], p[:, 1:], q[:, :1], q[:, 1:]
    vector = pw * qv + qw * pv + torch.linalg.cross(pv, qv)
    return torch.cat([pw * qw - (pv * qv).sum(1, keepdim=True), vector], 1)


def bind_to_faces(
    face_quats: Tensor,
    face_scales: Tensor,
    face_centers: Tensor,
    face_ids: Tensor,
    local_means: Tensor,
    local_quats: Tensor,
    log_scales: Tensor,
    logits: Tensor,
    offsets: Tensor,
) -> tuple[Tensor, ...]:
    """Offsets, then exponentials, then Eq. 8, one after the other."""
    move, color, turn, larger, more = offsets.split([3, 3, 3, 3, 1], 1)
    small = torch.cat([torch.ones_like(more), turn / 2], 1)
    q, k = face_quats[face_ids], face_scales[face_ids, None]
    means = k * (quat_matrix(q) @ (local_means + move)[:, :, None])[:, :, 0] + face_centers[face_ids]
    quats = quat_product(q, quat_product(local_quats, small))
    return means, quats, k * torch.exp(log_scales + larger), torch.sigmoid(logits + more[:, 0]), color


def mlp(x: Tensor, weights: list[Tensor], biases: list[Tensor]) -> Tensor:
    """Layers with ReLU between them."""
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = torch.clamp(x @ weight.T + bias, min=0.0)
    return x @ weights[-1].T + biases[-1]
