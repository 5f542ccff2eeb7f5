"""Every kernel compiles for CUDA: the compiler is in Warp's wheel, so this needs no GPU."""

import importlib
from pathlib import Path

import pytest
import warp as wp

import mgavatar.kernels

FOLDER = Path(mgavatar.kernels.__file__).parent
FILES = sorted(path.stem for path in FOLDER.glob("*.py") if not path.stem.startswith("_"))
ARCHITECTURES = [75, 90]  # the oldest that Warp 1.19 knows, and an H100


def modules_of(file: str) -> list[wp.Module]:
    """The Warp modules that hold a file's kernels; a file without kernels has none."""
    name = importlib.import_module(f"mgavatar.kernels.{file}").__name__
    known = wp._src.context.user_modules.values()
    return [m for m in known if any(kernel.func.__module__ == name for kernel in m.kernels.values())]


@pytest.mark.parametrize("file", FILES)
def test_kernels_compile_for_cuda(file, tmp_path):
    """PTX or binary code comes out for each architecture and each module of the file."""
    for module in modules_of(file):
        wp.compile_aot_module(module, arch=ARCHITECTURES, module_dir=tmp_path / module.name)
        built = [p for p in (tmp_path / module.name).iterdir() if p.suffix in {".ptx", ".cubin"}]
        assert len(built) == len(ARCHITECTURES), f"{module.name}: {sorted(p.name for p in built)}"


def test_files_with_kernels_are_found():
    """The parametrised test above is not empty: files that are known to hold kernels do."""
    expected = {
        "sparse": 2, "blend": 2, "joints": 1, "lbs": 2, "face_frames": 2, "binding": 2, "uv_map": 1, "hash_grid": 2,
    }  # fmt: skip
    assert {file: len(modules_of(file)) for file in expected} == expected
