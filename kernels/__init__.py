"""Warp kernels, their host functions, and the one bridge to torch.

The folder is installed as ``mgavatar.kernels``: a package called ``kernels`` by other people exists on the index.
"""

import warp as wp

if __name__ != "mgavatar.kernels":
    raise ImportError("import mgavatar.kernels, not kernels: install the project first (pip install -e .)")

wp.config.log_level = 40
wp.init()
