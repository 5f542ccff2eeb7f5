"""``import mgavatar.kernels`` in processes that lack standard streams, as services and pythonw do."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

IMPORT = "import mgavatar.kernels, pathlib, sys; pathlib.Path(sys.argv[1]).write_text('imported')"


def run(code: str, *arguments: str, redirect: str = "") -> subprocess.CompletedProcess[bytes]:
    """Run ``code`` in a new interpreter, below a shell that redirects its streams."""
    command = ["sh", "-c", f'exec "$@" {redirect}', "sh", sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, timeout=120)


@pytest.mark.parametrize("redirect", ["2>&-", "1>&-", "0<&- 1>&- 2>&-"])
@pytest.mark.skipif(sys.platform == "win32", reason="closes streams with a POSIX shell")
def test_import_works_with_closed_file_descriptors(redirect, tmp_path):
    """The file proves that the code ran to its end: without a stderr nothing else could say so."""
    done = run(IMPORT, str(tmp_path / "done"), redirect=redirect)
    assert done.returncode == 0
    assert Path(tmp_path / "done").read_text() == "imported"


@pytest.mark.parametrize("streams", ["sys.stderr = None", "sys.stdout = sys.stderr = None", "sys.stderr.close()"])
def test_import_works_without_python_streams(streams, tmp_path):
    """pythonw sets the streams to None; some hosts close them."""
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {streams}; {IMPORT}", str(tmp_path / "done")],
        capture_output=True,
        timeout=120,
    )
    assert done.returncode == 0
    assert Path(tmp_path / "done").read_text() == "imported"


@pytest.mark.skipif(sys.platform == "win32", reason="writes through a POSIX file descriptor")
def test_import_is_silent_and_keeps_stderr(tmp_path):
    """Warp's line about a missing GPU is dropped; what is written afterwards arrives."""
    code = "import mgavatar.kernels, os; os.write(2, b'still here')"
    done = run(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"still here")
