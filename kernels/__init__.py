"""Warp kernels, their host functions, and the one bridge to torch.

The folder is installed as ``mgavatar.kernels``: a package called ``kernels`` by other people exists on the index.
"""

import os
import sys
import tempfile

import warp as wp

if __name__ != "mgavatar.kernels":
    raise ImportError("import mgavatar.kernels, not kernels: install the project first (pip install -e .)")

_NO_GPU = b"Could not find or load the NVIDIA CUDA driver"


def _init_warp() -> None:
    """Start Warp without the line that its native part writes to stderr on machines that have no GPU."""
    wp.config.log_level = 40
    try:
        kept = os.dup(2)
    except OSError:  # the process has no stderr (a service, pythonw, 2>&-): nothing to hide
        wp.init()
        return
    if sys.stderr is not None and not sys.stderr.closed:
        sys.stderr.flush()
    with tempfile.TemporaryFile() as captured:
        os.dup2(captured.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        captured.seek(0)
        others = [line for line in captured if _NO_GPU not in line]
    # To the file descriptor, where the native part meant them to go: sys.stderr may be None.
    os.write(2, b"".join(others))


_init_warp()
