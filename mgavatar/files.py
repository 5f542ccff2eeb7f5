"""Reading files that strangers made, and writing files that are whole or absent.

Every file that the program writes goes through ``atomic_write`` or a function below it: a refusal of the system becomes
one ``DataError`` with the path and a remedy, whatever exception a library makes of it.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import math
import os
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import IO, Any, BinaryIO, Literal

import numpy as np

from mgavatar.errors import DataError

GIBIBYTE = 1 << 30
NPZ_KINDS = "biufUS"
"""Kinds of numpy types that hold plain values: no objects, no records."""
_PROBE_BYTES = 4096


def one_line(text: object, *, limit: int = 200) -> str:
    """Return the text of a file or a library on one line, without control characters, at most ``limit`` long."""
    plain = "".join(char if char.isprintable() else " " for char in str(text))
    plain = " ".join(plain.split())
    return plain if len(plain) <= limit else plain[: limit - 1] + "…"


def existing_file(path: Path) -> Path:
    """Return ``path`` if a regular file is there; a pipe would be read for ever.

    Raises:
        DataError: If nothing or anything else is there, or its folder cannot be read.
    """
    with reading(path):  # Python raises where a folder may not be searched, or a name is too long
        is_file, is_folder, exists = path.is_file(), path.is_dir(), path.exists()
    if is_folder:
        raise DataError(f"{path}: is a folder, a file is needed")
    if not is_file:
        raise DataError(f"{path}: {'not a regular file' if exists else 'no such file'}")
    return path


def existing_folder(path: Path) -> Path:
    """Return ``path`` if a folder is there.

    Raises:
        DataError: If nothing or anything else is there, or the folder above cannot be read.
    """
    with reading(path):
        is_folder, exists = path.is_dir(), path.exists()
    if not is_folder:
        raise DataError(f"{path}: {'is a file, a folder is needed' if exists else 'no such folder'}")
    return path


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn the system's refusal to read inside the block into one line that names ``path``.

    Raises:
        DataError: In the place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {one_line(error.strerror or error)}") from error


def read_bytes(path: Path, *, max_bytes: int) -> bytes:
    """Return the contents of a file that is at most ``max_bytes`` long.

    Raises:
        DataError: If the file is missing, longer, or cannot be read.
    """
    with reading(existing_file(path)), path.open("rb") as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise DataError(f"{path}: longer than {max_bytes / 2**20:.0f} MiB; this is not the kind of file expected here")
    return data


def read_json(path: Path, *, max_bytes: int = GIBIBYTE // 4) -> Any:
    """Return the value of a JSON file. Python's reader lets NaN and infinity through: check the numbers that are used.

    Raises:
        DataError: If the file is missing, too long, or not JSON.
    """
    data = read_bytes(path, max_bytes=max_bytes)
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not valid JSON ({one_line(error)})") from error


def foreign_content(path: Path) -> str | None:
    """Describe a file that is no data at all, but what a failed download leaves in its place, with the remedy.

    Returns:
        A clause for the message of an error, or None if the file is nothing of this kind.
    """
    try:
        with path.open("rb") as file:
            start = file.read(1024).lstrip(b"\xef\xbb\xbf \t\r\n")
    except OSError:
        return None
    text = start.lower()
    if not text:
        return "the file is empty; download it again"
    if text.startswith(b"version https://git-lfs"):
        return "it is a pointer file of Git LFS; fetch the file itself with `git lfs pull`"
    if text.startswith((b"<!doctype html", b"<html", b"<head", b"<?xml", b"<script")) or b"<html" in text:
        return "it is a web page (HTML), perhaps a login page; download the file again, logged in"
    if text.startswith((b'{"', b"{'")) and b"error" in text:
        return "it is the error message of a server; download the file again, logged in"
    if text.startswith(b"/annex/objects"):
        return "it is a pointer file of git-annex; fetch the file itself with `git annex get`"
    return None


@dataclass(frozen=True)
class NpzContent:
    """Contents of an ``.npz`` file: the wanted arrays (read-only), and the names of the others."""

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
        reason = foreign_content(path) or one_line(error) or type(error).__name__
        raise DataError(f"{path}: not a readable .npz file ({reason})") from error
    return NpzContent(arrays, tuple(one_line(name, limit=40) for name in members if name not in chosen))


def npz_names(path: Path) -> frozenset[str]:
    """Return the names of the arrays of an ``.npz`` file, or none if the file is not a readable archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            return frozenset(info.filename.removesuffix(".npy") for info in archive.infolist())
    except Exception:  # whatever a damaged archive makes zipfile raise; who reads the file reports it
        return frozenset()


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
        header = _header_of(stream)
    if header.dtype.kind not in NPZ_KINDS:
        raise DataError(
            f"{path}: {one_line(info.filename)} holds {one_line(header.dtype)}, not plain numbers or strings"
        )
    if min(header.shape, default=0) < 0 or info.file_size != header.offset + header.n_bytes:
        raise ValueError(f"{info.filename} has {info.file_size} bytes, its header says otherwise")
    return header


def _header_of(stream: IO[bytes]) -> _NpyHeader:
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"format version {version} is unknown")
    with warnings.catch_warnings():  # numpy remarks on headers that Python 2 wrote, as FLAME's texture file has
        warnings.simplefilter("ignore", UserWarning)
        shape, fortran, dtype = readers[version](stream)
    return _NpyHeader(shape, fortran, dtype, stream.tell())


def _npy_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, header: _NpyHeader) -> np.ndarray:
    with archive.open(info) as stream:
        stream.read(header.offset)
        data = stream.read(header.n_bytes)
    order: Literal["F", "C"] = "F" if header.fortran else "C"
    if header.dtype.itemsize == 0:  # numpy writes an empty string with a type of no width
        return np.zeros(header.shape, header.dtype, order)
    return np.frombuffer(data, header.dtype).reshape(header.shape, order=order)


def read_npy(path: Path, *, max_bytes: int = GIBIBYTE) -> np.ndarray:
    """Read a single array of plain numbers (``.npy``); nothing is unpickled.

    Raises:
        DataError: If the file is missing, damaged or too large, or holds something other than numbers.
    """
    data = read_bytes(path, max_bytes=max_bytes)
    try:
        header = _header_of(io.BytesIO(data))
        plain = header.dtype.kind in NPZ_KINDS
        if plain and (min(header.shape, default=0) < 0 or len(data) != header.offset + header.n_bytes):
            raise ValueError(f"it has {len(data)} bytes, its header says otherwise")
    except Exception as error:  # whatever a damaged header makes numpy raise
        raise DataError(f"{path}: not a readable .npy file ({one_line(error) or type(error).__name__})") from error
    if not plain or header.dtype.itemsize == 0:
        raise DataError(f"{path}: holds {one_line(header.dtype)}, not plain numbers")
    order: Literal["F", "C"] = "F" if header.fortran else "C"
    return np.frombuffer(data, header.dtype, offset=header.offset).reshape(header.shape, order=order)


def float_array(value: np.ndarray, *, where: str) -> np.ndarray:
    """Return ``value`` as contiguous float32.

    Args:
        value: Numbers.
        where: Begins the message: the file and the entry of it that is read.

    Raises:
        DataError: If ``value`` holds no numbers, or NaN or infinity.
    """
    if value.dtype.kind not in "biuf":
        raise DataError(f"{where} holds {value.dtype}, numbers are needed")
    with np.errstate(over="ignore", invalid="ignore"):
        array = np.ascontiguousarray(value, np.float32).reshape(value.shape)
    bad = array.size - np.count_nonzero(np.isfinite(array))
    if bad:
        raise DataError(f"{where} holds {bad} values that are NaN or infinite")
    return array


def path_inside(
    entry: object, *, base: Path, allowed: Path, where: str, linked: Collection[Path] = (), remedy: str = ""
) -> Path:
    """Return the existing file that a capture names, if it lies below ``allowed``.

    Args:
        entry: What the capture's file says: a relative path.
        base: Folder that ``entry`` is relative to, already resolved.
        allowed: Folder that the file must be in, already resolved.
        where: Begins the message: the file and the entry of it that is read.
        linked: Folders outside ``allowed`` that links inside it may lead to, already resolved.
        remedy: Ends the message about a link that leads anywhere else.

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
    if not any(found.is_relative_to(folder) for folder in (allowed, *linked)):
        raise DataError(f"{outside}{remedy}")
    if not found.is_file():
        raise DataError(f"{where}: {shown} is not a file")
    return found


class _RecordingFile(io.RawIOBase):
    """A file that remembers the first error of a write.

    Libraries turn a failed write into exceptions of their own: ``torch.save`` raises a RuntimeError of its zip writer,
    Pillow an "encoder error". The system's reason is here. There is no ``fileno``, so nobody writes past this class.
    """

    def __init__(self, path: Path) -> None:
        self.raw = io.FileIO(path, "xb")
        self.error: OSError | None = None

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        try:
            return self.raw.write(data)
        except OSError as error:
            self.error = self.error or error
            raise

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self.raw.seek(offset, whence)

    def tell(self) -> int:
        return self.raw.tell()

    def sync(self) -> None:
        """Wait until the bytes are on the disk, where delayed allocation may still find no room for them."""
        try:
            os.fsync(self.raw.fileno())
        except OSError as error:
            self.error = self.error or error
            raise

    def close(self) -> None:
        self.raw.close()
        super().close()


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """Yield a file that replaces ``path`` only when the block ends without an error; otherwise it is removed.

    Raises:
        DataError: If the folder is missing, or the file cannot be created or written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    recording: _RecordingFile | None = None
    try:
        _check_replaceable(path)
        partial.unlink(missing_ok=True)
        recording = _RecordingFile(partial)
        file = io.BufferedWriter(recording)
        try:
            yield file
            file.flush()
            recording.sync()
        finally:
            # After a failed write the buffer is still full: closing would write it again and hide the first error.
            with contextlib.suppress(OSError, ValueError):
                file.close()
            recording.close()
        os.replace(partial, path)
    except Exception as error:
        reason = recording.error if recording is not None and recording.error is not None else error
        if isinstance(reason, OSError):
            raise _refusal(path, reason) from error
        raise
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8; atomic.

    Raises:
        DataError: If the file cannot be written.
    """
    with atomic_write(path) as file:
        file.write(text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON; atomic.

    Raises:
        DataError: If the file cannot be written.
    """
    write_text(path, json.dumps(value, indent=2) + "\n")


def append_line(path: Path, line: str) -> None:
    """Add a line to a text file, which is made if it is missing; the file keeps its lines if the write fails.

    Raises:
        DataError: If the file cannot be written.
    """
    with writing(path), path.open("ab", buffering=0) as file:
        end = file.seek(0, os.SEEK_END)
        data = memoryview(f"{line}\n".encode())
        try:
            while data:  # a write may take a part only, as on a disk with little room
                data = data[file.write(data) :]
        except OSError:
            with contextlib.suppress(OSError):
                file.truncate(end)
            raise


def make_folder(path: Path) -> None:
    """Make a folder and those above it, unless it is there.

    Raises:
        DataError: If it cannot be made, or a file has its name.
    """
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)


def require_new_folder(path: Path, *, flag: str = "--out", or_else: str = "") -> None:
    """Refuse a path where anything but an empty folder is: results are never overwritten.

    Args:
        path: Folder that is going to be made.
        flag: Option that the path was given with.
        or_else: Another remedy, added to the message.

    Raises:
        DataError: If a file, or a folder with something in it, is there.
    """
    with writing(path):
        free = not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir()))
    if not free:
        raise DataError(f"{path}: already exists and is not an empty folder; give {flag} another name{or_else}")


def check_writable(path: Path, *, kind: Literal["file", "folder"] = "file") -> None:
    """Refuse a path that cannot be written to, before the work whose results would be lost.

    A block is written to a temporary file in the nearest folder that exists, which finds a full disk too. Nothing is
    left there.

    Args:
        path: Where results will go.
        kind: A file, whose folder must exist, or a folder, which :func:`make_folder` makes with those above it.

    Raises:
        DataError: If the path cannot be written to, or names the other kind.
    """
    with writing(path):
        folder = path.parent if kind == "file" else path
        existing = next(place for place in (folder, *folder.absolute().parents) if place.exists())
        if not existing.is_dir():
            raise DataError(f"{path}: {existing} is a file, but a folder is needed there; give another path")
        if kind == "file":
            if not folder.is_dir():
                raise DataError(f"{path}: the folder {folder} does not exist; make it first")
            _check_replaceable(path)
        with tempfile.TemporaryFile(dir=existing) as probe:
            probe.write(bytes(_PROBE_BYTES))
            probe.flush()


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the system's refusal to write inside the block into one line that names ``path``.

    Raises:
        DataError: In the place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise _refusal(path, error) from error


_REMEDIES = {
    errno.ENOSPC: "free some space there, or give another path",
    errno.EDQUOT: "free some space there, or give another path",
    errno.EFBIG: "free some space there or raise the limit, or give another path",
    errno.EACCES: "give a path that you may write to",
    errno.EPERM: "give a path that you may write to",
    errno.EROFS: "give a path that you may write to",
    errno.ENOENT: "make its folder first",
    errno.ENOTDIR: "a file stands where a folder is needed; give another path",
    errno.EEXIST: "a file stands where a folder is needed; give another path",
    errno.EISDIR: "a folder has this name; give another path",
    errno.ENAMETOOLONG: "give a shorter path",
}


def _refusal(path: Path, error: OSError) -> DataError:
    """Return the error for the user: the path, the system's reason and a remedy."""
    remedy = _REMEDIES.get(error.errno or 0, "give another path")
    return DataError(f"{path}: cannot be written: {one_line(error.strerror or error)}; {remedy}")


def _check_replaceable(path: Path) -> None:
    """Refuse to put a file in the place of a folder or of a device: ``/dev/null`` must stay what it is."""
    if path.is_dir():
        raise DataError(f"{path}: is a folder, the name of a file is needed")
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: is not a regular file; give the name of a file")
