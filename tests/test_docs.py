"""The documentation holds together: links, commands, flags and quoted messages are those of the program today."""

from __future__ import annotations

import ast
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_prose_has_100_columns(page):
    """Longer lines are hard to review; tables, code and pictures cannot be wrapped."""
    assert [number for number, line in prose(page) if len(line) > COLUMNS] == []


def linked_pages(page: Path) -> set[Path]:
    """Return the pages of the project that a page links to."""
    targets = [match["target"].partition("#")[0] for match in LINK.finditer(page.read_text("utf-8"))]
    return {path for target in targets if target and (path := (page.parent / target).resolve()) in PAGES}


def test_every_page_is_reached_from_the_index():
    """And the index from the README: nobody has to search the folder."""
    index = ROOT / "docs/index.md"
    reached, waiting = set(), [index]
    while waiting:
        page = waiting.pop()
        if page not in reached:
            reached.add(page)
            waiting += linked_pages(page)
    assert {page for page in PAGES if page.parent != ROOT} - reached == set()
    assert index in linked_pages(ROOT / "README.md")


@pytest.mark.parametrize("index", ["docs/index.md", "docs/lab/README.md"])
def test_an_index_has_every_page_beside_it(index):
    """One line per page of its folder."""
    index = ROOT / index
    assert set(index.parent.glob("*.md")) - {index} <= linked_pages(index)


def python_blocks(page: Path) -> list[str]:
    """Return the Python examples of a page."""
    return re.findall(r"^```python\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)


def test_the_readme_has_the_first_example_of_the_python_page():
    """That one runs in another test."""
    assert python_blocks(ROOT / "README.md") == python_blocks(ROOT / "docs/python.md")[:1]


def texts(folder: Path) -> set[str]:
    """Return the literal parts of all strings in a folder's code, among them the fixed words of every message."""
    trees = [ast.parse(path.read_text("utf-8")) for path in folder.rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    return {node.value.replace("%%", "%") for node in nodes if isinstance(node.value, str)}


def test_quoted_messages_are_the_programs():
    """A message that was reworded is reworded where the docs explain it; ``...`` stands for what varies."""
    page = (ROOT / "docs/your-capture.md").read_text("utf-8")
    messages = re.findall(r"^\| `(\.\.\. [^`]+)` \|", page, re.MULTILINE)
    assert len(messages) >= 10
    known = texts(ROOT / "mgavatar")
    for message in messages:
        for part in filter(None, (part.strip() for part in message.split("..."))):
            assert any(part in text for text in known), message


COMMANDS = re.compile(
    r"^ {4}(?:\.venv/bin/)?(?P<program>mgavatar|python tools/\w+\.py) (?P<rest>(?:.*\\\n)*.*)$", re.MULTILINE
)
"""Commands in code blocks; a backslash at the end of a line continues it."""


def commands(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield program and words of the commands of a page, without comments and the brackets of what is optional."""
    for match in COMMANDS.finditer(page.read_text("utf-8")):
        line = re.sub(r"  +#.*|\\\n|[\[\]]", "", match["rest"])
        yield match["program"], ["1" if word == "N" else word for word in shlex.split(line)]


ALL = {(program, *words) for page in PAGES for program, words in commands(page)}
CALLS = sorted(words for program, *words in ALL if program == "mgavatar")
SCRIPTS = sorted((program, words) for program, *words in ALL if program != "mgavatar")


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


CODE = re.compile(r"`([^`\n]+)`")
FLAG = re.compile(r"(?<![\w-])--[a-z][\w.-]*")


def known_flags(capsys, monkeypatch) -> set[str]:
    """Return the flags of all commands, by their help texts, and of all tools, by their parameters."""
    flags = {"--version"}
    for command in cli._COMMANDS:
        for wanted in ("--help", "--help-all") if command in ("fit", "demo") else ("--help",):
            monkeypatch.setattr("sys.argv", ["mgavatar", command, wanted])
            with pytest.raises(SystemExit):
                cli.main()
        flags |= set(FLAG.findall(capsys.readouterr().out))
    for script in (ROOT / "tools").glob("*.py"):
        for node in ast.walk(ast.parse(script.read_text("utf-8"))):
            is_field = isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
            name = node.arg if isinstance(node, ast.arg) else node.target.id if is_field else ""
            flags.add(f"--{name.replace('_', '-')}")
    return flags


def test_flags_in_the_text_exist(capsys, monkeypatch):
    """A flag that was renamed is renamed in every sentence."""
    known = known_flags(capsys, monkeypatch)
    assert {"--budget", "--geometry.lambda-laplacian", "--camera", "--seeds"} <= known
    for page in PAGES:
        for code in CODE.findall(page.read_text("utf-8")):
            if not code.startswith("pip "):
                assert set(FLAG.findall(code)) <= known, f"{page.name}: {code}"
