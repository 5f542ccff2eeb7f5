"""The documentation holds together: links and commands work, code names pages that exist, prose has 100 columns."""

from __future__ import annotations

import functools
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from mgavatar import cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
SOURCES = [
    path
    for folder in ("mgavatar", "kernels", "configs", "tools", "tests")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in (".py", ".toml")
]

LINK = re.compile(r"\]\((?P<target>[^)\s]+)\)")
MENTION = re.compile(r"docs/[\w./-]+\.(?:md|json|png|jpg|gif)")
COLUMNS = 100


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(page: Path) -> Iterator[str]:
    """Yield the relative links of a page that lead to no file or to no heading."""
    for match in LINK.finditer(page.read_text("utf-8")):
        target, _, anchor = match["target"].partition("#")
        if "://" in target:
            continue
        found = (page.parent / target).resolve() if target else page
        if not found.exists() or (anchor and anchor not in anchors(found)):
            yield match["target"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    """Files exist, and anchors are headings of them."""
    assert list(broken_links(page)) == []


def test_a_broken_link_is_found(tmp_path):
    """A missing file and a missing heading; a heading of the same page and an address are no matter."""
    (tmp_path / "other.md").write_text("# Eq. 5 and 6, `auto`\n")
    page = tmp_path / "page.md"
    page.write_text(
        "# Here\n[a](gone.md) [b](other.md#eq-5-and-6-auto) [c](other.md#eq-7) [d](#here) [e](https://a.b/c)\n"
    )
    assert list(broken_links(page)) == ["gone.md", "other.md#eq-7"]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_that_code_names_exist(path):
    """A moved page leaves no old name behind in a docstring, a message or a preset."""
    missing = [name for name in MENTION.findall(path.read_text("utf-8")) if not (ROOT / name).is_file()]
    assert missing == []


def prose(page: Path) -> Iterator[tuple[int, str]]:
    """Yield number and text of the lines that can be wrapped: no table, no code, no picture."""
    fenced = False
    for number, line in enumerate(page.read_text("utf-8").splitlines(), start=1):
        if line.startswith("```"):
            fenced = not fenced
        elif not fenced and not line.startswith(("|", "    ", "![")):
            yield number, line


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.parent != ROOT and page.name != "formats.md"],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_prose_has_100_columns(page):
    """Longer lines are hard to review; tables, code and pictures cannot be wrapped."""
    assert [number for number, line in prose(page) if len(line) > COLUMNS] == []


def test_every_page_of_the_lab_is_in_its_index():
    """The journal's own table of contents."""
    index = (ROOT / "docs/lab/README.md").read_text("utf-8")
    pages = {path.name for path in (ROOT / "docs/lab").glob("*.md")} - {"README.md"}
    assert {name for name in pages if f"]({name})" not in index} == set()


COMMANDS = re.compile(
    r"^ {4}(?:\.venv/bin/)?(?P<program>mgavatar|python tools/\w+\.py) (?P<rest>(?:.*\\\n)*.*)$", re.MULTILINE
)
"""Commands in code blocks; a backslash at the end of a line continues it."""


def commands(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield program and words of the commands of a page, without comments and the brackets of what is optional."""
    for match in COMMANDS.finditer(page.read_text("utf-8")):
        line = re.sub(r"  +#.*|\\\n|[\[\]]", "", match["rest"])
        yield match["program"], ["1" if word == "N" else word for word in shlex.split(line)]


CALLS = [words for page in PAGES for program, words in commands(page) if program == "mgavatar"]
SCRIPTS = [(program, words) for page in PAGES for program, words in commands(page) if program != "mgavatar"]


@pytest.fixture
def parse(monkeypatch):
    """Parse the words of a command with mgavatar's command line, without running it; return the exit code."""

    def inert(command):
        return functools.wraps(command)(lambda *args, **kwargs: None)

    monkeypatch.setattr(cli, "_COMMANDS", {name: inert(command) for name, command in cli._COMMANDS.items()})
    monkeypatch.setattr("mgavatar.benchmarks.kernels.bench_kernels", lambda **options: "")

    def run(words: list[str]) -> int:
        monkeypatch.setattr("sys.argv", ["mgavatar", *words])
        try:
            cli.main()
        except SystemExit as stop:
            return int(stop.code or 0)
        return 0

    return run


@pytest.mark.parametrize("words", CALLS, ids=" ".join)
def test_commands_are_understood(words, parse, capsys):
    """Each command parses as the page has it."""
    assert parse([word for word in words if word != "FLAGS"]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("words", [["fit", "--data", "D", "--colour", "x"], ["bench", "trade"], ["fit", "--seed", "x"]])
def test_a_wrong_command_is_found(words, parse):
    """The check above can fail."""
    assert parse(words) == 2


@pytest.mark.parametrize(
    ("program", "words"), SCRIPTS, ids=lambda part: part if isinstance(part, str) else " ".join(part)
)
def test_scripts_have_the_flags(program, words):
    """The script exists, and it knows each flag."""
    source = (ROOT / program.removeprefix("python ")).read_text("utf-8")
    for word in words:
        if word.startswith("--"):
            assert word in source or word.removeprefix("--").replace("-", "_") in source


def test_commands_are_found(tmp_path):
    """Comments, continued lines and brackets; log lines are no commands."""
    page = tmp_path / "page.md"
    page.write_text(
        "    .venv/bin/mgavatar fit --data D      # a comment\n"
        "    python tools/ablate.py --out O \\\n        --presets a b\n"
        "    mgavatar bench kernels [--threads N]\n"
        "    mgavatar: plan: nothing\n"
    )
    assert list(commands(page)) == [
        ("mgavatar", ["fit", "--data", "D"]),
        ("python tools/ablate.py", ["--out", "O", "--presets", "a", "b"]),
        ("mgavatar", ["bench", "kernels", "--threads", "1"]),
    ]
    assert CALLS
    assert SCRIPTS
