"""JSON, CSV and PNG files of studies and benchmarks."""

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib.figure import Figure

from app.errors import InputError
from app.evaluation.cases import rows
from app.evaluation.study_figures import photograph_figure, sweep_figure, table_figure, trial_figure
from app.evaluation.study_kinds import (
    LIGHTS,
    PAPER_NUMBERS,
    ComparisonTable,
    PhotographStudy,
    Study,
    StudyResult,
    Sweep,
    TrialStudy,
    sweeps_of,
)
from app.files import atomic_write

_OF_SWEEPS = ("study.json", "study.csv", "estimator.png")


def files_of(studies: Sequence[Study], out: Path) -> list[Path]:
    """Return the files that `write_newest` writes."""
    names: dict[str, None] = {}  # in order, without repetition
    for study in studies:
        ours = _OF_SWEEPS if isinstance(study, Sweep) else (f"{study.name}{end}" for end in (".json", ".csv", ".png"))
        names |= dict.fromkeys(ours)
    return [out / name for name in names]


def write_newest(results: Sequence[StudyResult], out: Path) -> None:
    """Write the files of the newest result into the folder `out`.

    All sweeps so far share study.json, study.csv and estimator.png; other studies have files of their own name.
    """
    newest = results[-1]
    match newest.study:
        case Sweep():
            _write_sweeps(sweeps_of(results), newest.seeds, out)
        case TrialStudy():
            _write_trials(newest.study, newest.data, newest.seeds, out)
        case ComparisonTable():
            _write_table(newest.study, newest.data, out)
        case PhotographStudy():
            _write_photographs(newest.study, newest.data, newest.seeds, out)


def write_json(path: Path, tree: Mapping[str, Any]) -> None:
    """Write a JSON file."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(tree, indent=2) + "\n")


def _write_csv(path: Path, columns: Iterable[str], lines: Iterable[Mapping[str, Any]]) -> None:
    with atomic_write(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(columns))
        writer.writeheader()
        writer.writerows(lines)


def _write_png(path: Path, figure: Figure) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)


def _write_sweeps(sweeps: Sequence[tuple[Sweep, xr.Dataset]], seeds: int, out: Path) -> None:
    tree: dict[str, Any] = {}
    lines, columns = [], dict.fromkeys(("sweep", *Sweep.dims))
    for sweep, data in sweeps:
        summary = sweep.summary(data)
        columns |= dict.fromkeys(map(str, summary.data_vars))
        curves: dict[str, list[dict[str, Any]]] = {}
        for row in rows(summary, sweep.dims):
            point = row | {"at": sweep.shown(row["at"]), "observations": int(row["observations"])}
            lines.append({"sweep": sweep.name, **point})
            curves.setdefault(point.pop("curve"), []).append(point)
        tree[sweep.name] = {"title": sweep.title, "axis": sweep.axis, "curves": curves}
    numbers, table, figure = (out / name for name in _OF_SWEEPS)
    write_json(numbers, {"seeds": seeds, "sweeps": tree})
    _write_csv(table, columns, lines)
    _write_png(figure, sweep_figure(sweeps))


def _write_trials(study: TrialStudy, data: xr.Dataset, seeds: int, out: Path) -> None:
    trials, quantities = list(study.trials(data)), data["quantity"].values.tolist()
    cases: dict[str, dict[str, Any]] = {}
    for case in data["case"].values.tolist():
        here = [each for each in trials if each["case"] == case]
        counts = {"trials": len(here), "as_asked": sum(each["as_asked"] for each in here)}
        refusals = [each["refusal"] for each in here if each["refusal"]]
        cases[case] = {**counts, "refusals": refusals, **{quantity: {} for quantity in quantities}}
    for row in rows(study.summary(data), ("case", "quantity")):
        cases[row.pop("case")][row.pop("quantity")] = row
    write_json(out / f"{study.name}.json", {"seeds": seeds, "title": study.title, "cases": cases})
    _write_csv(out / f"{study.name}.csv", ("case", "name", *quantities, "as_asked", "refusal"), trials)
    _write_png(out / f"{study.name}.png", trial_figure(study, data))


def _write_photographs(study: PhotographStudy, data: xr.Dataset, seeds: int, out: Path) -> None:
    lines = list(rows(study.summary(data), study.dims))
    write_json(out / f"{study.name}.json", {"seeds": seeds, "title": study.title, "photographs": lines})
    _write_csv(out / f"{study.name}.csv", lines[0], lines)
    _write_png(out / f"{study.name}.png", photograph_figure(study, data))


def _write_table(table: ComparisonTable, data: xr.Dataset, out: Path) -> None:
    problems = table.problems(data)
    if "views" not in data:
        raise InputError("; ".join(f"{method}: {problem}" for method, problem in problems.items()))
    paper = {method: dict(zip(PAPER_NUMBERS, numbers, strict=True)) for method, numbers in table.paper.items()}
    ours: dict[str, dict[str, Any]] = {light: {} for light in LIGHTS}
    for row in rows(table.summary(data), table.dims):
        ours[row.pop("light")][row.pop("method")] = row | {"seeds": int(row["seeds"])}
    tree = {"paper": paper, "ours": ours["neglected"], "in_real_light": ours["real"], "problems": problems}
    write_json(out / f"{table.name}.json", tree)
    lines = [
        {"method": method}
        | {f"paper_{name}": value for name, value in paper.get(method, {}).items()}
        | ours["neglected"].get(method, {})
        | {f"real_{name}": value for name, value in ours["real"].get(method, {}).items()}
        for method in dict.fromkeys([*ours["neglected"], *ours["real"]])
    ]
    _write_csv(out / f"{table.name}.csv", dict.fromkeys(name for line in lines for name in line), lines)
    _write_png(out / f"{table.name}.png", table_figure(table, data))
