"""Reading files that strangers made, and writing files that are either whole or absent."""

from __future__ import annotations

import contextlib
import json
import math
import os
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import IO, Any, BinaryIO, Literal

import numpy as np

from mgavatar.errors import DataError

GIBIBYTE = 1 << 30
NPZ_KINDS = "biufUS"
"""Kinds of numpy types that hold plain values: no objects, no records."""


def one_line(text: object, *, limit: int = 200) -> str:
    """What a file or a library said, made fit for a message of one line."""
    plain = "".join(char if char.isprintable() else " " for char in str(text))
    plain = " ".join(plain.split())
    return plain if len(plain) <= limit else plain[: limit - 1] + "…"


def existing_file(path: Path) -> Path:
    """Return ``path``, or raise ``DataError`` if no regular file is there (a pipe would wait for ever)."""
    if path.is_file():
        return path
    if path.is_dir():
        raise DataError(f"{path}: is a folder, a file is needed")
    raise DataError(f"{path}: {'not a regular file' if path.exists() else 'no such file'}")


def read_bytes(path: Path, *, max_bytes: int) -> bytes:
    """The whole of a file that is at most ``max_bytes`` long."""
    existing_file(path)
    try:
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {one_line(error.strerror)}") from error
    if len(data) > max_bytes:
        raise DataError(f"{path}: longer than {max_bytes / 2**20:.0f} MiB; this is not the kind of file expected here")
    return data


def read_json(path: Path, *, max_bytes: int = GIBIBYTE // 4) -> Any:
    """The value of a JSON file. Python's reader lets NaN and infinity through: check the numbers that are used."""
    data = read_bytes(path, max_bytes=max_bytes)
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not valid JSON ({one_line(error)})") from error


@dataclass(frozen=True)
class NpzContent:
    """What ``read_npz`` found: the wanted arrays (read-only), and the names of the others."""

    arrays: dict[str, np.ndarray]
    ignored: tuple[str, ...]


def read_npz(path: Path, *, wanted: Callable[[str], bool], max_bytes: int = GIBIBYTE) -> NpzContent:
    """Read arrays of plain numbers and strings; nothing is unpickled and nothing unwanted is inflated.

    Every header is checked before any data is inflated, so a small file cannot claim gigabytes.

    Args:
        path: The ``.npz`` file.
        wanted: Tells by an array's name whether to read it.
        max_bytes: Most that the wanted arrays may take in memory together.

    Returns:
        The wanted arrays and the names of the others.

    Raises:
        DataError: If the file is missing, damaged, too large, or a wanted array holds Python objects.
    """
    existing_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            chosen = {name: info for name, info in members.items() if wanted(name)}
            headers = {name: _npy_header(archive, info, path=path) for name, info in chosen.items()}
            if sum(header.n_bytes for header in headers.values()) > max_bytes:
                raise DataError(f"{path}: its arrays need more than {max_bytes / 2**20:.0f} MiB; too large to be real")
            arrays = {name: _npy_array(archive, chosen[name], header) for name, header in headers.items()}
    except DataError:
        raise
    except Exception as error:  # whatever a damaged archive makes zipfile, zlib and numpy raise
        raise DataError(f"{path}: not a readable .npz file ({one_line(error) or type(error).__name__})") from error
    return NpzContent(arrays, tuple(one_line(name, limit=40) for name in members if name not in chosen))


@dataclass(frozen=True)
class _NpyHeader:
    """Type and shape of one member, and where its data starts."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype
    offset: int

    @property
    def n_bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def _npy_header(archive: zipfile.ZipFile, info: zipfile.ZipInfo, *, path: Path) -> _NpyHeader:
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DataError(f"{path}: {one_line(info.filename)} is compressed in a way that numpy does not write")
    with archive.open(info) as stream:
        version = np.lib.format.read_magic(stream)
        readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in readers:
            raise ValueError(f"{info.filename} has format version {version}")
        with warnings.catch_warnings():  # numpy remarks on headers that Python 2 wrote, as FLAME's texture file has
            warnings.simplefilter("ignore", UserWarning)
            shape, fortran, dtype = readers[version](stream)
        header = _NpyHeader(shape, fortran, dtype, stream.tell())
    if dtype.kind not in NPZ_KINDS:
        raise DataError(f"{path}: {one_line(info.filename)} holds {one_line(dtype)}, not plain numbers or strings")
    if min(shape, default=0) < 0 or info.file_size != header.offset + header.n_bytes:
        raise ValueError(f"{info.filename} has {info.file_size} bytes, its header says otherwise")
    return header


def _npy_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, header: _NpyHeader) -> np.ndarray:
    with archive.open(info) as stream:
        stream.read(header.offset)
        data = stream.read(header.n_bytes)
    order: Literal["F", "C"] = "F" if header.fortran else "C"
    if header.dtype.itemsize == 0:  # numpy writes an empty string with a type of no width
        return np.zeros(header.shape, header.dtype, order)
    return np.frombuffer(data, header.dtype).reshape(header.shape, order=order)


def float_array(value: np.ndarray, *, where: str) -> np.ndarray:
    """``value`` as finite float32, contiguous; ``where`` begins the message if it is something else."""
    if value.dtype.kind not in "biuf":
        raise DataError(f"{where} holds {value.dtype}, numbers are needed")
    with np.errstate(over="ignore", invalid="ignore"):
        array = np.ascontiguousarray(value, np.float32).reshape(value.shape)
    bad = array.size - np.count_nonzero(np.isfinite(array))
    if bad:
        raise DataError(f"{where} holds {bad} values that are NaN or infinite")
    return array


def path_inside(entry: object, *, base: Path, allowed: Path, where: str) -> Path:
    """The existing file that a capture names, if it lies below ``allowed``.

    Args:
        entry: What the capture's file says: a relative path.
        base: Folder that ``entry`` is relative to, already resolved.
        allowed: Folder that the file must be in, already resolved.
        where: Begins the message: the file and the entry of it that is read.

    Returns:
        The file's resolved path.

    Raises:
        DataError: If ``entry`` is no relative path, leads out of ``allowed``, or no regular file is there.
    """
    if not isinstance(entry, str) or not entry or "\0" in entry:
        raise DataError(f"{where}: {one_line(repr(entry), limit=60)} is not a path")
    relative = entry.replace("\\", "/")
    shown = one_line(entry)
    if relative.startswith("/") or PureWindowsPath(entry).drive:
        raise DataError(f"{where}: {shown} is absolute; paths must be relative to {base.name}")
    lexical = Path(os.path.normpath(base / relative))
    outside = DataError(f"{where}: {shown} leads out of {allowed}; the files must be copied to inside that folder")
    if not lexical.is_relative_to(allowed):  # before the file system is asked, so nothing outside is touched
        raise outside
    try:
        found = (base / relative).resolve(strict=True)
    except FileNotFoundError as error:
        raise DataError(f"{where}: {shown} does not exist") from error
    except (OSError, RuntimeError, ValueError) as error:  # too long, a file as a folder, a loop of links, no text
        raise DataError(f"{where}: {shown} cannot be opened ({type(error).__name__})") from error
    if not found.is_relative_to(allowed):
        raise outside
    if not found.is_file():
        raise DataError(f"{where}: {shown} is not a file")
    return found


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A file to write to that takes its name, and its predecessor's place, only when the block ends without error.

    Raises:
        DataError: If the folder is missing or cannot be written to.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:
            yield file
            _flush(file)
        os.replace(partial, path)
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {one_line(error.strerror or error)}") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def _flush(file: IO[bytes]) -> None:
    file.flush()
    os.fsync(file.fileno())
