"""GLB files: a JSON chunk that describes arrays, and a binary chunk with them (glTF 2.0)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mgavatar import __version__
from mgavatar.files import atomic_write

POINTS = 0
TRIANGLES = 4

_FLOAT = 5126
_UNSIGNED_INT = 5125
_UNSIGNED_BYTE = 5121
_ARRAY_BUFFER = 34962
_ELEMENT_ARRAY_BUFFER = 34963

_TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class Glb:
    """A glTF document that grows: arrays go into one buffer, everything else into ``tree``.

    Attributes:
        tree: The JSON; its lists are filled by the caller, except for accessors and buffer views.
    """

    def __init__(self, extras: dict[str, Any] | None = None) -> None:
        """Begin a document; ``extras`` are notes for its readers."""
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": f"MGAvatar {__version__}"}}
        if extras:
            self.tree["asset"]["extras"] = extras
        self._data = bytearray()

    def add(self, values: np.ndarray, *, target: int | None = _ARRAY_BUFFER, bounds: bool = False) -> int:
        """Add an array and return the index of its accessor.

        Args:
            values: Float32, uint32 or uint8, shape [n], [n, 2], [n, 3], [n, 4] or [n, 4, 4]; n is at least 1.
            target: Purpose of the array: attributes of vertices by default, None for other data.
            bounds: State the least and the greatest values, as glTF requires for positions.

        Raises:
            ValueError: If glTF has no such array.
        """
        components = {"float32": _FLOAT, "uint32": _UNSIGNED_INT, "uint8": _UNSIGNED_BYTE}
        kind = _TYPES.get(values.shape[1:])
        component = components.get(values.dtype.name)
        if kind is None or component is None or not len(values):
            raise ValueError(f"no accessor for an array of {values.dtype} and shape {values.shape}")
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": values.nbytes}
        if target is not None:
            view["target"] = target
        accessor = {"componentType": component, "count": len(values), "type": kind}
        if bounds:
            rows = values.reshape(len(values), -1)  # a list of one number for scalars too
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._data += values.astype(values.dtype.newbyteorder("<")).tobytes()
        self._data += bytes(-len(self._data) % 4)
        views, accessors = self.tree.setdefault("bufferViews", []), self.tree.setdefault("accessors", [])
        views.append(view)
        accessors.append({"bufferView": len(views) - 1, **accessor})
        return len(accessors) - 1

    def add_indices(self, faces: np.ndarray) -> int:
        """Add the corners of triangles, shape [F, 3], and return the index of their accessor."""
        return self.add(faces.reshape(-1).astype(np.uint32), target=_ELEMENT_ARRAY_BUFFER)

    def write(self, path: Path) -> None:
        """Write the document; atomic.

        Raises:
            DataError: If the file cannot be written.
        """
        if self._data:
            self.tree["buffers"] = [{"byteLength": len(self._data)}]
        text = json.dumps(self.tree, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = [(text, b"JSON")] + ([(bytes(self._data), b"BIN\0")] if self._data else [])
        length = 12 + sum(8 + len(data) for data, _ in chunks)
        with atomic_write(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, length))
            for data, kind in chunks:
                file.write(struct.pack("<I4s", len(data), kind))
                file.write(data)


def linear_colors(colors: Tensor) -> np.ndarray:
    """Decode sRGB in 0..1 to linear light, which glTF wants in ``COLOR_0``; float32, shape [N, C]."""
    import kornia.color

    rgb = colors.clamp(0.0, 1.0).T[:, :, None]
    return np.ascontiguousarray(kornia.color.rgb_to_linear_rgb(rgb)[:, :, 0].T.cpu().numpy(), np.float32)


def as_float32(values: Tensor | np.ndarray) -> np.ndarray:
    """Return values as contiguous float32 on the CPU."""
    array = values.cpu().numpy() if isinstance(values, torch.Tensor) else values
    return np.ascontiguousarray(array, np.float32)
