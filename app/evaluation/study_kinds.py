"""Declarations of studies, and the summary of each kind over its repeats."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from app.bench.config import Bench
from app.evaluation.cases import REPEAT, CaseResult, Position
from app.progress import Progress
from reconstruction.wavefront import rms

PAPER_NUMBERS = ("min_rad", "max_rad", "mean_rad")
LIGHTS = {"neglected": True, "real": False}  # ways of the light to the lenslets, and `Field.neglect_propagation`
VIEWS = ("view_row", "view_column")
LENSLETS = ("lenslet_row", "lenslet_column")


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """A named set of cases; `measure` yields their results for a bench and some seeds, in the same order for each."""

    name: str
    title: str
    measure: Callable[[Bench, range, Progress], Iterable[CaseResult]]

    dims: ClassVar[tuple[str, ...]] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep(Study):
    """Residuals of several estimators (`curve`) against one varied quantity (`at`)."""

    axis: str  # the varied quantity with its unit
    axis_per_si: float = 1.0  # unit of `axis` per SI unit
    is_logarithmic: bool = False
    left_out: tuple[str, ...] = ()  # the figure leaves out curves with one of these in their names
    limits_rad: Mapping[str, Mapping[Position, float]] = field(default_factory=dict)  # by curve and position

    dims: ClassVar = ("curve", "at")

    def shown(self, at: Position) -> Position:
        """Convert a position from SI units to the unit of the axis."""
        return at if isinstance(at, str) else float(f"{at * self.axis_per_si:.6g}")

    def summary(self, data: xr.Dataset) -> xr.Dataset:
        """Mean residual and spread over the repeats with a result, mean of lost lenslets, median time, limit.

        A limit measured with the result, `asked_rad`, precedes `limits_rad`; `coverage` is that of an error bar.
        """
        found = data["rms_rad"].count(REPEAT)
        mean = data["rms_rad"].mean(REPEAT)
        spread = np.sqrt(((data["rms_rad"] - mean) ** 2).sum(REPEAT) / (found - 1).clip(min=1))
        curves, positions = data["curve"].values.tolist(), data["at"].values.tolist()
        limits = [[self.limits_rad.get(curve, {}).get(at, math.nan) for at in positions] for curve in curves]
        asked = xr.DataArray(np.array(limits), dims=self.dims)
        measured = {name: data[name].mean(REPEAT) for name in ("asked_rad", "coverage") if name in data}
        summary = xr.Dataset(
            {
                "mean_rad": mean,
                "spread_rad": spread,
                "observations": found,
                "lost_lenslets": data["lost"].mean(REPEAT),
                "left_cell_lenslets": data["left_cell"].mean(REPEAT),
                "seconds": data["seconds"].median(REPEAT),
            }
            | measured
            | {"asked_rad": measured["asked_rad"].fillna(asked) if "asked_rad" in measured else asked}
        )
        return summary.where(data["lost"].count(REPEAT) > 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialStudy(Study):
    """Many trials of one routine, see `trial`; `data` holds `measured` and `limit` (case, repeat, quantity)."""

    dims: ClassVar = ("case",)

    @staticmethod
    def trials(data: xr.Dataset) -> Iterator[dict[str, Any]]:
        """Yield case, name and known quantities of every trial; `as_asked` if within all its limits; `refusal`."""
        cases, quantities = data["case"].values.tolist(), data["quantity"].values.tolist()
        measured, limit = data["measured"].values, data["limit"].values  # (case, repeat, quantity)
        is_within = ((measured <= limit) | np.isnan(limit)).all(axis=-1)  # false without a result
        for place in zip(*np.isfinite(limit).any(axis=-1).nonzero(), strict=True):  # cases differ in their trials
            values = zip(quantities, measured[place].tolist(), strict=True)
            known = {quantity: value for quantity, value in values if math.isfinite(value)}
            name, problem = data["name"].values[place], data["problem"].values[place]
            yield (
                {"case": cases[place[0]], "name": name}
                | known
                | {"as_asked": bool(is_within[place]), "refusal": problem}
            )

    @staticmethod
    def summary(data: xr.Dataset) -> xr.Dataset:
        """Median, worst value and limit of every quantity, (case, quantity)."""
        measured = data["measured"]
        summary = {"median": measured.median(REPEAT), "worst": measured.max(REPEAT), "asked": data["limit"].max(REPEAT)}
        return xr.Dataset(summary)


def trial(
    *, case: str, name: str, measured: Mapping[str, float], limits: Mapping[str, float], problem: str = ""
) -> CaseResult:
    """Return one trial: measured values and upper limits by quantity with its unit; at least one has a limit."""
    quantities = {"quantity": list(measured)}
    limits_of_all = [limits.get(quantity, math.nan) for quantity in measured]
    values = {
        "measured": xr.DataArray(list(measured.values()), quantities, ["quantity"]),
        "limit": xr.DataArray(limits_of_all, quantities, ["quantity"]),
    }
    return CaseResult(at={"case": case}, values=values, name=name, problem=problem)


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonTable(Study):
    """Residuals of several methods on the same frames, in both lights, beside the numbers of the paper."""

    paper: Mapping[str, tuple[float, float, float]]  # by method, see PAPER_NUMBERS, rad; with neglected propagation
    compared_to: str  # where the true wavefronts are from

    dims: ClassVar = ("method", "light")

    def summary(self, data: xr.Dataset) -> xr.Dataset:
        """Minimum, maximum and mean over the views, averaged over the seeds, and the spread of the means."""
        residual = xr.apply_ufunc(rms, data["views"] - data["truth"], input_core_dims=[LENSLETS])
        means = residual.mean(VIEWS)
        seeds = means.count(REPEAT)
        mean = means.mean(REPEAT)
        summary = {
            "min_rad": residual.min(VIEWS).mean(REPEAT),
            "max_rad": residual.max(VIEWS).mean(REPEAT),
            "mean_rad": mean,
            "spread_rad": np.sqrt(((means - mean) ** 2).sum(REPEAT) / (seeds - 1).clip(min=1)),
            "lost_lenslets": data["lost"].mean(REPEAT),
            "seconds": data["seconds"].mean(REPEAT),
            "seeds": seeds,
        }
        return xr.Dataset(summary).where(seeds > 0)

    @staticmethod
    def problems(data: xr.Dataset) -> dict[str, str]:
        """Return the last problem of each method that had one; real light is named."""
        found = {}
        for method in data["method"].values.tolist():
            for light in data["light"].values.tolist():
                texts = data["problem"].sel({"method": method, "light": light}).values.tolist()
                if known := [text for text in texts if text]:
                    found[method + " in real light" * (light == "real")] = known[-1]
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographStudy(Study):
    """Restored photographs of several objects; `data` holds `image` (row, column) over the object's peak, `psnr_db`."""

    dims: ClassVar = ("object", "way")

    @staticmethod
    def summary(data: xr.Dataset) -> xr.Dataset:
        """Mean, lowest and highest peak signal-to-noise ratio over the repeats, dB."""
        psnr_db = data["psnr_db"]
        numbers = {"mean_db": psnr_db.mean(REPEAT), "least_db": psnr_db.min(REPEAT), "most_db": psnr_db.max(REPEAT)}
        return xr.Dataset(numbers)


@dataclass(frozen=True, slots=True)
class StudyResult:
    """A finished study."""

    study: Study
    data: xr.Dataset
    seeds: int


def sweeps_of(results: Iterable[StudyResult]) -> list[tuple[Sweep, xr.Dataset]]:
    """Return the sweeps among the results, with their data."""
    return [(result.study, result.data) for result in results if isinstance(result.study, Sweep)]
