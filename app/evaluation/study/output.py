"""The study as JSON, CSV, text and a figure with one panel for each sweep."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import rich.table
from rich import box
from rich.console import Console

from app.evaluation.study.figure import study_figure
from app.evaluation.study.observations import At, Outcome, Point
from app.files import atomic_write


def write_study(outcomes: Sequence[Outcome], seeds: int, out: Path) -> None:
    """Write study.json, study.csv and estimator.png into the folder `out`."""
    tree = {
        "seeds": seeds,
        "sweeps": {
            outcome.sweep.name: {
                "title": outcome.sweep.title,
                "axis": outcome.sweep.axis,
                "curves": {
                    curve: [{"at": outcome.shown(at), **_known(point)} for at, point in outcome.points(curve).items()]
                    for curve in outcome.curves
                },
            }
            for outcome in outcomes
        },
    }
    with atomic_write(out / "study.json") as path:
        path.write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n")
    with atomic_write(out / "study.csv") as path, path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["sweep", "curve", "at", *Point.__dataclass_fields__])
        writer.writeheader()
        writer.writerows(_rows(outcomes))
    with atomic_write(out / "estimator.png") as path:
        study_figure(outcomes).savefig(path, dpi=100)


def print_study(outcomes: Sequence[Outcome]) -> None:
    """Print a table for each sweep: mean residual RMS, rad, what is asked in brackets, lost lenslets after a cross."""
    for outcome in outcomes:
        text = rich.table.Table(title=f"{outcome.sweep.title}: residual RMS (rad)", box=box.SIMPLE, padding=(0, 1))
        text.add_column(outcome.sweep.axis, no_wrap=True)
        for at in outcome.positions:
            text.add_column(name_of(outcome.shown(at)), justify="right", no_wrap=True)
        for curve in outcome.curves:
            points = outcome.points(curve)
            text.add_row(curve, *(_cell(points[at]) if at in points else "" for at in outcome.positions))
        console = Console(width=max(Console().width, 170))  # numbers cut short are of no use, in a pipe neither
        console.print(text)
    Console().print("mean over views and seeds; (asked for at most); x lenslets lost of a frame, mean")


def name_of(at: At) -> str:
    """What is varied, as a word."""
    return at if isinstance(at, str) else f"{at:g}"


def _cell(point: Point) -> str:
    number = f"{point.mean_rad:.3f}" if math.isfinite(point.mean_rad) else "-"
    asked = f" ({point.asked_rad:g})" if math.isfinite(point.asked_rad) else ""
    lost = f" x{point.lost_lenslets:.0f}" if point.lost_lenslets >= 0.5 else ""
    return number + asked + lost


def _known(point: Point) -> dict[str, Any]:
    """The fields that are known: JSON has no NaN."""
    return {name: value for name, value in asdict(point).items() if math.isfinite(value)}


def _rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    for outcome in outcomes:
        for curve in outcome.curves:
            for at, point in outcome.points(curve).items():
                yield {"sweep": outcome.sweep.name, "curve": curve, "at": outcome.shown(at), **_known(point)}
