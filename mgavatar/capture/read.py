"""Reading captures: the one entrance, which finds the reader that recognises a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, get_args

from mgavatar.capture.images import without_bad_images
from mgavatar.capture.readers import insta, vhap
from mgavatar.capture.subject import Subject
from mgavatar.config import Background, PrincipalPoint, background_color
from mgavatar.errors import DataError
from mgavatar.files import existing_folder


class Reader(Protocol):
    """A format of captures; each module of :mod:`mgavatar.capture.readers` is one."""

    MARK: str
    """File that every folder in this format has, for messages."""

    def recognises(self, root: Path) -> bool:
        """Return True if a folder is a capture in this format, by the names of its files alone."""
        ...

    def read(
        self,
        root: Path,
        *,
        background: tuple[float, float, float],
        principal_point: PrincipalPoint,
        skip_bad: bool,
        follow_links: bool,
    ) -> Subject:
        """Read a capture; as :func:`read_capture`."""
        ...


READERS: tuple[Reader, ...] = (insta, vhap)
"""All formats, in the order in which they are tried."""


def read_capture(
    root: Path | str,
    *,
    background: Background = "white",
    principal_point: PrincipalPoint = "center",
    skip_bad: bool = False,
    follow_links: bool = False,
) -> Subject:
    """Read a capture's calibration and parameters, and check that every file it names is there.

    Images are not decoded, except with ``skip_bad``: see :func:`mgavatar.capture.images.check_images`.

    Args:
        root: Folder with ``transforms_train.json``, and ``_val`` and ``_test`` if there are any. Paths in them are
            relative to it and may lead to its sibling folders, as in VHAP's combined (UNION) captures. Or a folder of
            INSTA or metrical-tracker, with ``checkpoint/*.frame``.
        background: Colour that the images are composited on: ``"white"``, VHAP's default, ``"black"``, or ``"R,G,B"``
            with numbers from 0 to 255. Images with a matte of their own are composited on it.
        principal_point: ``"center"`` puts it into the image centre, as GaussianAvatars does; ``"opencv"`` takes
            ``cx, cy`` from the file, cy from the top; ``"opengl"`` the same with cy from the bottom, as VHAP writes
            it since November 2024.
        skip_bad: Leave out, and log, frames whose files are missing or damaged or hold NaN, as after a failure of the
            tracker.
        follow_links: Follow all symbolic links out of the capture. Those of whole folders, ``images`` or a sequence
            beside a UNION capture, are always followed.

    Returns:
        The capture. Rows of its parameters are the timesteps of all splits in ascending order.

    Raises:
        DataError: If no reader recognises the folder, or something is missing or inconsistent; the message names the
            file.
    """
    if principal_point not in get_args(PrincipalPoint):
        raise DataError(f"principal_point {principal_point!r}: must be one of {', '.join(get_args(PrincipalPoint))}")
    try:
        color = background_color(background)
    except ValueError as error:
        raise DataError(f"background {background!r}: {error}") from error
    root = Path(root)
    subject = _reader_of(root).read(
        root.resolve(),
        background=color,
        principal_point=principal_point,
        skip_bad=skip_bad,
        follow_links=follow_links,
    )
    return without_bad_images(subject) if skip_bad else subject


def _reader_of(root: Path) -> Reader:
    """Return the first reader that recognises a folder."""
    existing_folder(root)
    for reader in READERS:
        if reader.recognises(root):
            return reader
    inside = [folder for folder in sorted(root.glob("*/")) if any(reader.recognises(folder) for reader in READERS)]
    remedy = f"did you mean {inside[0]}?" if inside else "export the capture with VHAP, or see mgavatar synth"
    marks = " or ".join(reader.MARK for reader in READERS)
    raise DataError(f"{root}: no {marks} in this folder; {remedy}")
