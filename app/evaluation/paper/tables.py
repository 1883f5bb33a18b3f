"""The tables of the paper, theirs and ours: `svwfs paper table1 | table2 | sources`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.errors import InputError
from app.evaluation.noise_free import seeded
from app.evaluation.paper.frames import Frames, exposed_frames, noise_free_frames, resized
from app.evaluation.paper.methods import METHODS, PAPER_TABLE_1, PAPER_TABLE_2, Mask, Method
from app.evaluation.paper.residuals import Measured, measured
from app.progress import Progress, part
from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError

Views = NDArray[np.bool_]

EXPOSURES_S: dict[Mask, float] = {"stars": 3.8, "square": 0.15}  # the paper's
SOURCES = ("square", "circle", "ellipse", "octagon", "peaks")


@dataclass(slots=True)
class Entry:
    """The residuals of one method, gathered over the seeds."""

    rms_rad: list[Floats] = field(default_factory=list)  # of each seed: (view,), those inside the field
    lost: int = 0
    seconds: float = 0.0

    def add(self, result: Measured, truth: Floats) -> None:
        """Gather the result of one more seed."""
        rms_rad = result.residual_rms(truth)
        self.rms_rad.append(rms_rad[np.isfinite(rms_rad)])
        self.lost += result.lost
        self.seconds = result.seconds

    def summary(self) -> dict[str, float]:
        """Minimum, maximum and mean over the views, averaged over the seeds, and the spread of the means."""
        values = np.array(self.rms_rad).reshape(len(self.rms_rad), -1)
        means = values.mean(axis=1)
        return {
            "min_rad": float(values.min(axis=1).mean()),
            "max_rad": float(values.max(axis=1).mean()),
            "mean_rad": float(means.mean()),
            "spread_rad": float(means.std(ddof=1)) if len(means) > 1 else 0.0,
            "lost_lenslets": self.lost / len(self.rms_rad),
            "seconds": self.seconds,
            "seeds": len(self.rms_rad),
        }


@dataclass(slots=True)
class Table:
    """One table: what the paper prints and what we measure."""

    name: str
    title: str
    paper: Mapping[str, tuple[float, float, float]]
    reference: str  # what the residuals are measured against
    inside: Views  # the views that lie in the field, (view_row, view_column)
    entries: dict[str, Entry] = field(default_factory=dict)
    last: dict[str, tuple[Floats, Floats]] = field(default_factory=dict)  # truth and views of the last seed
    problems: dict[str, str] = field(default_factory=dict)  # why a method gives nothing

    def add(self, name: str, result: Measured, truth: Floats) -> None:
        """Gather a method's result for one seed; one that leaves a view of the field unknown has no residual."""
        if np.isnan(result.residual_rms(truth)[self.inside]).any():
            self.problems[name] = f"{result.lost} lenslets are lost: a view is unknown"
            return
        self.entries.setdefault(name, Entry()).add(result, truth)
        self.last[name] = truth, result.views


def table1(bench: Bench, seeds: int, *, peers: bool, progress: Progress) -> Table:
    """The paper's simulation: every method on noise-free frames of the same screens, against the truth."""
    table = Table("table1", "Simulation: residual RMS (rad) against the truth", PAPER_TABLE_1, "truth", _inside(bench))
    methods = _methods(peers=peers)
    for index, screen in enumerate(seeded(bench, seeds)):
        step = part(progress, index, seeds)
        step("rendering", 0.0)
        frames, truth = noise_free_frames(screen, ("square", "stars"))
        _run(table, screen, frames, truth, methods, step)
    return table


def table2(bench: Bench, seeds: int, *, peers: bool, progress: Progress) -> Table:
    """The paper's experiment, through the whole instrument: noisy frames, both exposures, the stars as the truth.

    Every method is run twice: on windows at their true sub-pixel centres, and (`_resized`) as in the paper on frames
    that were cut and resized first. `against_truth` compares the stars themselves with the true wavefronts.
    """
    table = Table("table2", "Experiment: residual RMS (rad) against the stars", PAPER_TABLE_2, "stars", _inside(bench))
    methods = {name: method for name, method in _methods(peers=peers).items() if method.mask == "square"}
    for index, screen in enumerate(seeded(bench, seeds)):
        step = part(progress, index, seeds)
        step("rendering and exposing", 0.0)
        frames, truth = exposed_frames(screen, EXPOSURES_S, lambda _: None)
        stars = _stars(screen, frames)
        table.add("stars_zonal_against_truth", stars, truth)
        _run(table, screen, frames, stars.views, methods, part(step, 0, 2))
        small_bench, small = resized(screen, frames)
        small_stars = _stars(small_bench, small)
        table.add("stars_zonal_resized_against_truth", small_stars, truth)
        small_methods = {f"{name}_resized": method for name, method in methods.items()}
        _run(table, small_bench, small, small_stars.views, small_methods, part(step, 1, 2))
    return table


def sources(bench: Bench, seeds: int, *, progress: Progress) -> Table:
    """The robustness study of the paper's supplement: the same screens behind sources of other shapes."""
    table = Table("sources", "Other sources: residual RMS (rad) against the truth", {}, "truth", _inside(bench))
    kinds = ("affine_zonal", "affine_modal", "quadratic_zonal", "quadratic_modal")
    for index, screen in enumerate(seeded(bench, seeds)):
        step = part(progress, index, seeds)
        step("rendering", 0.0)
        frames, truth = noise_free_frames(screen, SOURCES)
        for source in SOURCES:
            methods = {f"{source}_{kind}": METHODS[kind] for kind in kinds}
            _run(table, screen, {"square": frames[source]}, truth, methods, step)
    return table


def _inside(bench: Bench) -> Views:
    """Which views lie in the field, (view_row, view_column)."""
    x, y = bench.field.view_x_m, bench.field.view_y_m
    return bench.field.contains(x / bench.field.half_width_m, y[:, None] / bench.field.half_width_m)


def _stars(bench: Bench, frames: Mapping[str, Frames]) -> Measured:
    """What the stars show: without them the experiment has nothing to be measured against."""
    try:
        return measured(bench, frames, METHODS["stars_zonal"])
    except ReconstructionError as error:
        raise InputError(f"the stars cannot be measured on this bench: {error}") from error


def _methods(*, peers: bool) -> dict[str, Method]:
    return {name: method for name, method in METHODS.items() if peers or not method.is_peer}


def _run(
    table: Table,
    bench: Bench,
    frames: Mapping[str, Frames],
    truth: Floats,
    methods: Mapping[str, Method],
    progress: Progress,
) -> None:
    for done, (name, method) in enumerate(methods.items()):
        progress(name, done / len(methods))
        try:
            table.add(name, measured(bench, frames, method), truth)
        except ReconstructionError as error:
            table.problems[name] = str(error)
