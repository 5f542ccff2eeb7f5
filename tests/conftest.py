"""Fixtures shared by all tests."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import torch

if TYPE_CHECKING:
    from mgavatar.capture.subject import Subject
    from mgavatar.fitting.views import Views

DATA = Path(os.environ.get("MGAVATAR_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
"""Real sample data; it is not part of the project, so tests that want it say when it is absent."""


_OPEN_FILES = Path("/proc/self/fd")


def pytest_configure(config: pytest.Config) -> None:
    if "PYTEST_XDIST_WORKER" in os.environ:
        torch.set_num_threads(1)


def pytest_report_header(config: pytest.Config) -> str:
    return f"real sample data: {DATA if DATA.is_dir() else 'absent, its tests are skipped'}"


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)] if torch.cuda.is_available() else ["cpu"])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Every device that this machine has."""
    return torch.device(request.param)


@pytest.fixture(autouse=True)
def _windows_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse to remove or replace a file that this process has open, as Windows does, also where Linux would not."""
    if not _OPEN_FILES.is_dir():
        return

    def refusing(call: Callable[..., None]) -> Callable[..., None]:
        def checked(*args: Any, **kwargs: Any) -> None:
            for path in args[:2]:
                if os.path.realpath(path) in _open_files():
                    raise PermissionError(13, "open in this process, which Windows does not allow", str(path))
            call(*args, **kwargs)

        return checked

    for name in ("remove", "rename", "replace", "unlink"):
        monkeypatch.setattr(os, name, refusing(getattr(os, name)))


def _open_files() -> set[str]:
    found = set()
    for descriptor in os.listdir(_OPEN_FILES):
        with contextlib.suppress(OSError):  # the listing itself is closed by now
            found.add(os.readlink(_OPEN_FILES / descriptor))
    return found


@pytest.fixture
def rng() -> torch.Generator:
    """A seeded generator on the CPU: draw there, then move."""
    return torch.Generator().manual_seed(7)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real sample data."""
    if not DATA.is_dir():
        pytest.skip("the real sample data is not beside the project (set MGAVATAR_DATA)")
    return DATA


# Both import inside: Warp takes two seconds to start, and not every run of the tests needs it.
@pytest.fixture(scope="session")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Subject:
    """The tiny subject: a stretched ball in three poses, and a fourth that is held out. Only to be read."""
    from tiny import tiny_subject

    return tiny_subject(tmp_path_factory.mktemp("tiny") / "capture")


@pytest.fixture(scope="session")
def views(subject: Subject) -> Views:
    """Its training images."""
    from mgavatar.fitting.views import Views

    return Views.of(subject, 64, with_masks=False)
