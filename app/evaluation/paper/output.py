"""A table as JSON, CSV, text and a figure like the paper's."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import rich.table
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from rich import box
from rich.console import Console

from app.errors import InputError
from app.evaluation.paper.tables import Table
from app.files import atomic_write
from reconstruction.arrays import Floats
from reconstruction.wavefront import without_piston

_NUMBERS = ("min_rad", "max_rad", "mean_rad")


def write_table(table: Table, out: Path) -> None:
    """Write NAME.json, NAME.csv and NAME.png into the folder `out`."""
    paper = {name: dict(zip(_NUMBERS, values, strict=True)) for name, values in table.paper.items()}
    ours = {name: entry.summary() for name, entry in table.entries.items()}
    if not ours:
        raise InputError("; ".join(f"{name}: {problem}" for name, problem in table.problems.items()))
    with atomic_write(out / f"{table.name}.json") as path:
        path.write_text(json.dumps({"paper": paper, "ours": ours, "problems": table.problems}, indent=2) + "\n")
    with atomic_write(out / f"{table.name}.csv") as path, path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["method", *(f"paper_{number}" for number in _NUMBERS), *next(iter(ours.values()))])
        for name, summary in ours.items():
            writer.writerow([name, *(paper.get(name, {}).get(number, "") for number in _NUMBERS), *summary.values()])
    with atomic_write(out / f"{table.name}.png") as path:
        table_figure(table).savefig(path, dpi=110)


def print_table(table: Table) -> None:
    """Print the paper's numbers beside ours."""
    text = rich.table.Table(title=table.title, box=box.SIMPLE, padding=(0, 1))
    text.add_column("method", no_wrap=True)
    for column in ("paper: min, max, mean", "ours: min, max, mean", "lost"):
        text.add_column(column, justify="right", no_wrap=True)
    for name, entry in table.entries.items():
        ours = entry.summary()
        theirs = " ".join(f"{value:6.3f}" for value in table.paper.get(name, ()))
        numbers = " ".join(f"{ours[number]:6.3f}" for number in _NUMBERS)
        spread = f" +- {ours['spread_rad']:.3f}" if len(entry.rms_rad) > 1 else ""
        text.add_row(name, theirs, numbers + spread, f"{ours['lost_lenslets']:.0f}")
    console = Console(width=max(Console().width, 96))  # numbers cut short are of no use, in a pipe neither
    console.print(text)
    for name, problem in table.problems.items():
        console.print(f"{name}: {problem}")


def table_figure(table: Table) -> Figure:
    """Truth, reconstruction and residual of every method, all views of the last seed on one colour scale."""
    limit = float(np.nanmax([np.nanmax(np.abs(truth)) for truth, _ in table.last.values()]))
    scale = Normalize(-limit, limit)
    figure = Figure(figsize=(8.6, 2.4 * len(table.last) + 0.6), layout="constrained")
    axes = figure.subplots(len(table.last), 3, squeeze=False)
    for (name, (truth, views)), row in zip(table.last.items(), axes, strict=True):
        residual = f"residual, mean RMS {table.entries[name].summary()['mean_rad']:.3f} rad"
        titled = {table.reference: truth, name: views, residual: views - truth}
        for axis, (title, values) in zip(row, titled.items(), strict=True):
            axis.imshow(_mosaic(without_piston(values)), cmap="RdBu_r", norm=scale, interpolation="nearest")
            axis.set_title(title, fontsize=8)
            axis.set_axis_off()
    figure.colorbar(ScalarMappable(scale, "RdBu_r"), ax=axes, label="wavefront (rad)", shrink=0.6)
    return figure


def _mosaic(views: Floats) -> Floats:
    """All views beside one another as they lie in the field, with a gap between."""
    framed = np.pad(views, ((0, 0), (0, 0), (1, 1), (1, 1)), constant_values=np.nan)
    return np.block([list(row) for row in framed])
