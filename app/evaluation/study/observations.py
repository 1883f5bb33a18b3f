"""What a sweep is, and what it observes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from app.bench.config import Bench
from app.progress import Progress

At = float | str  # what is varied: a number on the sweep's axis, or a name


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """What one estimator makes of one frame."""

    curve: str  # the estimator, and what else tells this line of the figure from the others
    at: At
    rms_rad: float  # mean over the views of the RMS over the valid lenslets; NaN where there is no result
    lost: int = 0  # lenslets without a displacement
    left_cell: int = 0  # those of them whose subimage reaches into the neighbour's cell
    seconds: float = math.nan  # where time is what was asked


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One point of a curve: the observations of all seeds."""

    mean_rad: float
    spread_rad: float  # standard deviation over the observations; 0 of a single one
    observations: int  # with a result
    lost_lenslets: float  # mean
    left_cell_lenslets: float  # mean
    seconds: float
    asked_rad: float  # at most so much is asked of the estimator; NaN where nothing is


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """One thing that is varied; `run` observes with a bench and so many seeds."""

    name: str
    title: str
    axis: str  # what is varied, with its unit
    run: Callable[[Bench, int, Progress], Iterator[Observation]]
    axis_per_si: float = 1.0  # what `axis` says, for a number that is varied
    is_logarithmic: bool = False  # the axis of what is varied
    left_out: tuple[str, ...] = ()  # of the figure: curves that have one of these in their names
    asked_rad: Mapping[str, Mapping[At, float]] = field(default_factory=dict)  # of curve and at


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a sweep has observed."""

    sweep: Sweep
    observations: tuple[Observation, ...]

    def shown(self, at: At) -> At:
        """What is varied, in the unit of the sweep's axis."""
        return at if isinstance(at, str) else float(f"{at * self.sweep.axis_per_si:.6g}")

    @property
    def curves(self) -> list[str]:
        """Their names, in the order of their appearance."""
        return list(dict.fromkeys(each.curve for each in self.observations))

    @property
    def positions(self) -> list[At]:
        """Where they were observed, in the order of their appearance."""
        return list(dict.fromkeys(each.at for each in self.observations))

    def points(self, curve: str) -> dict[At, Point]:
        """Summarise a curve."""
        return {
            at: self._point([each for each in self.observations if (each.curve, each.at) == (curve, at)])
            for at in self.positions
            if any((each.curve, each.at) == (curve, at) for each in self.observations)
        }

    def _point(self, observations: list[Observation]) -> Point:
        found = np.array([each.rms_rad for each in observations if math.isfinite(each.rms_rad)])
        timed = [each.seconds for each in observations if math.isfinite(each.seconds)]
        curve, at = observations[0].curve, observations[0].at
        return Point(
            mean_rad=float(found.mean()) if found.size else math.nan,
            spread_rad=float(found.std(ddof=1)) if found.size > 1 else 0.0,
            observations=found.size,
            lost_lenslets=float(np.mean([each.lost for each in observations])),
            left_cell_lenslets=float(np.mean([each.left_cell for each in observations])),
            seconds=float(np.median(timed)) if timed else math.nan,
            asked_rad=self.sweep.asked_rad.get(curve, {}).get(at, math.nan),
        )
