"""Writers of image sequences: mp4, gif, folders of PNG or EXR. What they write is whole or absent."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenEXR
import torch
from PIL import Image
from torch import Tensor

from mgavatar import __version__
from mgavatar.camera import Camera
from mgavatar.errors import DataError
from mgavatar.files import check_writable, reading, require_new_folder, writing
from mgavatar.kernels.rasterize import Rendering

FileKind = Literal["mp4", "gif", "png", "exr"]
Format = Literal["auto", "png", "exr", "mp4"]
"""A kind of file that a user asks for; ``auto`` goes by the name."""

FrameSink = Callable[[Rendering, Camera], None]
"""Takes the next frame; for ``exr`` rendered over black, so that its colours are premultiplied."""

EMPTY_DEPTH = 1e10
"""Z of EXR pixels that show nothing [m]: finite, so that filters of compositing programs stay finite."""

_LEAST_ALPHA = 1e-4
"""Coverage below which a pixel shows nothing: its colour would be a quotient of roundings."""

_MAGIC = {"mp4": (4, b"ftyp"), "gif": (0, b"GIF8")}

_MEDIA = {".avi", ".bmp", ".exr", ".jpeg", ".jpg", ".m4v", ".mkv", ".mov", ".png", ".tif", ".tiff", ".webm", ".webp"}

_SHAPES = {".fbx", ".glb", ".gltf", ".obj", ".ply", ".sog", ".splat", ".spz", ".stl", ".usd", ".usda", ".usdc", ".usdz"}
"""Suffixes of meshes and splats."""

_BT709 = 1

_TV_RANGE = 1


def to_bytes(image: Tensor) -> np.ndarray:
    """Return an image [3, H, W] in 0..1 as pixels [H, W, 3], uint8, rounded to the nearest value."""
    return (image.detach().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()


def kind_of(out: Path, format: Format = "auto", *, overwrite: bool = False) -> FileKind:
    """Decide what to write at ``out``, and check that it can be written there without harm to other files.

    Args:
        out: A name ending in ``.mp4`` or ``.gif``, else a folder.
        format: ``"auto"`` goes by the name; a folder then holds PNG.
        overwrite: Replace a video of the same kind.

    Returns:
        The kind of file.

    Raises:
        DataError: If name and format contradict each other, something else is at ``out``, or PyAV is missing.
    """
    suffix = out.suffix.lower()
    of_name: FileKind | None = "mp4" if suffix == ".mp4" else "gif" if suffix == ".gif" else None
    kind: FileKind = of_name or "png" if format == "auto" else format
    if (of_name or kind) != kind:
        raise DataError(f"{out}: its name says {of_name}, but the format is {kind}; change one of them")
    if kind == "mp4" and of_name is None:
        raise DataError(f"{out}: the name of a video must end in .mp4")
    if suffix in _SHAPES:
        raise DataError(f"{out}: render draws pictures; `mgavatar export` writes meshes and splats")
    if suffix in _MEDIA:
        raise DataError(f"{out}: give a name ending in .mp4 or .gif, or a folder (of PNG; of EXR with --format exr)")
    if kind == "mp4" and importlib.util.find_spec("av") is None:
        raise DataError(f"{out}: writing video needs PyAV: pip install mgavatar[video], or write a .gif or a folder")
    _check_replaceable(out, kind, overwrite=overwrite)
    return kind


def default_name(driving: Path, format: Format = "auto") -> Path:
    """Return the name that a rendering gets in the working folder, after the motion that drives it.

    It is a video where PyAV is installed and else a GIF, or the name of a folder if ``format`` is one of single images.
    """
    if format in ("png", "exr"):
        return Path(driving.stem)
    return Path(f"{driving.stem}.mp4" if format == "mp4" or importlib.util.find_spec("av") else f"{driving.stem}.gif")


def _check_replaceable(out: Path, kind: FileKind, *, overwrite: bool) -> None:
    if not out.parent.is_dir():
        raise DataError(f"{out}: the folder {out.parent} does not exist; make it first")
    if kind in ("png", "exr"):
        require_new_folder(out)
        check_writable(out, kind="folder")
    else:
        if out.exists():
            offset, magic = _MAGIC[kind]
            if not out.is_file() or _first_bytes(out)[offset : offset + len(magic)] != magic:
                raise DataError(f"{out}: already exists and is not a .{kind} file; give --out another name")
            if not overwrite:
                raise DataError(f"{out}: already exists; give --out another name, or --overwrite to replace it")
        check_writable(out)


def _first_bytes(path: Path) -> bytes:
    with reading(path), path.open("rb") as file:
        start = file.read(16)
    return start


@contextlib.contextmanager
def frame_writer(out: Path, kind: FileKind, *, fps: float, transparent: bool = False) -> Iterator[FrameSink]:
    """Write frames beside ``out`` and move them there when the block ends without error.

    Args:
        out: File or folder to write; see :func:`kind_of`.
        kind: Kind of file.
        fps: Frames per second of a video.
        transparent: Write PNG with alpha; its frames are drawn over black.

    Yields:
        A function that takes the next frame.

    Raises:
        DataError: If ``out`` cannot be written.
    """
    partial = out.with_name(f".{out.name}.{os.getpid()}.part")
    png = _rgba_folder if transparent else _png_folder
    writers = {"mp4": _mp4, "gif": _gif, "png": png, "exr": _exr_folder}
    try:
        with writing(out):
            shutil.rmtree(partial, ignore_errors=True)
            # A folder for files too: after a failed write PyAV opens the name again when the container is collected,
            # and would leave a file behind if its folder were still there.
            partial.mkdir()
            with writers[kind](partial / out.name, fps) as sink:
                yield sink
            if out.is_dir():
                out.rmdir()
            os.replace(partial / out.name, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@dataclass
class _Counter:
    value: int = 0

    def next(self) -> int:
        self.value += 1
        return self.value - 1


@contextlib.contextmanager
def _mp4(path: Path, fps: float) -> Iterator[FrameSink]:
    """Write H.264 in yuv420p, which every player can show, with the colours declared as BT.709."""
    import av
    from av.video.reformatter import Interpolation

    # Without these flags, swscale rounds in ways that cost about half a level of brightness.
    exact = (
        Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT | Interpolation.FULL_CHR_H_INP
    )
    rate = Fraction(fps).limit_denominator(1001)
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream: Any = container.add_stream("libx264", rate=rate, options={"crf": "16", "preset": "medium"})
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.colorspace, context.color_primaries, context.color_trc = _BT709, _BT709, _BT709
        context.color_range = _TV_RANGE

        def add(rendering: Rendering, camera: Camera) -> None:
            pixels = _padded_to_even(to_bytes(rendering.image))
            if not context.is_open:
                stream.height, stream.width = pixels.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            converted = frame.reformat(
                format="yuv420p",
                src_color_range="JPEG",
                dst_color_range="MPEG",
                dst_colorspace="ITU709",
                interpolation=exact,
            )
            container.mux(stream.encode(converted))

        yield add
        container.mux(stream.encode(None))


def _padded_to_even(pixels: np.ndarray) -> np.ndarray:
    """Repeat the last row and column of odd sizes: yuv420p stores colours at half the size."""
    height, width = pixels.shape[:2]
    return np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


@contextlib.contextmanager
def _gif(path: Path, fps: float) -> Iterator[FrameSink]:
    frames: list[Image.Image] = []

    def add(rendering: Rendering, camera: Camera) -> None:
        frames.append(Image.fromarray(to_bytes(rendering.image)).quantize(256, dither=Image.Dither.FLOYDSTEINBERG))

    yield add
    hundredths = max(2, round(100.0 / fps))  # players show shorter delays as 10 hundredths
    frames[0].save(
        path, format="GIF", save_all=True, append_images=frames[1:], duration=10 * hundredths, loop=0, disposal=1
    )


@contextlib.contextmanager
def _png_folder(path: Path, fps: float) -> Iterator[FrameSink]:
    path.mkdir()
    counter = _Counter()

    def add(rendering: Rendering, camera: Camera) -> None:
        Image.fromarray(to_bytes(rendering.image)).save(path / f"{counter.next():05d}.png", compress_level=1)

    yield add


@contextlib.contextmanager
def _rgba_folder(path: Path, fps: float) -> Iterator[FrameSink]:
    path.mkdir()
    counter = _Counter()

    def add(rendering: Rendering, camera: Camera) -> None:
        pixels = to_bytes(straight_rgba(rendering))
        Image.fromarray(pixels).save(path / f"{counter.next():05d}.png", compress_level=1)

    yield add


def straight_rgba(rendering: Rendering) -> Tensor:
    """Return colours and coverage of a frame drawn over black, [4, H, W] in 0..1; PNG colours are not premultiplied."""
    alpha = rendering.alphas.detach().clamp(0.0, 1.0)
    covered = alpha > _LEAST_ALPHA
    color = (rendering.image.detach() / alpha.where(covered, 1.0)).where(covered, 0.0)
    return torch.cat([color, alpha.where(covered, 0.0)[None]])


@contextlib.contextmanager
def _exr_folder(path: Path, fps: float) -> Iterator[FrameSink]:
    path.mkdir()
    counter = _Counter()

    def add(rendering: Rendering, camera: Camera) -> None:
        frame = counter.next()
        write_exr(path / f"{frame:05d}.exr", rendering, camera, frame=frame)

    yield add


def write_exr(path: Path, rendering: Rendering, camera: Camera, *, frame: int) -> None:
    """Write a frame as scene-linear premultiplied RGBA (half) and Z (float), for compositing programs.

    Args:
        path: The file.
        rendering: A frame drawn over black.
        camera: Its camera, for the header.
        frame: Its number, for the header.

    Raises:
        OSError: If the file cannot be written.
    """
    import kornia.color

    alpha = rendering.alphas.detach().cpu().clamp(0.0, 1.0)
    covered = alpha > _LEAST_ALPHA
    divisor = torch.where(covered, alpha, 1.0)
    display = (rendering.image.detach().cpu() / divisor).clamp(0.0, 1.0)
    linear = kornia.color.rgb_to_linear_rgb(display) * alpha
    rgba = torch.cat([linear, alpha[None]]).where(covered, 0.0).permute(1, 2, 0).half()
    depth = torch.where(covered, rendering.depths.detach().cpu() / divisor, EMPTY_DEPTH).float()
    channels = {"RGBA": rgba.contiguous().numpy(), "Z": depth.contiguous().numpy()}
    with OpenEXR.File(_exr_header(camera, frame), channels) as file:
        try:
            file.write(str(path))
        except RuntimeError as error:  # OpenEXR's word for every refusal of the system
            raise OSError(str(error)) from error


def _exr_header(camera: Camera, frame: int) -> dict[str, Any]:
    notes = {
        "convention": "viewmat maps world to camera (column vectors); OpenCV axes: x right, y down, z forward",
        "unit": "metre",
        "viewmat": camera.viewmat.tolist(),
        "K": camera.K.tolist(),
        "Z": f"camera z, {EMPTY_DEPTH:g} where nothing is",
        "color": "linear, Rec. 709 primaries, premultiplied by alpha",
    }
    return {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290),
        "worldToCamera": np.ascontiguousarray(camera.viewmat.T, np.float32),  # Imath's vectors are rows
        "K": np.ascontiguousarray(camera.K, np.float32),
        "mgavatar/frame": frame,
        "mgavatar/version": __version__,
        "mgavatar/json": json.dumps(notes),
    }
