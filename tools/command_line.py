"""Run a typed function as the command line of a script in ``tools/``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import tyro

from mgavatar.errors import DataError


def run(function: Callable[..., str | None]) -> None:
    """Parse the command line by the signature of ``function``, call it and print the text that it returns.

    Exit codes: 0 done, 1 the data is wrong, 2 the command line is wrong, 130 interrupted.
    """
    script = Path(sys.argv[0]).name
    try:
        text = tyro.cli(function, prog=f"python tools/{script}")
    except DataError as error:
        print(f"{script}: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    if text is not None:
        print(text)
