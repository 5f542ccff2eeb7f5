"""Make the tables of measured results, in Markdown, from docs/results.json.

    python tools/results_table.py --write     # fill docs/quality-and-speed.md and README.md
    python tools/results_table.py --readme    # print the README's table

A page says where a table belongs by two markers, each on a line of its own:

    <!-- results:begin comparison -->
    <!-- results:end -->

Between them stands the table of that name; without a name, the README's.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from command_line import run

from mgavatar.errors import DataError
from mgavatar.files import atomic_write, read_json
from mgavatar.reporting.markdown import markdown_table

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results.json"
PAGES = (ROOT / "docs" / "quality-and-speed.md", ROOT / "README.md")

Results = dict[str, Any]
Row = dict[str, Any]

_BLOCK = re.compile(r"^<!-- results:begin ?(?P<name>\S*) -->\n.*?^<!-- results:end -->$", re.MULTILINE | re.DOTALL)
_NOT_MEASURED = "–"


def table(results: Results, name: str) -> str:
    """Return one table in Markdown.

    Raises:
        DataError: If there is no table of that name.
    """
    if name not in TABLES:
        raise DataError(f"results: there is no table {name}; there are {', '.join(TABLES)}")
    return TABLES[name](results)


def filled(text: str, results: Results, *, where: str) -> str:
    """Return a page with its tables replaced by those of ``results``.

    Args:
        text: The page, Markdown.
        results: Contents of docs/results.json.
        where: Name of the page for messages.

    Raises:
        DataError: If a marker lacks its counterpart, or names no table.
    """
    begins, ends = text.count("<!-- results:begin"), text.count("<!-- results:end -->")
    if not begins == ends == len(_BLOCK.findall(text)):
        raise DataError(f"{where}: has {begins} markers results:begin and {ends} results:end; each needs the other")

    def block(match: re.Match[str]) -> str:
        first_line = match[0].partition("\n")[0]
        return f"{first_line}\n\n{table(results, match['name'] or 'readme')}\n\n<!-- results:end -->"

    return _BLOCK.sub(block, text)


def _fits(results: Results, table_name: str) -> list[Row]:
    """Return the fits that a table shows, capture by capture."""
    captures = list(results["captures"])
    rows = [row for row in results["fits"]["rows"] if table_name in row["tables"]]
    return sorted(rows, key=lambda row: captures.index(row["capture"]))


def _fit_table(results: Results, name: str) -> str:
    """Compare the fits of each capture with the first of them: in brackets the difference of its PSNR."""
    header = ["capture", "preset", "fits", "novel view: PSNR, SSIM", "self-reenactment: PSNR, SSIM"]
    header += ["face", "face+scalp", "all seen", "flipped", "new crossings", "Gaussians", "iterations", "s", "MiB"]
    firsts: dict[str, Row] = {}
    lines = []
    for row in _fits(results, name):
        first = firsts.setdefault(row["capture"], row)
        scores = [_score(row[split], first[split], brackets=row is not first) for split in ("val", "test")]
        lines.append([row["capture"], f"`{row['preset']}`", str(row["fits"]), *scores, *_distances(row), *_cost(row)])
    return markdown_table(header, lines)


def _score(score: Row, reference: Row, *, brackets: bool) -> str:
    spread = f" ± {score['psnr_sd']:.2f}" if "psnr_sd" in score else ""
    difference = f" ({score['psnr'] - reference['psnr']:+.2f})" if brackets else ""
    ssim = f", {score['ssim']:.3f}" if "ssim" in score else ""
    return f"{score['psnr']:.2f}{spread}{difference}{ssim}"


def _distances(row: Row) -> Iterator[str]:
    for region in ("face", "face+scalp", "all"):
        yield f"{row['mm'][region]:.2f}" if region in row["mm"] else _NOT_MEASURED
    yield from (_count(row, "flipped_faces"), _count(row, "new_crossings"))


def _cost(row: Row) -> Iterator[str]:
    yield _count(row, "gaussians")
    yield " + ".join(f"{count:,}" for count in row["iterations"])
    yield from (_count(row, "seconds"), _count(row, "peak_mib"))


def _count(row: Row, key: str) -> str:
    return f"{row[key]:,}" if key in row else _NOT_MEASURED


def _readme(results: Results) -> str:
    header = ["capture", "preset, one CPU core", "novel view", "self-reenactment", "GaussianAvatars' recipe, same time"]
    by_preset = {(row["capture"], row["preset"]): row for row in results["fits"]["rows"]}
    lines = []
    for row in (row for row in results["fits"]["rows"] if "readme" in row["tables"]):
        baseline = by_preset.get((row["capture"], f"{row['preset']},baseline"))
        lines.append(
            [
                _title(results, row),
                f"`{row['preset']}`, {_duration(row)}",
                *(f"{row[split]['psnr']:.1f} dB" for split in ("val", "test")),
                _NOT_MEASURED
                if baseline is None
                else " / ".join(f"{baseline[s]['psnr']:.1f}" for s in ("val", "test")),
                _closest_region(row),
            ]
        )
    return markdown_table([*header, "mesh to ground truth"], lines)


def _title(results: Results, row: Row) -> str:
    capture = results["captures"][row["capture"]]
    width, height = capture["size"]
    return f"{capture['title']}, {width} x {height}"


def _closest_region(row: Row) -> str:
    region = "face+scalp" if "face+scalp" in row["mm"] else "face"
    return f"{region.replace('+', ' and ')} {row['mm'][region]:.2f} mm"


def _duration(row: Row) -> str:
    seconds = row["budget_s"] or row["seconds"]
    return f"{seconds} s" if seconds < 300 else f"{seconds / 60:.0f} min"


def _steps(results: Results) -> str:
    rows = results["steps"]["rows"]
    cells = [[row["preset"], row["stage"], row["work"], _milliseconds(row["step_ms"])] for row in rows]
    per_second = [f"{1e3 / row['step_ms']:.1f}" for row in rows]
    lines = [[*line, rate] for line, rate in zip(cells, per_second, strict=True)]
    return markdown_table(["size of", "stage", "work", "one step", "steps per second"], lines)


def _kernels(results: Results) -> str:
    header = ["kernel", "work", "threads", "forward", "backward", "x floor", "plain / it"]
    lines = [
        [
            row["name"],
            row["work"],
            str(row["threads"]),
            _milliseconds(row["forward_ms"]),
            _milliseconds(row["backward_ms"]),
            f"{row['over_floor']:.1f}",
            f"{row['plain_over_kernel']:.1f}",
        ]
        for row in results["kernels"]["rows"]
    ]
    return markdown_table(header, lines)


def _milliseconds(value: float) -> str:
    return f"{value:.3g} ms"


def _accuracy(results: Results) -> str:
    header = ["level", "alpha threshold", "stop", "time", "image", "gradient of the means", "for"]
    lines = [
        [
            f"`{row['level']}`",
            row["alpha_threshold"],
            row["stop"],
            f"{row['time']:.2f} x",
            f"{row['psnr']:.0f} dB",
            f"{100 * row['gradient']:.2g} %" if row["gradient"] > 1e-3 else f"{row['gradient']:.1e}",
            row["use"],
        ]
        for row in results["accuracy"]["rows"]
    ]
    return markdown_table(header, lines)


def _conditions(results: Results) -> str:
    """Say for each part of the results on which machine, when and from which commit they were measured."""
    lines = []
    for part in ("fits", "steps", "kernels", "accuracy"):
        measured = results[part]
        commits = dict.fromkeys(row["commit"] for row in measured["rows"]) if part == "fits" else [measured["commit"]]
        lines.append([part, measured["machine"], measured["date"], ", ".join(commits)])
    return markdown_table(["results", "machine", "date", "commit"], lines)


TABLES: dict[str, Callable[[Results], str]] = {
    "readme": _readme,
    "conditions": _conditions,
    "comparison": lambda results: _fit_table(results, "comparison"),
    "ablations": lambda results: _fit_table(results, "ablations"),
    "presets": lambda results: _fit_table(results, "presets"),
    "steps": _steps,
    "kernels": _kernels,
    "accuracy": _accuracy,
}
"""Every table by the name that its marker gives."""


def results_table(*, readme: bool = False, write: bool = False, results: Path = RESULTS) -> str:
    """Print the tables of measured results, or write them into the pages that show them.

    Args:
        readme: Print the README's table alone.
        write: Replace the tables between the markers of docs/quality-and-speed.md and README.md.
        results: JSON file with the measured rows.

    Returns:
        The tables, or the names of the pages that changed.

    Raises:
        DataError: If the file cannot be read, or a page has a marker that cannot be filled.
    """
    measured = read_json(results)
    if readme:
        return table(measured, "readme")
    if not write:
        return "\n\n".join(f"{name}:\n\n{table(measured, name)}" for name in TABLES)
    return "\n".join(_written(PAGES, measured)) or "all pages are up to date"


def _written(pages: Iterable[Path], results: Results) -> Iterator[str]:
    for page in pages:
        before = page.read_text("utf-8")
        after = filled(before, results, where=page.name)
        if after != before:
            with atomic_write(page) as file:
                file.write(after.encode())
            yield f"{page.relative_to(ROOT)}: written"


if __name__ == "__main__":
    run(results_table)
