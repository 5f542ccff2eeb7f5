"""``tools/command_line.py``: exit codes of the scripts in tools/."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import command_line
import pytest

from mgavatar.errors import DataError

TOOLS = Path(__file__).resolve().parents[1] / "tools"


def exit_code(monkeypatch, function, *flags):
    """Run a function as a script; return its exit code."""
    monkeypatch.setattr("sys.argv", ["tools/script.py", *flags])
    try:
        command_line.run(function)
    except SystemExit as stop:
        return stop.code
    return 0


def test_the_text_is_printed(monkeypatch, capsys):
    """Flags reach the function, and its text goes to the output."""

    def double(*, number: int = 1) -> str:
        """Double a number."""
        return f"{2 * number}"

    assert exit_code(monkeypatch, double, "--number", "4") == 0
    assert capsys.readouterr().out == "8\n"
    assert exit_code(monkeypatch, double, "--factor", "4") == 2
    assert "--factor" in capsys.readouterr().err


@pytest.mark.parametrize(("error", "code"), [(DataError("a.json: no such file"), 1), (KeyboardInterrupt(), 130)])
def test_errors_become_exit_codes(monkeypatch, capsys, error, code):
    """What the user can mend is one line; an interrupt says nothing."""

    def fail() -> str:
        """Fail."""
        raise error

    assert exit_code(monkeypatch, fail) == code
    assert capsys.readouterr().err == ("script.py: a.json: no such file\n" if code == 1 else "")


@pytest.mark.parametrize("flags", [["--help"], ["--text", "word"]])
def test_a_reader_that_has_left_is_no_traceback(flags):
    """As in ``python tools/... | head -1``."""
    source = "import command_line\n\n\ndef say(*, text: str) -> str:\n    return text\n\n\ncommand_line.run(say)"
    command = [sys.executable, "-c", source, *flags]
    with subprocess.Popen(command, cwd=TOOLS, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as script:
        assert script.stdout is not None
        script.stdout.close()
        assert script.stderr is not None
        assert script.stderr.read() == ""
    assert script.returncode == 141
