"""Warp kernels, their host functions, and the one bridge to torch.

The folder is installed as ``mgavatar.kernels``: a package called ``kernels`` by other people exists on the index.
"""

import os
import sys
import tempfile

import warp as wp

if __name__ != "mgavatar.kernels":
    raise ImportError("import mgavatar.kernels, not kernels: install the project first (pip install -e .)")


def _init_warp() -> None:
    """Start Warp without the line that its native part writes on machines that have no GPU, which are no mistake."""
    wp.config.log_level = 40
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        said.seek(0)
        for line in said.read().decode(errors="replace").splitlines():
            if "Could not find or load the NVIDIA CUDA driver" not in line:
                print(line, file=sys.stderr)


_init_warp()
