"""Kinds of studies, each with its summary over the repeats, files, figure, and table on the terminal."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import or_
from typing import ClassVar

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from app.errors import InputError
from app.evaluation.studies import CaseResult, Output, Position, Printed, Row, Study, StudyResult, known_rows
from reconstruction.quality.verdict import Fault
from reconstruction.wavefront import rms, without_piston

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
    """Residuals of several estimators (`curve`) against one varied quantity (`at`); all sweeps share their files."""

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
        """Mean residual and spread over the repeats with a result, mean of lost lenslets, median time, limit.

        A limit measured with the result, `asked_rad`, precedes `limits_rad`; `coverage` is that of an error bar.
        """
        cases = data.groupby([*self.dims], observed=True)
        summary = pd.DataFrame(
            {
                "mean_rad": cases["rms_rad"].mean(),
                "spread_rad": cases["rms_rad"].std().fillna(0.0),
                "observations": cases["rms_rad"].count(),
                "lost_lenslets": cases["lost"].mean(),
                "left_cell_lenslets": cases["left_cell"].mean(),
                "seconds": cases["seconds"].median(),
            }
        )
        asked = [self.limits_rad.get(curve, {}).get(at, math.nan) for curve, at in summary.index]
        summary["asked_rad"] = pd.Series(asked, summary.index, float)
        if "asked_rad" in data:
            summary["asked_rad"] = cases["asked_rad"].mean().fillna(summary["asked_rad"])
            summary["coverage"] = cases["coverage"].mean()
        if "faults" in data:  # raised in any of the repeats
            raised = cases["faults"].agg(lambda each: reduce(or_, each.dropna().astype(int), 0))
            summary["flags"] = raised.map(lambda faults: Fault(int(faults)).name or "")
        return summary.reset_index()

    def output(self, results: Sequence[StudyResult]) -> Output:
        """Return the files of all sweeps so far."""
        sweeps = sweeps_of(results)
        tree, lines, columns = dict[str, Row](), list[Row](), dict.fromkeys(("sweep", *self.dims))
        for sweep, data in sweeps:
            summary, curves = sweep.summary(data), dict[str, list[Row]]()
            columns |= dict.fromkeys(summary.columns)
            for row in known_rows(summary):
                point = row | {"at": sweep.shown(row["at"])}
                lines.append({"sweep": sweep.name, **point})
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
        return Output({"seeds": results[-1].seeds, "sweeps": tree}, lines, figure, [*columns])

    def printed(self, data: pd.DataFrame) -> Printed:
        """Return a line for each curve; for each position if these are more, and have names, which may be long."""
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
    def trials(data: pd.DataFrame) -> list[Row]:
        """Return case, name and known quantities of every trial; `as_asked` if within all its limits; `refusal`."""
        quantities = quantities_of(data)
        limit = data[[f"{each}{_LIMIT}" for each in quantities]].to_numpy()
        as_asked = ((data[quantities].to_numpy() <= limit) | np.isnan(limit)).all(axis=1)  # false without a result
        shown = data[["case", "name", *quantities]].assign(as_asked=as_asked, refusal=data["problem"])
        return known_rows(shown)

    @staticmethod
    def summary(data: pd.DataFrame) -> pd.DataFrame:
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
        trials, quantities = self.trials(data), quantities_of(data)
        cases: dict[str, Row] = {}
        for case in data["case"].cat.categories:
            here = [each for each in trials if each["case"] == case]
            counts = {"trials": len(here), "as_asked": sum(each["as_asked"] for each in here)}
            refusals = [each["refusal"] for each in here if each["refusal"]]
            cases[case] = {**counts, "refusals": refusals, **{quantity: {} for quantity in quantities}}
        for row in known_rows(self.summary(data)):
            cases[row.pop("case")][row.pop("quantity")] = row
        columns = ["case", "name", *quantities, "as_asked", "refusal"]
        tree = {"seeds": results[-1].seeds, "title": self.title, "cases": cases}
        return Output(tree, trials, self.figure(data), columns)

    def printed(self, data: pd.DataFrame) -> Printed:
        """Return a line for each case, and the refusals."""
        trials, quantities = self.trials(data), quantities_of(data)
        cells: dict[tuple[str, str], str] = {}
        for row in known_rows(self.summary(data)):
            asked = f" ({row['asked']:g})" if "asked" in row else ""
            known = f"{row['median']:.3g} / {row['worst']:.3g}{asked}" if "worst" in row else "-"
            cells[row["case"], row["quantity"]] = known
        lines = []
        for case in data["case"].cat.categories:
            are_as_asked = [trial["as_asked"] for trial in trials if trial["case"] == case]
            counted = f"{sum(are_as_asked)} of {len(are_as_asked)}"
            lines.append([case, counted, *(cells[case, quantity] for quantity in quantities)])
        refusals = (f"{each['case']}, {each['name']}: {each['refusal']}" for each in trials if each["refusal"])
        return Printed(self.title, ("", "as asked", *quantities), lines, ["median / worst (limit)", *refusals])

    def figure(self, data: pd.DataFrame) -> Figure:
        """Draw every trial as a point, a panel per quantity, a row per case; short black lines are the limits."""
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
    """Return one trial: measured values and upper limits by quantity with its unit; at least one has a limit."""
    values = {each: float(value) for each, value in measured.items()}
    values |= {f"{each}{_LIMIT}": limits.get(each, math.nan) for each in measured}
    return CaseResult(at={"case": case}, values=values, name=name, problem=problem)


def quantities_of(data: pd.DataFrame) -> list[str]:
    """Return the quantities that trials have measured."""
    return [name for name in data if f"{name}{_LIMIT}" in data]


PAPER_NUMBERS = ("min_rad", "max_rad", "mean_rad")
LIGHTS = {"neglected": True, "real": False}  # ways of the light to the lenslets, and `Field.neglect_propagation`
_HEADINGS = {"neglected": "ours: min, max, mean", "real": "in real light"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonTable(Study):
    """Residuals of several methods on the same frames, in both lights, beside the numbers of the paper.

    The cases have `views` and `truth`, rad, (view_row, view_column, lenslet_row, lenslet_column).
    """

    paper: Mapping[str, tuple[float, float, float]]  # by method, see PAPER_NUMBERS, rad; with neglected propagation
    compared_to: str  # where the true wavefronts are from

    dims: ClassVar = ("method", "light")

    def summary(self, data: pd.DataFrame) -> pd.DataFrame:
        """Minimum, maximum and mean over the views, averaged over the seeds, and the spread of the means."""
        known = data[data["views"].notna()]
        residuals = [rms(views - truth) for views, truth in zip(known["views"], known["truth"], strict=True)]
        least, most = ([over(each) for each in residuals] for over in (np.nanmin, np.nanmax))
        known = known.assign(min_rad=least, max_rad=most, mean_rad=[np.nanmean(each) for each in residuals])
        seeds = known.groupby([*self.dims], observed=True)
        summary = seeds[[*PAPER_NUMBERS]].mean()
        summary["spread_rad"] = seeds["mean_rad"].std().fillna(0.0)
        summary["lost_lenslets"], summary["seconds"] = seeds["lost"].mean(), seeds["seconds"].mean()
        return summary.assign(seeds=seeds.size()).reset_index()

    @staticmethod
    def problems(data: pd.DataFrame) -> dict[str, str]:
        """Return the last problem of each method that had one; real light is named."""
        told = data[data["problem"] != ""]
        names = told["method"].astype(str) + np.where(told["light"] == "real", " in real light", "")
        return dict(zip(names, told["problem"], strict=True))

    def output(self, results: Sequence[StudyResult]) -> Output:
        """Return the paper's numbers beside ours in both lights."""
        data = results[-1].data
        problems = self.problems(data)
        if "views" not in data:
            raise InputError("; ".join(f"{method}: {problem}" for method, problem in problems.items()))
        paper = {method: dict(zip(PAPER_NUMBERS, numbers, strict=True)) for method, numbers in self.paper.items()}
        ours: dict[str, dict[str, Row]] = {light: {} for light in LIGHTS}
        for row in known_rows(self.summary(data)):
            ours[row["light"]][row["method"]] = row
        tree = {"paper": paper, "ours": ours["neglected"], "in_real_light": ours["real"], "problems": problems}
        lines = [
            {"method": method}
            | {f"paper_{name}": value for name, value in paper.get(method, {}).items()}
            | ours["neglected"].get(method, {})
            | {f"real_{name}": value for name, value in ours["real"].get(method, {}).items()}
            for method in dict.fromkeys([*ours["neglected"], *ours["real"]])
        ]
        return Output(tree, lines, self.figure(data))

    def printed(self, data: pd.DataFrame) -> Printed:
        """Return a line for each method."""
        lines: dict[str, list[str]] = {}
        lights = data["light"].cat.categories.tolist()
        for row in known_rows(self.summary(data)):
            method = row["method"]
            paper = " ".join(f"{value:6.3f}" for value in self.paper.get(method, ()))
            cells = lines.setdefault(method, [method, paper, *("",) * 2 * len(lights)])
            ours = " ".join(f"{row[number]:6.3f}" for number in PAPER_NUMBERS)
            spread = f" +- {row['spread_rad']:.3f}" if row["seeds"] > 1 else ""
            place = 2 + 2 * lights.index(row["light"])
            cells[place : place + 2] = ours + spread, f"{row['lost_lenslets']:.0f}"
        of_lights = [heading for light in lights for heading in (_HEADINGS[light], "lost")]
        notes = [f"{method}: {problem}" for method, problem in self.problems(data).items()]
        return Printed(self.title, ("method", "paper: min, max, mean", *of_lights), lines.values(), notes)

    def figure(self, data: pd.DataFrame) -> Figure:
        """Draw truth, reconstruction and residual of every method and light for its last seed, on one colour scale."""
        shown = data[data["views"].notna()].drop_duplicates([*self.dims], keep="last")
        means = self.summary(data)["mean_rad"]
        limit = max(float(np.nanmax(abs(truth))) for truth in shown["truth"])
        scale = Normalize(-limit, limit)
        figure = Figure(figsize=(8.6, 2.4 * len(shown) + 0.6), layout="constrained")
        axes = figure.subplots(len(shown), 3, squeeze=False)
        for row, mean_rad, of_row in zip(axes, means, shown.itertuples(), strict=True):
            name = of_row.method + ", real light" * (of_row.light == "real")
            residual = f"residual, mean RMS {mean_rad:.3f} rad"
            titled = {self.compared_to: of_row.truth, name: of_row.views, residual: of_row.views - of_row.truth}
            for axis, (title, values) in zip(row, titled.items(), strict=True):
                framed = np.pad(without_piston(values), ((0, 0), (0, 0), (1, 1), (1, 1)), constant_values=np.nan)
                mosaic = np.block([list(each) for each in framed])  # views as they lie in the field, with gaps
                axis.imshow(mosaic, cmap="RdBu_r", norm=scale, interpolation="nearest")
                axis.set_title(title, fontsize=8)
                axis.set_axis_off()
        figure.colorbar(ScalarMappable(scale, "RdBu_r"), ax=axes, label="wavefront (rad)", shrink=0.6)
        return figure


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographStudy(Study):
    """Restored photographs of several objects: `image` (row, column) over the object's peak, and `psnr_db`."""

    dims: ClassVar = ("object", "way")

    def output(self, results: Sequence[StudyResult]) -> Output:
        """Return mean, lowest and highest peak signal-to-noise ratio over the repeats, dB, and the pictures."""
        data = results[-1].data
        psnr_db = data.groupby([*self.dims], observed=True)["psnr_db"]
        summary = pd.DataFrame({"mean_db": psnr_db.mean(), "least_db": psnr_db.min(), "most_db": psnr_db.max()})
        lines = known_rows(summary.dropna().reset_index())
        return Output({"seeds": results[-1].seeds, "title": self.title, "photographs": lines}, lines, self.figure(data))

    def printed(self, data: pd.DataFrame) -> Printed:
        """Return a line for each object."""
        means = self._means(data).dropna(axis="columns", how="all")
        rows = zip(means.index, means.to_numpy(), strict=True)
        lines = [[name, *(f"{each:.1f}" for each in row)] for name, row in rows]
        return Printed(self.title, ("object", *means.columns), lines)

    def figure(self, data: pd.DataFrame) -> Figure:
        """Draw the pictures of the first repeat, a row per object, a column per way; brightness has a gamma of 1/2."""
        means = self._means(data)
        figure = Figure(figsize=(2.4 * means.shape[1], 2.65 * means.shape[0]), layout="constrained")
        axes = figure.subplots(*means.shape, squeeze=False)
        first = data.drop_duplicates([*self.dims])
        shown = zip(axes.flat, first["way"], means.to_numpy().flat, first["image"], strict=True)
        for axis, way, mean_db, image in shown:
            axis.imshow(np.sqrt(np.clip(image, 0, 1)), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            known = f", {mean_db:.1f} dB" if np.isfinite(mean_db) else ""
            axis.set_title(f"{way}{known}", fontsize=8)
            axis.set_axis_off()
        return figure

    def _means(self, data: pd.DataFrame) -> pd.DataFrame:
        return data.pivot_table("psnr_db", *self.dims, observed=True, dropna=False)
