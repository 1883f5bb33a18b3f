"""What a trial is: one try of a routine whose outcome is held against what is asked of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from app.bench.config import Bench
from app.progress import Progress


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One try: what came out by quantity, and at most how much of it is asked."""

    case: str  # what it was tried on
    name: str  # tells it from the others of its case
    figures: Mapping[str, float]  # by quantity with its unit; NaN where there is no result
    asked: Mapping[str, float]  # likewise; not every quantity has a limit
    refusal: str = ""  # what was said where there is no result

    @property
    def holds(self) -> bool:
        """Whether all that is asked is reached; what has no result reaches nothing."""
        return all(self.figures[quantity] <= most for quantity, most in self.asked.items())


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialStudy:
    """Many trials of one routine; `run` makes them with a bench and so many seeds."""

    name: str
    title: str
    run: Callable[[Bench, int, Progress], Iterator[Trial]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """One quantity over all trials of a case."""

    median: float
    worst: float
    asked: float  # NaN where nothing is


@dataclass(frozen=True, slots=True)
class TrialOutcome:
    """What the trials of a study have shown."""

    study: TrialStudy
    trials: tuple[Trial, ...]

    @property
    def cases(self) -> list[str]:
        """Their names, in the order of their appearance."""
        return list(dict.fromkeys(trial.case for trial in self.trials))

    @property
    def quantities(self) -> list[str]:
        """Likewise."""
        return list(dict.fromkeys(quantity for trial in self.trials for quantity in trial.figures))

    def of(self, case: str) -> list[Trial]:
        """The trials of a case."""
        return [trial for trial in self.trials if trial.case == case]

    def summary(self, case: str, quantity: str) -> Summary:
        """Summarise what is known of a quantity."""
        trials = self.of(case)
        known = [value for trial in trials if math.isfinite(value := trial.figures.get(quantity, math.nan))]
        return Summary(
            median=float(np.median(known)) if known else math.nan,
            worst=max(known, default=math.nan),
            asked=trials[0].asked.get(quantity, math.nan),
        )
