"""Print the resources that each kernel takes on a CUDA device, from binaries compiled without one.

    python tools/cuda_usage.py [--architectures 75 90]

Registers, static shared memory and local memory (spills and stack) are read from the sections of the ELF files that
NVRTC writes.
"""

from __future__ import annotations

import importlib
import struct
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import warp as wp
from command_line import run
from warp._src.context import user_modules  # Warp has no public list of its modules

import mgavatar.kernels
from mgavatar.reporting.markdown import markdown_table

REGISTERS, FRAME_SIZE = 0x2F, 0x11
"""Attributes of section .nv.info: one entry per function, with its symbol and a value."""

_NO_BITS = 8
"""ELF type of a section that takes memory but has no contents in the file."""


def _sections(elf: bytes) -> Iterator[tuple[str, bytes, int]]:
    """Yield name, contents and size of each section of a 64-bit little-endian ELF file."""
    offset = struct.unpack_from("<Q", elf, 0x28)[0]
    size, count, names_at = struct.unpack_from("<HHH", elf, 0x3A)
    headers = [struct.unpack_from("<IIQQQQIIQQ", elf, offset + i * size) for i in range(count)]
    names = headers[names_at][4]
    for name, kind, _, _, start, length, *_ in headers:
        text = elf[names + name : elf.index(b"\0", names + name)].decode()
        yield text, b"" if kind == _NO_BITS else elf[start : start + length], length


def _attributes(info: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield attribute, symbol and value of the entries of .nv.info that have all three."""
    at = 0
    while at + 4 <= len(info):
        form, attribute, size = struct.unpack_from("<BBH", info, at)
        at += 4
        if form == 4:  # a payload of that size follows; otherwise the value is in the header
            if size == 8:
                yield attribute, *struct.unpack_from("<II", info, at)
            at += size


def usage(cubin: bytes) -> dict[str, tuple[int, int, int]]:
    """Return registers, shared bytes and local bytes of each kernel in a CUDA binary."""
    sections = {name: (contents, length) for name, contents, length in _sections(cubin)}
    symbols, names = sections[".symtab"][0], sections[".strtab"][0]
    starts = [struct.unpack_from("<I", symbols, 24 * i)[0] for i in range(len(symbols) // 24)]
    by_symbol = [names[start : names.index(b"\0", start)].decode() for start in starts]
    found: dict[str, dict[int, int]] = {}
    for attribute, symbol, value in _attributes(sections[".nv.info"][0]):
        found.setdefault(by_symbol[symbol], {})[attribute] = value
    shared = {
        name.removeprefix(".nv.shared."): length for name, (_, length) in sections.items() if ".nv.shared." in name
    }
    return {
        name: (values.get(REGISTERS, 0), shared.get(name, 0), values.get(FRAME_SIZE, 0))
        for name, values in found.items()
        if f".text.{name}" in sections
    }


def compiled(module: wp.Module, architectures: Sequence[int]) -> Iterator[tuple[str, int, bytes]]:
    """Compile a module and yield its name, the architecture and the binary of each.

    A module may come out as several binaries per architecture.
    """
    name = module.name.removeprefix("mgavatar.kernels.")
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(module, arch=list(architectures), module_dir=folder, use_ptx=False)
        for path in sorted(Path(folder).glob("*.cubin")):
            architecture = path.name.split(".sm")[-1].split(".")[0]
            yield name, int(architecture), path.read_bytes()


def modules() -> list[wp.Module]:
    """Import every file of kernels and return the Warp modules that have kernels."""
    folder = Path(mgavatar.kernels.__file__).parent
    for path in sorted(folder.glob("*.py")):
        if path.stem != "__init__":
            importlib.import_module(f"mgavatar.kernels.{path.stem}")
    return [module for module in user_modules.values() if module.name.startswith("mgavatar.kernels") and module.kernels]


def cuda_usage(*, architectures: tuple[int, ...] = (90,)) -> str:
    """Compile every kernel for CUDA and return a Markdown table of what it takes.

    Args:
        architectures: Compute capabilities to compile for, for example 75 90.
    """
    rows = []
    for module in modules():
        for module_name, architecture, cubin in compiled(module, architectures):
            for name, numbers in sorted(usage(cubin).items()):
                kernel = name.removeprefix("_kernels__locals__").split("_kernel_")[0].strip("_")
                rows.append([f"{module_name}: {kernel}", str(architecture), *map(str, numbers)])
    return markdown_table(["kernel", "arch", "registers", "shared bytes", "local bytes"], rows)


if __name__ == "__main__":
    run(cuda_usage)
