"""Fit presets to captures under equal conditions and compare them in a table and a contact sheet.

    python tools/ablate.py --presets quick quick,baseline quick,no-laplacian --captures DIR[:HEAD.npz] ... --out DIR

A cell is one preset on one capture from one seed: a `mgavatar fit` and a `mgavatar evaluate`, each in a process of its
own. Finished cells are kept, an interrupted fit is resumed, and a failed one is reported and tried again by the next
call. --out gets

* table.md with the means over the seeds,
* table.json with every cell,
* sheet.png of the first seed,
* one folder per cell with its run, its log and its metrics.json.

Seconds and memory are those of the fit alone. A --budget runs from the start of the process, and the first fit after a
change of the kernels compiles them. For equal time, fit once before.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from mgavatar.errors import DataError
from mgavatar.files import append_line, atomic_write, make_folder, write_json, write_text, writing
from mgavatar.presets import preset_table
from mgavatar.reporting.markdown import markdown_table

# Nothing heavy is imported before the last fit has ended: a child's peak memory is at least that of its parent.

MGAVATAR = (sys.executable, "-c", "from mgavatar.cli import main; main()")
Row = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """Settings that all cells share."""

    out: Path
    seeds: Sequence[int] = (0,)
    budget: str | None = None
    device: str = "auto"
    lpips_weights: Path | None = None


@dataclass(frozen=True)
class Cell:
    """One preset on one capture from one seed."""

    preset: str
    data: Path
    head_model: Path | None
    seed: int
    options: Options

    @property
    def capture(self) -> str:
        """Return the name of the capture."""
        return self.data.resolve().name

    @property
    def name(self) -> str:
        """Return the preset as part of a path."""
        return "+".join(Path(part).stem if part.endswith(".toml") else part for part in self.preset.split(","))

    @property
    def folder(self) -> Path:
        """Return the folder of the cell."""
        return self.options.out / self.capture / self.name / f"seed{self.seed}"

    @property
    def run(self) -> Path:
        """Return the folder of the fit."""
        return self.folder / "run"

    @property
    def metrics(self) -> Path:
        """Return the path of the scores."""
        return self.folder / "metrics.json"

    @property
    def summary(self) -> Path:
        """Return the path of the fit's summary."""
        return self.run / "summary.json"

    def conditions(self) -> dict[str, Any]:
        """Return the conditions that an existing cell must have been made under."""
        return {
            "preset": preset_table(self.preset),
            "data": str(self.data.resolve()),
            "head_model": str(self.head_model.resolve()) if self.head_model else None,
            "seed": self.seed,
            "budget": self.options.budget,
            "device": self.options.device,
        }

    def fit_command(self, *, resume: bool) -> list[str]:
        """Return the arguments of mgavatar that fit the cell."""
        o = self.options
        command = ["fit", "--data", str(self.data), "--out", str(self.run), "--preset", self.preset]
        command += ["--seed", str(self.seed), "--device", o.device]
        command += ["--head-model", str(self.head_model)] if self.head_model else []
        command += ["--budget", o.budget] if o.budget else []
        return command + (["--resume"] if resume else [])

    def evaluate_command(self) -> list[str]:
        """Return the arguments of mgavatar that score the cell."""
        o = self.options
        command = ["evaluate", "--avatar", str(self.run), "--data", str(self.data), "--json", str(self.metrics)]
        return [*command, "--device", o.device, *(["--lpips-weights", str(o.lpips_weights)] if o.lpips_weights else [])]


def plan_cells(presets: Sequence[str], captures: Sequence[str], options: Options) -> list[Cell]:
    """Return all cells, capture by capture, after the checks that need no work.

    Raises:
        DataError: If a preset or a folder does not exist, two have one name, or --out has cells of other conditions.
    """
    places = []
    for text in captures:
        data, _, head = text.rpartition(":") if text.endswith((".npz", ".pkl")) else (text, "", "")
        places.append((Path(data), Path(head) if head else None))
    cells = [
        Cell(preset, data, head, seed, options) for data, head in places for preset in presets for seed in options.seeds
    ]
    if len({cell.folder for cell in cells}) < len(cells):
        raise DataError("two captures, presets or seeds share a name; give each a name of its own")
    for cell in cells:
        if not (cell.data / "transforms_train.json").is_file():
            raise DataError(f"{cell.data}: no transforms_train.json in this folder; give the folder of a capture")
        if cell.head_model and not cell.head_model.is_file():
            raise DataError(f"{cell.head_model}: no such file; give the head model of {cell.data}")
        noted, conditions = cell.folder / "cell.json", cell.conditions()
        if noted.is_file() and json.loads(noted.read_text("utf-8")) != conditions:
            raise DataError(f"{cell.folder}: was made under other conditions; give another --out, or remove the folder")
    return cells


def run_command(command: Sequence[str], log: Path) -> int:
    """Run mgavatar with its output in a file and return its exit code.

    Ctrl-C is passed on once, so that a fit can save its checkpoint.
    """
    append_line(log, f"$ mgavatar {' '.join(command)}")
    with writing(log), log.open("ab") as file:
        child = subprocess.Popen(
            [*MGAVATAR, *command], stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
        )
        try:
            return child.wait()
        except KeyboardInterrupt:
            child.send_signal(signal.SIGINT)
            child.wait()
            raise


def complete(cell: Cell) -> str | None:
    """Complete what a cell lacks; return the reason if that fails."""
    if cell.metrics.is_file() and not _lacks_lpips(cell):
        return None
    make_folder(cell.folder)
    write_json(cell.folder / "cell.json", cell.conditions())
    log = cell.folder / "log.txt"
    if not cell.summary.is_file():
        resume = (cell.run / "checkpoint.pt").is_file()
        if not resume:
            shutil.rmtree(cell.run, ignore_errors=True)
        code = run_command(cell.fit_command(resume=resume), log)
        if not cell.summary.is_file():
            return f"fit ended with {code}: {_last_line(log)}"
    code = run_command(cell.evaluate_command(), log)
    return None if code == 0 else f"evaluate ended with {code}: {_last_line(log)}"


def _lacks_lpips(cell: Cell) -> bool:
    splits = json.loads(cell.metrics.read_text("utf-8"))["splits"].values()
    return cell.options.lpips_weights is not None and any(score["lpips"] is None for score in splits)


def _last_line(log: Path) -> str:
    lines = [line.strip() for line in log.read_text("utf-8", errors="replace").splitlines() if line.strip()]
    return lines[-1][:300]


def row_of(cell: Cell, failure: str | None) -> Row:
    """Collect the values of a cell that the table shows; a failed cell has only its reason."""
    row: Row = {"capture": cell.capture, "preset": cell.preset, "seed": cell.seed, "failure": failure}
    if failure is not None:
        return row
    metrics, summary = (json.loads(path.read_text("utf-8")) for path in (cell.metrics, cell.summary))
    for split in ("val", "test"):
        score = metrics["splits"].get(split)
        row[split] = score and {name: score[name] for name in ("psnr", "ssim", "lpips", "lpips_reason")}
    geometry = metrics["geometry"]
    row["geometry"] = geometry and {
        "mean_mm": geometry["mean_mm"],
        "face_scalp_mm": geometry["regions"].get("face+scalp", {}).get("mean_mm"),
        "all_mm": geometry["regions"]["all"]["mean_mm"],
        "flipped_faces": geometry["flipped_faces"],
        "crossings": geometry["self_intersections"]["fitted"],
        "new_crossings": geometry["self_intersections"]["added"],
    }
    row["gaussians"] = summary["gaussians"]
    row["iterations"] = {name: stage["iterations"] for name, stage in summary["stages"].items()}
    return row | {name: summary.get(name) for name in ("seconds", "peak_mib", "peak_cuda_mib")}


_COLUMNS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    *((f"{s} PSNR", (s, "psnr"), ".2f") for s in ("val", "test")),
    *((f"{s} SSIM", (s, "ssim"), ".4f") for s in ("val", "test")),
    *((f"{s} LPIPS", (s, "lpips"), ".4f") for s in ("val", "test")),
    ("mean mm", ("geometry", "mean_mm"), ".2f"),
    ("face+scalp mm", ("geometry", "face_scalp_mm"), ".2f"),
    ("all mm", ("geometry", "all_mm"), ".2f"),
    ("flipped", ("geometry", "flipped_faces"), ",.0f"),
    ("crossings", ("geometry", "crossings"), ",.0f"),
    ("new crossings", ("geometry", "new_crossings"), ",.0f"),
    ("Gaussians", ("gaussians",), ",.0f"),
    ("s", ("seconds",), ".0f"),
    ("MiB", ("peak_mib",), ".0f"),
)


def table(rows: Sequence[Row], options: Options) -> str:
    """Return the means over the seeds in Markdown, with standard deviations and, in brackets, differences."""
    budget = f"budget {options.budget}" if options.budget else "no budget"
    seeds = f"Seed {options.seeds[0]}, {budget}."
    if len(options.seeds) > 1:
        listed = ", ".join(map(str, options.seeds))
        seeds = f"Means over seeds {listed}, {budget}; after ± the standard deviation of a single fit."
    header = ["capture", "preset", *(title for title, _, _ in _COLUMNS), "iterations"]
    lines = []
    firsts: dict[str, list[Row]] = {}
    for (capture, preset), group in _grouped(rows).items():
        done = [row for row in group if row["failure"] is None]
        first = firsts.setdefault(capture, done)
        cells = [capture, preset]
        if done:
            cells += [_shown(done, first, path, form) for _, path, form in _COLUMNS]
            counts = zip(*(row["iterations"].values() for row in done), strict=True)
            cells.append(" + ".join(f"{fmean(count):,.0f}" for count in counts))
        else:
            cells += ["failed"] + [""] * len(_COLUMNS)
        lines.append(cells)
    introduction = f"{seeds} In brackets: difference to the first preset of the capture."
    return "\n".join([introduction, "", markdown_table(header, lines), "", *(f"* {note}" for note in _notes(rows)), ""])


def _grouped(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """Group the seeds of every preset on every capture."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["capture"], row["preset"]), []).append(row)
    return groups


def _notes(rows: Sequence[Row]) -> list[str]:
    """List the failures and the reasons for missing LPIPS, each once."""
    notes: dict[str, None] = {}
    for row in rows:
        if row["failure"] is not None:
            notes[f"{row['capture']}, {row['preset']}, seed {row['seed']}: {row['failure']}"] = None
            continue
        reasons = (row[split]["lpips_reason"] for split in ("val", "test") if row[split])
        notes |= {f"LPIPS: {reason}.": None for reason in reasons if reason}
    return list(notes)


def _shown(rows: Sequence[Row], first: Sequence[Row], path: tuple[str, ...], form: str) -> str:
    values, references = _values(rows, path), _values(first, path)
    if not values:
        return "–"
    mean, scored = fmean(values), len(path) > 1
    spread = f" ± {stdev(values):{form}}" if scored and len(values) > 1 else ""
    differs = rows is not first and references and scored
    return f"{mean:{form}}{spread}" + (f" ({mean - fmean(references):+{form}})" if differs else "")


def _values(rows: Sequence[Row], path: tuple[str, ...]) -> list[float]:
    return [value for row in rows if (value := _at(row, path)) is not None]


def _at(row: Row, path: tuple[str, ...]) -> Any:
    value: Any = row
    for key in path:
        value = value.get(key) if value else None
    return value


def write_table(rows: Sequence[Row], options: Options) -> None:
    """Write ``table.json`` and ``table.md``."""
    conditions = {"seeds": list(options.seeds), "budget": options.budget, "device": options.device}
    write_json(options.out / "table.json", {**conditions, "rows": rows})
    write_text(options.out / "table.md", table(rows, options))


def write_sheet(cells: Sequence[Cell], options: Options) -> None:
    """Write ``sheet.png`` with held-out frames of the finished cells of the first seed."""
    from ablate_sheet import contact_sheet
    from PIL import Image

    finished = [cell for cell in cells if cell.metrics.is_file() and cell.seed == options.seeds[0]]
    captures: dict[Path, list[tuple[str, Path]]] = {}
    for cell in finished:
        captures.setdefault(cell.data, []).append((cell.name, cell.run / "avatar.pt"))
    if captures:
        with atomic_write(options.out / "sheet.png") as file:
            Image.fromarray(contact_sheet(captures)).save(file, format="PNG")


def ablate(presets: Sequence[str], captures: Sequence[str], options: Options) -> int:
    """Complete all cells, write their results and return the number of those that failed."""
    cells = plan_cells(presets, captures, options)
    make_folder(options.out)
    rows: list[Row] = []
    for number, cell in enumerate(cells, start=1):
        print(f"{number}/{len(cells)} {cell.capture}, {cell.preset}, seed {cell.seed}", file=sys.stderr, flush=True)
        failure = complete(cell)
        if failure is not None:
            print(f"  {failure}", file=sys.stderr, flush=True)
        rows.append(row_of(cell, failure))
        write_table(rows, options)
    write_sheet(cells, options)
    return sum(row["failure"] is not None for row in rows)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 done, 1 a cell failed or a file is missing, 2 the command line is wrong, 130 interrupted.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", required=True, help="as in fit; the others are compared with the first")
    parser.add_argument(
        "--captures", nargs="+", required=True, metavar="DIR[:HEAD]", help="captures with their head models"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="seeds to fit each preset from")
    parser.add_argument("--budget", help="time of each fit, as in fit")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--lpips-weights", type=Path)
    given = vars(parser.parse_args(argv))
    try:
        return min(1, ablate(given.pop("presets"), given.pop("captures"), Options(**given)))
    except DataError as error:
        print(f"ablate: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("ablate: interrupted; the same command continues", file=sys.stderr)
        return 130


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):  # SIGINT too: jobs in the background of a script start without it
        signal.signal(number, signal.default_int_handler)
    sys.exit(main())
