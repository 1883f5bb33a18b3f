"""Studies as tables on the terminal."""

from collections.abc import Iterable, Sequence
from typing import Any

import xarray as xr
from rich import box
from rich.console import Console
from rich.table import Table

from app.evaluation.cases import Position, rows
from app.evaluation.study_kinds import (
    PAPER_NUMBERS,
    ComparisonTable,
    PhotographStudy,
    StudyResult,
    Sweep,
    TrialStudy,
    sweeps_of,
)

_SMALL_RAD = 0.01  # below it, residuals are printed with a fourth decimal


def print_results(results: Sequence[StudyResult]) -> None:
    """Print a table for each study."""
    for sweep, data in sweeps_of(results):
        _print_sweep(sweep, data)
    if sweeps_of(results):
        print_line("mean over views and seeds; (limit); % within the error bar; x lenslets lost per frame, mean")
    for result in results:
        match result.study:
            case TrialStudy():
                _print_trials(result.study, result.data)
            case ComparisonTable():
                _print_comparison(result.study, result.data)
            case PhotographStudy():
                _print_photographs(result.study, result.data)


def print_table(title: str | None, headings: Sequence[str], lines: Iterable[Sequence[str]], *, width: int) -> None:
    """Print lines of cells under headings, at least `width` characters wide so that a pipe cuts no number."""
    table = Table(title=title, box=box.SIMPLE, padding=(0, 1), pad_edge=False)
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="right" if index else "left", no_wrap=True)
    for line in lines:
        table.add_row(*line)
    Console(width=max(Console().width, width)).print(table)


def print_line(text: str) -> None:
    """Print a line of text as it is."""
    Console().print(text, highlight=False, soft_wrap=True)


def position_name(position: Position) -> str:
    """Return a position on an axis as text."""
    return position if isinstance(position, str) else f"{position:g}"


def _print_sweep(sweep: Sweep, data: xr.Dataset) -> None:
    positions = data["at"].values.tolist()
    cells: dict[str, dict[Position, str]] = {}
    for row in rows(sweep.summary(data), sweep.dims):
        cells.setdefault(row["curve"], {})[row["at"]] = _residual(row)
    lines = ([curve, *(of_curve.get(at, "") for at in positions)] for curve, of_curve in cells.items())
    headings = [sweep.axis, *(position_name(sweep.shown(at)) for at in positions)]
    print_table(f"{sweep.title}: residual RMS (rad)", headings, lines, width=170)


def _residual(row: dict[str, Any]) -> str:
    number = f"{row['mean_rad']:.{3 if row['mean_rad'] >= _SMALL_RAD else 4}f}" if "mean_rad" in row else "-"
    asked = f" ({row['asked_rad']:.3g})" if "asked_rad" in row else ""
    covered = f" {100 * row['coverage']:.0f} %" if "coverage" in row else ""
    lost = f" x{row['lost_lenslets']:.0f}" if row["lost_lenslets"] >= 0.5 else ""
    return number + asked + covered + lost


def _print_trials(study: TrialStudy, data: xr.Dataset) -> None:
    trials, quantities = list(study.trials(data)), data["quantity"].values.tolist()
    cells = {
        (row["case"], row["quantity"]): _median_and_worst(row)
        for row in rows(study.summary(data), ("case", "quantity"))
    }
    lines = []
    for case in data["case"].values.tolist():
        are_as_asked = [trial["as_asked"] for trial in trials if trial["case"] == case]
        counted = f"{sum(are_as_asked)} of {len(are_as_asked)}"
        lines.append([case, counted, *(cells.get((case, quantity), "-") for quantity in quantities)])
    print_table(study.title, ("", "as asked", *quantities), lines, width=200)
    print_line("median / worst (limit)")
    for trial in trials:
        if trial["refusal"]:
            print_line(f"{trial['case']}, {trial['name']}: {trial['refusal']}")


def _median_and_worst(row: dict[str, Any]) -> str:
    asked = f" ({row['asked']:g})" if "asked" in row else ""
    return f"{row['median']:.3g} / {row['worst']:.3g}{asked}" if "worst" in row else "-"


def _print_photographs(study: PhotographStudy, data: xr.Dataset) -> None:
    summary = study.summary(data)["mean_db"]
    ways = [way for way in summary["way"].values.tolist() if summary.sel(way=way).notnull().any()]
    lines = [
        [name, *(f"{summary.sel(object=name, way=way).item():.1f}" for way in ways)]
        for name in summary["object"].values.tolist()
    ]
    print_table(study.title, ("object", *ways), lines, width=110)


def _print_comparison(table: ComparisonTable, data: xr.Dataset) -> None:
    lines: dict[str, list[str]] = {}
    lights = data["light"].values.tolist()
    for row in rows(table.summary(data), table.dims):
        method = row["method"]
        paper = " ".join(f"{value:6.3f}" for value in table.paper.get(method, ()))
        cells = lines.setdefault(method, [method, paper, *("",) * 2 * len(lights)])
        ours = " ".join(f"{row[number]:6.3f}" for number in PAPER_NUMBERS)
        spread = f" +- {row['spread_rad']:.3f}" if row["seeds"] > 1 else ""
        place = 2 + 2 * lights.index(row["light"])
        cells[place : place + 2] = ours + spread, f"{row['lost_lenslets']:.0f}"
    headings = {"neglected": "ours: min, max, mean", "real": "in real light"}
    of_lights = [heading for light in lights for heading in (headings[light], "lost")]
    print_table(table.title, ("method", "paper: min, max, mean", *of_lights), lines.values(), width=130)
    for method, problem in table.problems(data).items():
        print_line(f"{method}: {problem}")
