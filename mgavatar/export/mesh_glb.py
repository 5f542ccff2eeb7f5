"""Meshes as GLB files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from mgavatar.export.bake import Mesh
from mgavatar.export.glb import TRIANGLES, Glb, as_float32, linear_colors


def write_mesh_glb(path: Path, mesh: Mesh, *, extras: dict[str, Any]) -> None:
    """Write a mesh with normals, colours and texture coordinates; atomic.

    Where the texture has a seam, vertices are split: glTF has one texture coordinate per vertex. Colours are floats,
    because eight bits of linear light are too few for dark hair.

    Args:
        path: The file.
        mesh: The mesh.
        extras: Notes for readers of the file.

    Raises:
        DataError: If the file cannot be written.
    """
    glb = Glb(extras)
    add_mesh(glb, mesh)
    glb.write(path)


def add_mesh(glb: Glb, mesh: Mesh) -> np.ndarray:
    """Add a scene with a node that has the mesh, and return the vertex that each of the file's vertices is."""
    corners, faces = split_at_seams(mesh)
    verts, texture = corners.T
    attributes = {
        "POSITION": glb.add(as_float32(mesh.verts[verts]), bounds=True),
        "NORMAL": glb.add(_unit(mesh.normals[verts])),
        "COLOR_0": glb.add(linear_colors(torch.from_numpy(mesh.colors[verts]))),
        "TEXCOORD_0": glb.add(as_float32(mesh.vt[texture] * [1.0, -1.0] + [0.0, 1.0])),  # glTF's v points down
    }
    primitive = {"mode": TRIANGLES, "attributes": attributes, "indices": glb.add_indices(faces), "material": 0}
    glb.tree |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "avatar", "mesh": 0}],
        "meshes": [{"name": "head", "primitives": [primitive]}],
        "materials": [{"name": "colors", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
    }
    return verts


def split_at_seams(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of vertex and texture coordinate that faces use, and the faces in terms of these pairs.

    Returns:
        Pairs, shape [P, 2], in the order of the vertices, and faces, shape [F, 3].
    """
    pairs = np.stack([mesh.faces.reshape(-1), mesh.ft.reshape(-1)], axis=1)
    corners, index = np.unique(pairs, axis=0, return_inverse=True)
    return corners, index.reshape(-1, 3)


def _unit(normals: np.ndarray) -> np.ndarray:
    """Return unit normals; a vertex without a normal looks to the front."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return as_float32(np.where(length > 1e-6, normals / np.maximum(length, 1e-6), [0.0, 0.0, 1.0]))
