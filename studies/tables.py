"""Tables and figures that several studies share: curves of residuals, and trials of a routine."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track

from app.bench.config import Bench

T = TypeVar("T")
Row = dict[str, Any]
Made = tuple[pd.DataFrame, Figure]
"""Table and figure of a study."""
_COLOURS = {"translation": "gray", "affine": "orange", "quadratic": "blue", "cubic": "green", "quartic": "purple"}
_JITTER = 0.25  # rows, spreads the trials of a case


class Asked(NamedTuple):
    """What a study is asked for."""

    bench: Bench
    seeds: range = range(1)  # of its screen, counted from its own
    masks: Sequence[str] = ()
    frames: Path | None = None  # folder of reference frames


def steps(items: Sequence[T], text: str) -> Iterator[T]:
    """Yield the items under a progress bar on standard error."""
    yield from track(items, text, console=Console(stderr=True), transient=True)


def curves(rows: Iterable[Row]) -> pd.DataFrame:
    """Summarise residuals by `curve` and position `at`: mean and spread over the repeats, lenslets lost, coverage."""
    data = pd.DataFrame(rows)
    cases = data.groupby(["curve", "at"], sort=False)
    table = cases["rms_rad"].agg(mean_rad="mean", spread_rad="std", observations="count")
    table["spread_rad"] = table["spread_rad"].fillna(0.0)
    for name in ("lost", "left_cell", "coverage"):
        if name in data:
            table[name] = cases[name].mean()
    if "flags" in data:  # raised in any of the repeats
        table["flags"] = cases["flags"].agg(lambda each: " ".join(dict.fromkeys(each[each.fillna("") != ""])))
    return table.reset_index()


def draw_curves(
    table: pd.DataFrame, title: str, axis: str, *, is_logarithmic: bool = False, left_out: str = "\0"
) -> Figure:
    """Draw `curves` against their positions, without those with `left_out` in their names."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    panel = figure.subplots()
    for name, points in table[~table["curve"].str.contains(left_out, regex=False)].groupby("curve", sort=False):
        mean, spread = points["mean_rad"], np.minimum(points["spread_rad"], 0.9 * points["mean_rad"])
        colour = next((f"tab:{colour}" for warp, colour in _COLOURS.items() if warp in str(name)), None)
        style = "--" if "refined" in str(name) else "-"
        panel.errorbar(points["at"], mean, spread, label=name, color=colour, linestyle=style, marker=".", capsize=2)
    panel.set(title=title, xlabel=axis, ylabel="residual RMS (rad)", yscale="log")
    if is_logarithmic:
        panel.set_xscale("log")
    elif table["at"].dtype == object:
        panel.tick_params("x", rotation=30, labelsize=7)
    panel.grid(visible=True, which="both", linewidth=0.3)
    panel.legend(fontsize=6.5, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def trial(case: str, measured: Mapping[str, float], limits: Mapping[str, float], refusal: str = "") -> Row:
    """Return a row of values by quantity; it is as asked if each is within its limit, and nothing was refused."""
    is_within = not refusal and all(not measured[each] > most for each, most in limits.items())
    return {"case": case, **measured, "as_asked": is_within, "refusal": refusal}


def trials(rows: Iterable[Row], title: str) -> Made:
    """Summarise rows of `trial` by case; draw each as a point, a panel for each quantity."""
    data = pd.DataFrame(rows)
    cases = data.groupby("case", sort=False)
    quantities = [name for name in data if name not in {"case", "as_asked", "refusal"}]
    table = pd.DataFrame({"trials": cases.size(), "as_asked": cases["as_asked"].sum()})
    for name in quantities:
        table[f"{name}, median"], table[f"{name}, worst"] = cases[name].median(), cases[name].max()
    table["refusals"] = cases["refusal"].agg(lambda each: "; ".join(dict.fromkeys(each[each != ""])))
    figure = Figure(figsize=(3.0 * (1 + len(quantities)), 1.2 + 0.26 * len(table)), layout="constrained")
    panels = figure.subplots(1, len(quantities), sharey=True, squeeze=False)[0]
    repeat = cases.cumcount().to_numpy()
    place = (
        data["case"].map({case: row for row, case in enumerate(table.index)})
        + np.linspace(-_JITTER, _JITTER, repeat.max() + 1)[repeat]
    )
    for name, panel in zip(quantities, panels, strict=True):
        panel.plot(data[name], place, ".", markersize=4)
        panel.set_xlabel(name)
        panel.grid(visible=True, linewidth=0.3)
    panels[0].set_yticks(range(len(table)), table.index, fontsize=8)
    panels[0].invert_yaxis()
    figure.suptitle(title, fontsize=10)
    return table.reset_index(), figure
