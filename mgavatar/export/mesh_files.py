"""Meshes as OBJ, PLY and STL files."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mgavatar.export.bake import Mesh
from mgavatar.files import atomic_write, one_line


def write_obj(path: Path, mesh: Mesh, *, comments: Sequence[str] = ()) -> None:
    """Write vertices in their order with colours, texture coordinates with their seams, and faces; atomic.

    trimesh's writer has one texture coordinate per vertex, so it would have to split vertices at the seams: then the
    file would no longer have the vertices of the head model, which shape keys and other tools go by.

    Args:
        path: The file.
        mesh: The mesh.
        comments: Lines for its beginning.

    Raises:
        DataError: If the file cannot be written.
    """
    text = io.StringIO()
    text.writelines(f"# {one_line(comment)}\n" for comment in comments)
    np.savetxt(text, np.concatenate([mesh.verts, mesh.colors], axis=1), "v %.7f %.7f %.7f %.4f %.4f %.4f")
    np.savetxt(text, mesh.vt, "vt %.7f %.7f")
    corners = np.stack([mesh.faces, mesh.ft], axis=2).reshape(-1, 6) + 1
    np.savetxt(text, corners, "f %d/%d %d/%d %d/%d")
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def write_with_trimesh(path: Path, mesh: Mesh, *, comments: Sequence[str] = ()) -> None:
    """Write a ``.ply`` with normals and colours, or an ``.stl``; vertices keep their order in the PLY; atomic.

    Args:
        path: The file, whose suffix says the format.
        mesh: The mesh.
        comments: Ignored: trimesh has no place for them.

    Raises:
        DataError: If the file cannot be written.
    """
    import trimesh

    colors = (255.0 * mesh.colors).round().astype(np.uint8)
    solid = trimesh.Trimesh(
        mesh.verts, mesh.faces, vertex_normals=mesh.normals, vertex_colors=colors, process=False, validate=False
    )
    data = solid.export(file_type=path.suffix.lower().removeprefix("."))
    with atomic_write(path) as file:
        file.write(data)
