"""Reading captures: find the reader that recognises a folder, and let it read."""

from __future__ import annotations

from pathlib import Path

from mgavatar.capture.readers import vhap
from mgavatar.capture.subject import Subject
from mgavatar.config import Background, PrincipalPoint


def read_capture(
    root: Path | str, *, background: Background = "white", principal_point: PrincipalPoint = "center"
) -> Subject:
    """Read a capture's calibration and parameters, and check that every file it names is there.

    Images are not decoded: see ``mgavatar.capture.images.check_images``.

    Args:
        root: Folder with ``transforms_train.json``, and ``_val`` and ``_test`` if there are any. Paths in them are
            relative to it and may lead to its sibling folders, as in VHAP's combined (UNION) captures.
        background: What the images are composited on; VHAP's default is white.
        principal_point: ``"center"`` puts it into the image centre, as GaussianAvatars does; ``"opencv"`` takes
            ``cx, cy`` from the file, cy from the top; ``"opengl"`` the same with cy from the bottom, as VHAP writes
            it since November 2024.

    Returns:
        The capture. Rows of its parameters are the timesteps of all splits in ascending order.

    Raises:
        DataError: If something is missing or inconsistent; the message names the file.
    """
    return vhap.read(Path(root), background=background, principal_point=principal_point)
