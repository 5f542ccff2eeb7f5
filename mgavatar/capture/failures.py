"""Frames of a capture that cannot be used: left out by ``--skip-bad``, or else the reason to refuse it."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

from mgavatar.errors import DataError

log = logging.getLogger("mgavatar")


@dataclass
class Failures:
    """Frames or timesteps that cannot be used.

    Attributes:
        root: The capture.
        skip: Leave them out instead of refusing the capture.
        found: What is wrong, by their names.
    """

    root: Path
    skip: bool
    found: dict[str, DataError] = field(default_factory=dict)

    def settle(self, n_good: int, kind: str) -> None:
        """Log what is left out, or refuse the capture because of the first failure.

        Args:
            n_good: Number of those without a failure.
            kind: Word for them in messages.
        """
        if not self.found:
            return
        first = next(iter(self.found.values()))
        if not self.skip or not n_good:
            # Where most fail, the capture is to blame and not a frame of it.
            hint = "; --skip-bad leaves such frames out" if len(self.found) <= n_good and not self.skip else ""
            raise DataError(f"{first}{hint}")
        names = ", ".join(list(self.found)[:3]) + (", …" if len(self.found) > 3 else "")
        log.warning(
            "%s: %d %s are left out: %s; the first because of %s", self.root, len(self.found), kind, names, first
        )
        self.found.clear()
