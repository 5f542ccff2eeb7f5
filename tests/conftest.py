"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

DATA = Path(os.environ.get("MGAVATAR_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
"""Real sample data; it is not part of the project, so tests that want it say when it is absent."""


def pytest_configure(config: pytest.Config) -> None:
    if "PYTEST_XDIST_WORKER" in os.environ:
        torch.set_num_threads(1)


def pytest_report_header(config: pytest.Config) -> str:
    return f"real sample data: {DATA if DATA.is_dir() else 'absent, its tests are skipped'}"


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)] if torch.cuda.is_available() else ["cpu"])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Every device that this machine has."""
    return torch.device(request.param)


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
