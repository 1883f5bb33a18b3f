"""The outcome of trials as JSON, CSV, text and a figure with one panel for each quantity."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import rich.table
from matplotlib.figure import Figure
from rich import box
from rich.console import Console

from app.evaluation.study.trials import Summary, TrialOutcome
from app.files import atomic_write

_PANEL_INCHES = 3.0
_ROW_INCHES = 0.26
_JITTER = 0.25  # rows; so far are a case's points spread, to be told apart


def write_trials(outcome: TrialOutcome, seeds: int, out: Path) -> None:
    """Write the study's JSON, CSV and PNG, called by its name, into the folder `out`."""
    name = outcome.study.name
    tree = {
        "seeds": seeds,
        "title": outcome.study.title,
        "cases": {
            case: {
                "trials": len(outcome.of(case)),
                "as_asked": sum(trial.holds for trial in outcome.of(case)),
                "refusals": [trial.refusal for trial in outcome.of(case) if trial.refusal],
                **{quantity: _known(asdict(outcome.summary(case, quantity))) for quantity in outcome.quantities},
            }
            for case in outcome.cases
        },
    }
    with atomic_write(out / f"{name}.json") as path:
        path.write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n")
    with atomic_write(out / f"{name}.csv") as path, path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["case", "name", *outcome.quantities, "as_asked", "refusal"])
        writer.writeheader()
        for trial in outcome.trials:
            row = {"case": trial.case, "name": trial.name, "as_asked": trial.holds, "refusal": trial.refusal}
            writer.writerow(row | _known(dict(trial.figures)))
    with atomic_write(out / f"{name}.png") as path:
        trial_figure(outcome).savefig(path, dpi=100)


def print_trials(outcome: TrialOutcome) -> None:
    """Print a row for each case: how many of its trials are as asked, median and worst of every quantity."""
    text = rich.table.Table(title=outcome.study.title, box=box.SIMPLE, padding=(0, 1))
    for heading in ("", "as asked", *outcome.quantities):
        text.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for case in outcome.cases:
        trials = outcome.of(case)
        cells = (_cell(outcome.summary(case, quantity)) for quantity in outcome.quantities)
        text.add_row(case, f"{sum(trial.holds for trial in trials)} of {len(trials)}", *cells)
    console = Console(width=max(Console().width, 200))  # numbers cut short are of no use, in a pipe neither
    console.print(text)
    console.print("median / worst (asked for at most)")
    for trial in outcome.trials:
        if trial.refusal:
            console.print(f"{trial.case}, {trial.name}: {trial.refusal}", highlight=False, soft_wrap=True)


def trial_figure(outcome: TrialOutcome) -> Figure:
    """Draw every trial as a point, one panel a quantity, one row a case; what is asked is a short black line."""
    cases, quantities = outcome.cases, outcome.quantities
    size = (3.0 + _PANEL_INCHES * len(quantities), 1.2 + _ROW_INCHES * len(cases))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(quantities), sharey=True, squeeze=False)[0]
    for quantity, panel in zip(quantities, panels, strict=True):
        largest = 0.0
        for row, case in enumerate(cases):
            values = np.array([trial.figures.get(quantity, math.nan) for trial in outcome.of(case)])
            panel.plot(values, row + np.linspace(-_JITTER, _JITTER, values.size), ".", color="tab:blue", markersize=4)
            summary = outcome.summary(case, quantity)
            panel.plot(summary.asked, row, "k|", markersize=12)
            largest = float(np.nanmax([largest, summary.worst, summary.asked]))
        panel.set_xlabel(quantity)
        most = 1.05 * largest or 1.0  # where all is 0
        panel.set_xlim(-0.03 * most, most)
        panel.grid(visible=True, linewidth=0.3)
    panels[0].set_yticks(range(len(cases)), cases, fontsize=8)
    panels[0].invert_yaxis()
    figure.suptitle(outcome.study.title, fontsize=10)
    return figure


def _cell(summary: Summary) -> str:
    if not math.isfinite(summary.worst):
        return "-"
    asked = f" ({summary.asked:g})" if math.isfinite(summary.asked) else ""
    return f"{summary.median:.3g} / {summary.worst:.3g}{asked}"


def _known(values: dict[str, Any]) -> dict[str, Any]:
    """The numbers that are known: JSON has no NaN."""
    return {name: value for name, value in values.items() if math.isfinite(value)}
