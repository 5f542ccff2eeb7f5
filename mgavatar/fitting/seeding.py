"""Initial parameters from a random stream of their own."""

from __future__ import annotations

import threading

import torch

_LOCK = threading.RLock()
"""Only one fit of a process may borrow torch's global generator at a time."""


class ParameterInit:
    """Draw initial parameters from one stream per fit; torch's global generator is as before after each ``with``.

    Modules draw from torch's global generator and take no other. Inside the ``with`` block it runs on this stream,
    which the next block continues.
    """

    def __init__(self, seed: int) -> None:
        """Start the stream at a seed."""
        self._state = torch.Generator().manual_seed(seed).get_state()

    def __enter__(self) -> None:
        _LOCK.acquire()
        self._outside = torch.get_rng_state()
        torch.set_rng_state(self._state)

    def __exit__(self, *_: object) -> None:
        self._state = torch.get_rng_state()
        torch.set_rng_state(self._outside)
        _LOCK.release()
