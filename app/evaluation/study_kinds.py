"""Kinds of studies that several share: sweeps of one quantity, and trials of a routine."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import or_
from typing import ClassVar

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from app.evaluation.studies import CaseResult, Output, Position, Printed, Row, Study, StudyResult, known_rows
from reconstruction.quality.verdict import Fault

_PANEL_INCHES = (7.6, 3.7)
# The same estimator looks the same in every panel.
_COLOURS = {
    "translation": "tab:gray",
    "affine": "tab:orange",
    "quadratic": "tab:blue",
    "cubic": "tab:green",
    "quartic": "tab:purple",
    "automatic": "tab:red",
}
_NARROW_RANGE = 50  # a logarithmic axis up to this ratio shows the positions instead of powers of ten
_UPRIGHT_NAMES = 6  # more of them along an axis are turned
_MARKERS = "osD^vPX*<>"
_SMALL_RAD = 0.01  # below it, residuals are printed with a fourth decimal


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep(Study):
    """Residuals of estimators (`curve`) against one quantity (`at`); all sweeps share their files."""

    axis: str  # the varied quantity with its unit
    axis_per_si: float = 1.0  # unit of `axis` per SI unit
    is_logarithmic: bool = False
    left_out: tuple[str, ...] = ()  # the figure leaves out curves with one of these in their names
    limits_rad: Mapping[str, Mapping[Position, float]] = field(default_factory=dict)  # by curve and position

    dims: ClassVar = ("curve", "at")
    legend: ClassVar = "mean over views and seeds; (limit); % within the error bar; x lenslets lost per frame, mean"

    @property
    def files(self) -> tuple[str, str, str]:
        """Names of the files of all sweeps."""
        return "study.json", "study.csv", "estimator.png"

    def shown(self, at: Position) -> Position:
        """Convert a position from SI units to the unit of the axis."""
        return at if isinstance(at, str) else float(f"{at * self.axis_per_si:.6g}")

    def summary(self, data: pd.DataFrame) -> pd.DataFrame:
        """Mean residual and spread over the repeats with a result, mean of lost lenslets, limit.

        A limit measured with the result, `asked_rad`, precedes `limits_rad`; `coverage` is that of an error bar.
        """
        unknown = {name: math.nan for name in ("asked_rad", "coverage") if name not in data}
        cases = data.assign(**unknown).groupby([*self.dims], observed=True)
        summary = pd.DataFrame(
            {
                "mean_rad": cases["rms_rad"].mean(),
                "spread_rad": cases["rms_rad"].std().fillna(0.0),
                "observations": cases["rms_rad"].count(),
                "lost_lenslets": cases["lost"].mean(),
                "left_cell_lenslets": cases["left_cell"].mean(),
                "asked_rad": cases["asked_rad"].mean(),
                "coverage": cases["coverage"].mean(),
            }
        )
        asked = [self.limits_rad.get(curve, {}).get(at, math.nan) for curve, at in summary.index]
        summary["asked_rad"] = summary["asked_rad"].fillna(pd.Series(asked, summary.index, float))
        if "faults" in data:  # raised in any of the repeats
            raised = cases["faults"].agg(lambda each: reduce(or_, each.dropna().astype(int), 0))
            summary["flags"] = raised.map(lambda faults: Fault(int(faults)).name or "")
        return summary.reset_index()

    def output(self, results: Sequence[StudyResult]) -> Output:
        """Return the files of all sweeps so far."""
        sweeps = sweeps_of(results)
        tree, tables = dict[str, Row](), list[pd.DataFrame]()
        for sweep, data in sweeps:
            summary, curves = sweep.summary(data), dict[str, list[Row]]()
            summary["at"] = [sweep.shown(at) for at in summary["at"]]
            tables.append(summary)
            for point in known_rows(summary):
                curves.setdefault(point.pop("curve"), []).append(point)
            tree[sweep.name] = {"title": sweep.title, "axis": sweep.axis, "curves": curves}
        across = min(2, len(sweeps))
        down, (width, height) = -(-len(sweeps) // across), _PANEL_INCHES
        figure = Figure(figsize=(across * width, down * height), layout="constrained")
        axes = figure.subplots(down, across, squeeze=False).ravel()
        for (sweep, data), panel in zip(sweeps, axes, strict=False):
            sweep.draw(data, panel)
        for panel in axes[len(sweeps) :]:
            panel.set_axis_off()
        table = pd.concat(tables, keys=tree, names=["sweep"]).reset_index("sweep")
        return Output({"seeds": results[-1].seeds, "sweeps": tree}, table, figure)

    def printed(self, data: pd.DataFrame) -> Printed:
        """Return a line for each curve, or for each position if there are more and they have names."""
        positions = data["at"].cat.categories
        cells: dict[str, dict[Position, str]] = {}
        for row in known_rows(self.summary(data)):
            number = f"{row['mean_rad']:.{3 if row['mean_rad'] >= _SMALL_RAD else 4}f}" if "mean_rad" in row else "-"
            asked = f" ({row['asked_rad']:.3g})" if "asked_rad" in row else ""
            covered = f" {100 * row['coverage']:.0f} %" if "coverage" in row else ""
            flags = f" {row['flags']}" if row.get("flags") else ""
            lost = f" x{row['lost_lenslets']:.0f}" if row["lost_lenslets"] >= 0.5 else ""
            cells.setdefault(row["curve"], {})[row["at"]] = number + asked + covered + lost + flags
        shown = [self.shown(at) for at in positions]
        headings = [self.axis, *(at if isinstance(at, str) else f"{at:g}" for at in shown)]
        table = [headings, *([curve, *(of_curve.get(at, "") for at in positions)] for curve, of_curve in cells.items())]
        if len(cells) < len(positions) and any(isinstance(at, str) for at in shown):
            table = [list(line) for line in zip(*table, strict=True)]
        return Printed(f"{self.title}: residual RMS (rad)", table[0], table[1:])

    def draw(self, data: pd.DataFrame, panel: Axes) -> None:
        """Draw the curves; short black lines are the limits."""
        summary, positions = self.summary(data), data["at"].cat.categories
        numbers = [at for each in positions if not isinstance(at := self.shown(each), str)]
        is_named = not numbers
        all_x = np.arange(len(positions)) if is_named else np.array(numbers)
        curves = [each for each in data["curve"].cat.categories if not any(word in each for word in self.left_out)]
        for index, curve in enumerate(curves):
            points = summary[summary["curve"] == curve].set_index("at").reindex(positions)
            measured = points["observations"].notna().to_numpy()
            x, y = all_x[measured], points["mean_rad"].to_numpy()[measured]
            panel.errorbar(
                x,
                y,
                np.minimum(points["spread_rad"].to_numpy()[measured], y * 0.9),  # above zero on the logarithmic axis
                label=curve,
                color=next((colour for name, colour in _COLOURS.items() if name in curve), None),
                linestyle="--" if "refined" in curve else ":" if is_named or "true" in curve else "-",
                marker=_MARKERS[index % len(_MARKERS)],
                markersize=4,
                linewidth=1,
                elinewidth=0.6,
                capsize=2,
            )
            panel.plot(all_x, points["asked_rad"].to_numpy(), "k_", markersize=14)
        panel.set_yscale("log")
        if self.is_logarithmic:
            panel.set_xscale("log")
            if numbers and max(numbers) < _NARROW_RANGE * min(numbers):
                panel.set_xticks(numbers, [f"{at:g}" for at in numbers])
                panel.minorticks_off()
        if is_named:
            panel.set_xticks(all_x.tolist(), [str(at) for at in positions])
            if len(positions) > _UPRIGHT_NAMES:
                for label in panel.get_xticklabels():
                    label.set(rotation=30, ha="right", fontsize=7)
        panel.set_title(self.title, fontsize=10)
        panel.set_xlabel(self.axis)
        panel.set_ylabel("residual RMS (rad)")
        panel.grid(visible=True, which="both", linewidth=0.3)
        panel.legend(fontsize=6.5, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def sweeps_of(results: Iterable[StudyResult]) -> list[tuple[Sweep, pd.DataFrame]]:
    """Return the sweeps among the results, with their data."""
    return [(each.study, each.data) for each in results if isinstance(each.study, Sweep)]


_JITTER = 0.25  # rows, spreads the trials of a case
_LIMIT = ", limit"  # after the name of a quantity


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialStudy(Study):
    """Many trials of one routine, see `trial`."""

    dims: ClassVar = ("case",)

    @staticmethod
    def trials(data: pd.DataFrame) -> pd.DataFrame:
        """Return case, name and quantities of every trial; `as_asked` if within all its limits; `refusal`."""
        quantities = quantities_of(data)
        limit = data[[f"{each}{_LIMIT}" for each in quantities]].to_numpy()
        as_asked = ((data[quantities].to_numpy() <= limit) | np.isnan(limit)).all(axis=1)  # false without a result
        return data[["case", "name", *quantities]].assign(as_asked=as_asked, refusal=data["problem"])

    def summary(self, data: pd.DataFrame) -> pd.DataFrame:
        """Median, worst value and limit of every quantity of a case."""
        cases = data.groupby("case", observed=True)
        parts = []
        for each in quantities_of(data):
            values, asked = cases[each], cases[f"{each}{_LIMIT}"].max()
            numbers = {"quantity": each, "median": values.median(), "worst": values.max(), "asked": asked}
            parts.append(pd.DataFrame(numbers))
        return pd.concat(parts).reset_index()

    def output(self, results: Sequence[StudyResult]) -> Output:
        """Return the trials, counts and summary of each case, and the figure."""
        data = results[-1].data
        trials, cases = self.trials(data), dict[str, Row]()
        for case, here in trials.groupby("case", observed=True):
            refusals = [each for each in here["refusal"] if each]
            cases[str(case)] = {"trials": len(here), "as_asked": int(here["as_asked"].sum()), "refusals": refusals}
        for row in known_rows(self.summary(data)):
            cases[row.pop("case")][row.pop("quantity")] = row
        tree = {"seeds": results[-1].seeds, "title": self.title, "cases": cases}
        return Output(tree, trials, self.figure(data))

    def printed(self, data: pd.DataFrame) -> Printed:
        """Return a line for each case, and the refusals."""
        trials = self.trials(data)
        are_as_asked = trials.groupby("case", observed=True)["as_asked"]
        lines = {case: [case, f"{each.sum()} of {len(each)}"] for case, each in are_as_asked}
        for row in known_rows(self.summary(data)):  # the quantities of a case in their order
            asked = f" ({row['asked']:g})" if "asked" in row else ""
            known = f"{row['median']:.3g} / {row['worst']:.3g}{asked}" if "worst" in row else "-"
            lines[row["case"]].append(known)
        refusals = [f"{each.case}, {each.name}: {each.refusal}" for each in trials.itertuples() if each.refusal]
        headings = ("", "as asked", *quantities_of(data))
        return Printed(self.title, headings, lines.values(), ["median / worst (limit)", *refusals])

    def figure(self, data: pd.DataFrame) -> Figure:
        """Draw each trial as a point, a panel per quantity, a row per case; black lines are the limits."""
        cases, quantities = data["case"].cat.categories.tolist(), quantities_of(data)
        figure = Figure(figsize=(3.0 * (1 + len(quantities)), 1.2 + 0.26 * len(cases)), layout="constrained")
        panels = figure.subplots(1, len(quantities), sharey=True, squeeze=False)[0]
        repeat = data.groupby("case", observed=True).cumcount().to_numpy()
        place = data["case"].cat.codes + np.linspace(-_JITTER, _JITTER, repeat.max() + 1)[repeat]
        summary = self.summary(data)
        for quantity, panel in zip(quantities, panels, strict=True):
            measured, limits = data[quantity], summary.loc[summary["quantity"] == quantity, "asked"]
            panel.plot(measured, place, ".", color="tab:blue", markersize=4)
            panel.plot(limits, range(len(cases)), "k|", markersize=12)
            known = np.concatenate([measured, limits])
            most = 1.05 * np.max(known, initial=0.0, where=np.isfinite(known)) or 1.0  # where all is 0
            panel.set_xlabel(quantity)
            panel.set_xlim(-0.03 * most, most)
            panel.grid(visible=True, linewidth=0.3)
        panels[0].set_yticks(range(len(cases)), cases, fontsize=8)
        panels[0].invert_yaxis()
        figure.suptitle(self.title, fontsize=10)
        return figure


def trial(
    *, case: str, name: str, measured: Mapping[str, float], limits: Mapping[str, float], problem: str = ""
) -> CaseResult:
    """Return a trial: values and upper limits by quantity with its unit; at least one has a limit."""
    values = {each: float(value) for each, value in measured.items()}
    values |= {f"{each}{_LIMIT}": limits.get(each, math.nan) for each in measured}
    return CaseResult(at={"case": case}, values=values, name=name, problem=problem)


def quantities_of(data: pd.DataFrame) -> list[str]:
    """Return the quantities that trials have measured."""
    return [name for name in data if f"{name}{_LIMIT}" in data]
