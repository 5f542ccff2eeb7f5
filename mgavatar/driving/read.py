"""Reading motion: the one entrance, which finds the reader that recognises a file by its contents."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from mgavatar.driving.motion import Driving
from mgavatar.driving.readers import (
    artalk,
    audio2face,
    cap4d,
    flame_codes,
    flame_head_tracker,
    lam,
    live_link,
    mediapipe,
    nersemble,
    tracker_frames,
    vhap,
)
from mgavatar.errors import DataError
from mgavatar.files import existing_file, foreign_content, npz_names, one_line, read_npz


class Reader(Protocol):
    """A format of motion; each module of :mod:`mgavatar.driving.readers` is one."""

    UNDERSTOOD: str
    """Its name, for messages."""

    def recognises(self, path: Path) -> bool:
        """Return True if a file or folder has this format, by its contents; a damaged one is no error."""
        ...

    def read(self, path: Path) -> Driving:
        """Read a file or folder that it recognises; the errors are those of :func:`read_driving`."""
        ...


READERS: tuple[Reader, ...] = (
    nersemble,
    cap4d,
    flame_head_tracker,
    tracker_frames,
    flame_codes,
    vhap,
    artalk,
    live_link,
    audio2face,
    lam,
    mediapipe,
)
"""All formats, in the order in which they are tried: those whose marks are more particular come first."""


def read_driving(path: Path | str) -> Driving:
    """Read motion in any format that is understood.

    Missing parameters are zero and identity is not read. An array of one row holds for all frames. A folder is read as
    one frame per file, in the order of their numbers; a capture's folder as its tracked parameters.

    Args:
        path: A file or a folder.

    Returns:
        The motion.

    Raises:
        DataError: If the format is not understood, or values are damaged, not finite, or of different lengths.
    """
    path = Path(path)
    for reader in READERS:
        if reader.recognises(path):
            return reader.read(path)
    raise DataError(
        f"{path}: {_description(path)}; understood are {', '.join(reader.UNDERSTOOD for reader in READERS)}"
    )


def _description(path: Path) -> str:
    """Return what a file or folder that no reader recognises looks like.

    Raises:
        DataError: If there is nothing to read at all.
    """
    if path.is_dir():
        return _folder_description(path)
    existing_file(path)
    if (foreign := foreign_content(path)) is not None:
        return foreign
    start = _first_bytes(path)
    for magic, name in _MAGIC.items():
        if start.startswith(magic):
            return f"is {name}, not motion"
    if start.startswith(b"PK\x03\x04"):
        return _archive_description(path)
    text = start.decode("utf-8", errors="replace")
    if "\0" in text or text.count("\ufffd") > len(text) // 20:
        return "not a file of motion"
    line = one_line(text.lstrip().split("\n", 1)[0], limit=80)
    return f"is text that begins with {line!r}, not motion" if line else "is empty"


_MAGIC = {
    b"\x89PNG": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"\x93NUMPY": "a single array (.npy)",
    b"\x80\x02": "a Python pickle",
    b"\x80\x04": "a Python pickle",
    b"\x1aE\xdf\xa3": "a video",
    b"\x00\x00\x00\x18ftyp": "a video",
    b"\x00\x00\x00\x1cftyp": "a video",
    b"\x00\x00\x00 ftyp": "a video",
    b"RIFF": "a sound or video file",
    b"glTF": "a GLB model",
    b"ply": "a single PLY mesh",
}


def _first_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(4096)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {one_line(error.strerror)}") from error


def _archive_description(path: Path) -> str:
    read_npz(path, wanted=lambda _: False)  # names what is damaged
    names = sorted(npz_names(path))
    shown = ", ".join(one_line(name, limit=40) for name in names[:8]) + (", …" if len(names) > 8 else "")
    return f"no motion in this file, which holds {shown or 'nothing'}"


def _folder_description(path: Path) -> str:
    suffixes = sorted({file.suffix for file in path.iterdir() if file.suffix})
    shown = ", ".join(one_line(suffix, limit=20) for suffix in suffixes[:6])
    return f"no motion in this folder, which has {f'files {shown}' if shown else 'no files'}"
