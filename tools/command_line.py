"""Run a typed function as the command line of a script in ``tools/``."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import tyro

from mgavatar.errors import DataError


def run(function: Callable[..., str | None]) -> None:
    """Parse the command line by the signature of ``function``, call it and print the text that it returns.

    Exit codes: 0 done, 1 the data is wrong, 2 the command line is wrong, 130 interrupted, 141 the reader has left.
    """
    script = Path(sys.argv[0]).name
    try:
        _print_result(function, prog=f"python tools/{script}")
    except DataError as error:
        print(f"{script}: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except BrokenPipeError:
        # Python flushes once more at exit: into nothing, instead of a second error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None


def _print_result(function: Callable[..., str | None], *, prog: str) -> None:
    try:
        text = tyro.cli(function, prog=prog)
        if text is not None:
            print(text)
    finally:
        sys.stdout.flush()  # after --help too: a broken pipe shows here, not at exit
