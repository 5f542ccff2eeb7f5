"""FLAME's pickles, read without chumpy and without running code that a pickle names.

A pickle is a program that may call any Python function. Here, each name that it may use stands for an inert record of
its arguments, and arrays are built afterwards from checked bytes. The unpickling code of numpy and scipy never sees the
file either: a forged type could make it read or write any memory.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np

from mgavatar.errors import DataError
from mgavatar.files import GIBIBYTE, existing_file, foreign_content, one_line, read_bytes

MAX_DEPTH = 6
"""Largest depth of arrays in arrays (chumpy objects in chumpy objects); FLAME's files need 3."""
MAX_DENSE = 50_000_000
"""Largest number of elements of a sparse matrix after it has been made dense."""
ARCHIVES = {b"PK\x03\x04": "zip", b"\x1f\x8b": "gzip", b"7z\xbc\xaf": "7z", b"Rar!": "rar"}
"""Archives that FLAME's files are handed on in, by their first bytes."""
MAX_PICKLE_BYTES = 64 << 20
"""Largest pickle of one frame."""
PLAIN_TYPES = ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")


class _Record:
    """An inert stand-in for an object of a pickle: it keeps its arguments and its state."""

    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any) -> _Record:
        record = object.__new__(cls)
        record.args = args
        record.state = None
        return record

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Record):
    """``numpy.ndarray``, by its name or made by ``_reconstruct``."""


class _FromBuffer(_Record):
    """An array of pickle protocol 5."""


class _Scalar(_Record):
    """A numpy number."""


class _Dtype(_Record):
    """``numpy.dtype``."""


class _Encoded(_Record):
    """Bytes in the form of protocols 0 to 2 of Python 3."""


class _Sparse(_Record):
    """``scipy.sparse.csc_matrix``."""


class _Chumpy(_Record):
    """``chumpy.ch.Ch``: an array named ``x``."""


class _Select(_Record):
    """``chumpy.reordering.Select``: elements ``idxs`` of ``a``."""


class _Other(_Record):
    """``set`` and ``object``, which FLAME's files contain beside the arrays."""


class _Reconstructor(_Record):
    """``copyreg._reconstructor(cls, base, state)``, with which protocols 0 and 1 make an empty ``cls``."""

    def __new__(cls, *args: Any) -> Any:
        target = args[0] if args else None
        if not (isinstance(target, type) and issubclass(target, _Record)):
            raise pickle.UnpicklingError("copyreg._reconstructor is given something that is no class")
        return _Record.__new__(target)


_ALLOWED: dict[tuple[str, str], type[_Record]] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("numpy.core.multiarray", "_reconstruct"): _Array,
    ("numpy._core.multiarray", "_reconstruct"): _Array,
    ("numpy.core.multiarray", "scalar"): _Scalar,
    ("numpy._core.multiarray", "scalar"): _Scalar,
    ("numpy.core.numeric", "_frombuffer"): _FromBuffer,
    ("numpy._core.numeric", "_frombuffer"): _FromBuffer,
    ("scipy.sparse.csc", "csc_matrix"): _Sparse,
    ("scipy.sparse._csc", "csc_matrix"): _Sparse,
    ("chumpy.ch", "Ch"): _Chumpy,
    ("chumpy.reordering", "Select"): _Select,
    ("__builtin__", "set"): _Other,
    ("builtins", "set"): _Other,
    ("__builtin__", "object"): _Other,
    ("builtins", "object"): _Other,
    ("copy_reg", "_reconstructor"): _Reconstructor,
    ("copyreg", "_reconstructor"): _Reconstructor,
    ("_codecs", "encode"): _Encoded,
}


class _RefusedError(Exception):
    """A name in the pickle that is not allowed."""


class _InertUnpickler(pickle._Unpickler):
    """Python's unpickler written in Python.

    The one in C allocates 8 bytes times the largest memo index in the file, which may be any number.
    """

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)

    def find_class(self, module: str, name: str) -> type[_Record]:
        if (module, name) not in _ALLOWED:
            raise _RefusedError(f"{module}.{name}")
        return _ALLOWED[(module, name)]

    def get_extension(self, code: int) -> NoReturn:
        raise _RefusedError(f"extension code {code}")


def _load_bytearray(unpickler: Any) -> None:
    """Read a bytearray without first allocating the length that the file claims."""
    length = int.from_bytes(unpickler.read(8), "little")
    unpickler.append(bytearray(unpickler.read(length)))


def _with_plain_keys(opcode: bytes, keys: Callable[[list[Any]], list[Any]]) -> None:
    """Let ``opcode`` hash only text and numbers: hashing a tuple nested a million deep overflows the C stack."""
    original = pickle._Unpickler.dispatch[opcode[0]]

    def load(unpickler: Any) -> None:
        if not all(isinstance(key, str | bytes | int | float | None) for key in keys(unpickler.stack)):
            raise pickle.UnpicklingError("a dictionary or set has a key that is neither text nor a number")
        original(unpickler)

    _InertUnpickler.dispatch[opcode[0]] = load


_InertUnpickler.dispatch[pickle.BYTEARRAY8[0]] = _load_bytearray
_with_plain_keys(pickle.SETITEM, lambda stack: stack[-2:-1])
_with_plain_keys(pickle.SETITEMS, lambda stack: stack[::2])
_with_plain_keys(pickle.DICT, lambda stack: stack[::2])
_with_plain_keys(pickle.ADDITEMS, lambda stack: stack)
_with_plain_keys(pickle.FROZENSET, lambda stack: stack)


def read_flame_pickle(path: Path, *, keys: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Read the arrays of a pickled dictionary, the form of FLAME's model and mask files.

    Pickles may be those of Python 2 and of protocols 0 to 5. Arrays may be numpy's, ``chumpy.ch.Ch``,
    ``chumpy.reordering.Select``, ``scipy.sparse.csc_matrix`` (returned dense) and flat lists of integers.

    Args:
        path: The ``.pkl`` file.
        keys: Entries to return if they are present; None returns every array.

    Returns:
        Arrays of plain numbers by their keys.

    Raises:
        DataError: If the file is not such a pickle, is damaged, or names anything else.
    """
    data = read_bytes(path, max_bytes=GIBIBYTE)
    try:
        content = _InertUnpickler(io.BytesIO(data), encoding="latin1").load()
    except _RefusedError as error:
        raise DataError(
            f"{path}: refused, because it asks for {one_line(error)}, which no FLAME file needs; "
            "take the file from FLAME's own download, or save its arrays as .npz"
        ) from error
    except Exception as error:  # a damaged pickle can raise anything
        raise DataError(f"{path}: not a readable pickle ({_what_it_is(path, data, error)})") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds a {one_line(type(content).__name__)}, FLAME's files hold a dictionary")
    return _arrays_of(content, path=path, keys=keys)


def read_pickled_arrays(data: bytes, *, path: Path) -> dict[str, Any]:
    """Read a pickled dictionary of arrays, numbers, text and further dictionaries, as trackers save their frames.

    Args:
        data: The pickle.
        path: File that the messages name.

    Returns:
        The dictionary; keys are text, and what is neither an array, a number, text nor a dictionary is left out.

    Raises:
        DataError: If it is no such pickle, is damaged, or names anything but numpy's arrays.
    """
    try:
        content = _InertUnpickler(io.BytesIO(data), encoding="latin1").load()
    except _RefusedError as error:
        raise DataError(
            f"{path}: refused, because it asks for {one_line(error)}; only numpy's arrays are read"
        ) from error
    except Exception as error:  # a damaged pickle can raise anything
        raise DataError(f"{path}: not a readable pickle ({one_line(error) or type(error).__name__})") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds a {one_line(type(content).__name__)}, a dictionary is needed")
    return _tree(content, path=path, depth=0)


def read_torch_archive(path: Path) -> dict[str, Any]:
    """Read a dictionary of numpy arrays that ``torch.save`` wrote, without torch and without running its pickle.

    ``torch.load(weights_only=True)`` with numpy's names allowed would do as well with honest files, but it also builds
    arrays of a forged type, which break the interpreter when they are freed.

    Args:
        path: The file, a zip archive: a ``.frame`` of metrical-tracker or Pixel3DMM.

    Returns:
        As :func:`read_pickled_arrays`.

    Raises:
        DataError: If the file is no such archive, is damaged, or holds anything but numpy's arrays, such as tensors.
    """
    existing_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = [info for info in archive.infolist() if info.filename.rpartition("/")[2] == "data.pkl"]
            if len(members) != 1 or members[0].compress_type != zipfile.ZIP_STORED:
                raise DataError(f"{path}: not a file of torch.save: no data.pkl as it writes it")
            if members[0].file_size > MAX_PICKLE_BYTES:
                raise DataError(f"{path}: its data.pkl has more than {MAX_PICKLE_BYTES >> 20} MiB")
            data = archive.read(members[0])
    except DataError:
        raise
    except Exception as error:  # whatever a damaged archive makes zipfile raise
        reason = foreign_content(path) or one_line(error) or type(error).__name__
        raise DataError(f"{path}: not a readable file of torch.save ({reason})") from error
    return read_pickled_arrays(data, path=path)


def _tree(content: dict[Any, Any], *, path: Path, depth: int) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for key, value in content.items():
        name = str(key)
        if isinstance(value, dict) and depth < MAX_DEPTH:
            tree[name] = _tree(value, path=path, depth=depth + 1)
        elif isinstance(value, int | float | str):
            tree[name] = value
        elif isinstance(value, _Record | list | tuple):
            try:
                tree[name] = _array(list(value) if isinstance(value, tuple) else value, depth=0)
            except (ValueError, TypeError, OverflowError) as error:
                raise DataError(f"{path}: {one_line(name, limit=40)} is damaged ({one_line(error)})") from error
    return tree


def _what_it_is(path: Path, data: bytes, error: Exception) -> str:
    """Say what lies in the place of a pickle: what a download leaves, an archive, or what the unpickler says."""
    if (foreign := foreign_content(path)) is not None:
        return foreign
    if data.startswith(b"\x93NUMPY"):
        return "it is a .npy file of one array"
    archive = next((name for start, name in ARCHIVES.items() if data.startswith(start)), None)
    if archive is not None:
        return f"it is a {archive} archive; unpack it and give the .pkl inside"
    return one_line(error) or type(error).__name__


def _arrays_of(content: dict[Any, Any], *, path: Path, keys: Collection[str] | None) -> dict[str, np.ndarray]:
    arrays = {}
    for key, value in content.items():
        name = key.decode("latin1") if isinstance(key, bytes) else str(key)
        if (keys is None or name in keys) and isinstance(value, _Record | list):
            try:
                arrays[name] = _array(value, depth=0)
            except (ValueError, TypeError, OverflowError) as error:
                raise DataError(f"{path}: {one_line(name, limit=40)} is damaged ({one_line(error)})") from error
    return arrays


def _array(value: Any, *, depth: int) -> np.ndarray:
    """Build the array that a record or a list of integers describes."""
    if depth > MAX_DEPTH:
        raise ValueError("arrays are wrapped too deep")
    if isinstance(value, list):
        if not all(isinstance(item, int) for item in value):
            raise ValueError("a list holds something other than integers")
        return np.array(value, np.int64)
    if isinstance(value, _Array):
        return _plain_array(value)
    if isinstance(value, _FromBuffer):
        buffer, dtype, shape, order = value.args
        return _from_bytes(buffer, dtype, shape, fortran=order == "F")
    if isinstance(value, _Scalar):
        dtype, data = value.args
        return _from_bytes(data, dtype, (), fortran=False)
    if isinstance(value, _Sparse):
        return _dense(_fields(value), depth=depth)
    if isinstance(value, _Chumpy):
        return _array(_fields(value)["x"], depth=depth + 1)
    if isinstance(value, _Select):
        return _selected(_fields(value), depth=depth)
    raise ValueError(f"unexpected {type(value).__name__.lstrip('_').lower()}")


def _fields(record: _Record) -> dict[str, Any]:
    """Return an object's attributes; its state is a dictionary, or a pair whose second one is for ``__slots__``."""
    parts = record.state if isinstance(record.state, tuple) else (record.state,)
    fields: dict[str, Any] = {}
    for part in parts:
        if isinstance(part, dict):
            fields.update({key: value for key, value in part.items() if isinstance(key, str)})
    return _Fields(fields)


class _Fields(dict[str, Any]):
    def __missing__(self, key: str) -> NoReturn:
        raise ValueError(f"an object has no attribute {key}")


def _plain_array(record: _Array) -> np.ndarray:
    if not (isinstance(record.state, tuple) and len(record.state) == 5):
        raise ValueError("an array without content")
    _version, shape, dtype, fortran, data = record.state
    return _from_bytes(data, dtype, shape, fortran=bool(fortran))


def _from_bytes(data: Any, dtype: Any, shape: Any, *, fortran: bool) -> np.ndarray:
    """Build an array of a plain type from exactly the bytes that its shape needs."""
    plain = _plain_dtype(dtype)
    if not isinstance(shape, tuple) or not all(isinstance(size, int) and size >= 0 for size in shape):
        raise ValueError("an array without a shape")
    raw = _raw_bytes(data)
    if len(shape) > 8 or math.prod(shape) * plain.itemsize != len(raw):
        raise ValueError(f"{len(raw)} bytes do not make an array of shape {one_line(shape, limit=40)}, {plain}")
    return np.frombuffer(raw, plain).reshape(shape, order="F" if fortran else "C")


def _raw_bytes(data: Any) -> bytes:
    if isinstance(data, _Encoded):
        data = data.args[0] if len(data.args) == 2 and data.args[1] == "latin1" else None
    if isinstance(data, str):  # bytes of Python 2, or the text inside _codecs.encode
        return data.encode("latin1")
    if isinstance(data, bytes | bytearray | memoryview):
        return bytes(data)
    raise ValueError("an array without bytes")


def _plain_dtype(record: Any) -> np.dtype:
    """Return the number type of a record; refuse objects, fields, sub-arrays and strings."""
    if not isinstance(record, _Dtype) or not record.args:
        raise ValueError("an array without a type")
    code, state = record.args[0], record.state
    if not isinstance(code, str) or code not in PLAIN_TYPES:
        raise ValueError(f"arrays of type {one_line(code, limit=40)} are refused")
    if state is None:
        return np.dtype(code)
    if not isinstance(state, tuple) or len(state) < 5 or any(part is not None for part in state[2:5]):
        raise ValueError("arrays of a structured type are refused")
    if not isinstance(state[1], str) or state[1] not in ("<", ">", "=", "|"):
        raise ValueError("a type with an unknown byte order")
    return np.dtype(code).newbyteorder(state[1])  # type: ignore[arg-type]


def _dense(fields: dict[str, Any], *, depth: int) -> np.ndarray:
    """Build the dense form of a compressed sparse column matrix."""
    shape = fields["_shape"] if "_shape" in fields else fields["shape"]
    if not (isinstance(shape, tuple) and len(shape) == 2):
        raise ValueError("a sparse matrix without a shape")
    rows, columns = (int(_array(n, depth=depth + 1)) if isinstance(n, _Scalar) else n for n in shape)
    if not isinstance(rows, int) or not isinstance(columns, int) or not 0 <= rows * columns <= MAX_DENSE:
        raise ValueError("a sparse matrix of an unlikely shape")
    data, indices, starts = (_array(fields[key], depth=depth + 1) for key in ("data", "indices", "indptr"))
    if data.ndim != 1 or any(part.ndim != 1 or part.dtype.kind not in "iu" for part in (indices, starts)):
        raise ValueError("a sparse matrix whose parts are not lists")
    # Checked here, because scipy's own check takes a negative end for an empty matrix and then reads out of bounds.
    starts = starts.astype(np.int64)
    if len(starts) != columns + 1 or starts[0] != 0 or np.any(np.diff(starts) < 0) or len(data) != len(indices):
        raise ValueError("a sparse matrix whose columns do not follow one another")
    count = int(starts[-1])
    if count > len(data) or np.any(indices[:count] < 0) or np.any(indices[:count] >= rows):
        raise ValueError("a sparse matrix with indices out of range")
    dense = np.zeros((rows, columns), data.dtype)
    # Column j has the entries starts[j] to starts[j + 1]. Entries with the same indices add up, as scipy's do.
    column_of_entry = np.repeat(np.arange(columns), np.diff(starts))
    np.add.at(dense, (indices[:count], column_of_entry), data[:count])
    return dense


def _selected(fields: dict[str, Any], *, depth: int) -> np.ndarray:
    """Return elements of an array by their flat indices, in the shape that chumpy records for them."""
    flat = _array(fields["a"], depth=depth + 1).reshape(-1)
    indices = _array(fields["idxs"], depth=depth + 1).reshape(-1)
    if indices.dtype.kind not in "iu" or np.any(indices < 0) or np.any(indices >= flat.size):
        raise ValueError("a selection with indices out of range")
    chosen = flat[indices]
    shape = fields.get("preferred_shape")
    if shape is None:
        return chosen
    if not isinstance(shape, tuple) or not all(isinstance(size, int) for size in shape):
        raise ValueError("a selection without a shape")
    return chosen.reshape(shape)
