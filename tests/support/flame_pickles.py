"""Pickles like FLAME's, made without FLAME: stand-ins for chumpy's classes, and a pickler that writes like Python 2."""

from __future__ import annotations

import io
import pickle
import struct
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import scipy.sparse

from mgavatar.head.model import HeadModel


class Ch:
    """What a pickle keeps of ``chumpy.ch.Ch``."""

    def __init__(self, x: np.ndarray) -> None:
        self.x, self._dirty_vars, self._itr = x, {"x"}, None


class Select:
    """What a pickle keeps of ``chumpy.reordering.Select``."""

    def __init__(self, a: object, idxs: np.ndarray, preferred_shape: tuple[int, ...]) -> None:
        self.a, self.idxs, self.preferred_shape = a, idxs, preferred_shape


Ch.__module__, Select.__module__ = "chumpy.ch", "chumpy.reordering"


@contextmanager
def chumpy_importable() -> Iterator[None]:
    """Let the pickler find the stand-ins under chumpy's names."""
    names = {"chumpy": {}, "chumpy.ch": {"Ch": Ch}, "chumpy.reordering": {"Select": Select}}
    for name, members in names.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(members)
    try:
        yield
    finally:
        for name in names:
            del sys.modules[name]


class Python2Pickler(pickle._Pickler):
    """Writes bytes and text as the ``str`` of Python 2, which is what FLAME's own files hold."""

    dispatch: ClassVar[dict[type, Any]] = dict(pickle._Pickler.dispatch)

    def save_py2_str(self, obj: str | bytes) -> None:
        data = obj.encode("latin1") if isinstance(obj, str) else obj
        self.write(pickle.BINSTRING + struct.pack("<i", len(data)) + data)
        self.memoize(obj)


Python2Pickler.dispatch[bytes] = Python2Pickler.dispatch[str] = Python2Pickler.save_py2_str


def dump(content: object, *, protocol: int | str = 2, old_modules: bool = False) -> bytes:
    """Pickle; ``protocol="python2"`` as Python 2 did, ``old_modules`` with the module names of old numpy and scipy."""
    stream = io.BytesIO()
    with chumpy_importable():
        if protocol == "python2":
            Python2Pickler(stream, protocol=2).dump(content)
        else:
            pickle.Pickler(stream, protocol=int(protocol)).dump(content)
    data = stream.getvalue()
    if old_modules:  # names of GLOBAL opcodes, ended by a line feed: their length is free
        data = data.replace(b"numpy._core", b"numpy.core").replace(b"scipy.sparse._csc", b"scipy.sparse.csc")
    return data


def flame_content(head: HeadModel) -> dict[str, object]:
    """A head in the keys, types and wrappings of FLAME's pickles."""
    n_verts, n_dirs = len(head.v_template), head.shapedirs.shape[2]
    shapedirs = head.shapedirs.astype(np.float64)
    every = np.arange(shapedirs.size)
    parents = head.parents.astype(np.int64)
    parents[0] = 2**32 - 1
    return {
        "v_template": Ch(head.v_template.astype(np.float64)),
        "f": head.faces.astype(np.uint32),
        "shapedirs": Select(Ch(shapedirs.reshape(-1)), every, (n_verts, 3, n_dirs)),
        "posedirs": np.asfortranarray(head.posedirs.astype(np.float64)),
        "J_regressor": scipy.sparse.csc_matrix(head.J_regressor.astype(np.float64)),
        "J": (head.J_regressor @ head.v_template).astype(np.float64),
        "weights": head.lbs_weights.astype(np.float64),
        "kintree_table": np.stack([parents, np.arange(5)]).astype(np.uint32),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
        "n_verts": np.float64(n_verts),
        "names": [("a", 1), {"b": {2, 3}}],
    }
