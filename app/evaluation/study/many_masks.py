"""Many source masks compared by prediction alone: noise and bias of one pass against the light that each lets through.

The noise is the Cramer-Rao bound in equal exposure: that which gives a plain square some electrons in the brightest
pixel of its reference. The bias is that of `LinearPass`, with any wavefront.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from app.bench.config import Bench
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames, seeded, with_screen, with_source
from app.evaluation.studies import CaseResult, Output, Printed, Study, StudyResult, known_rows
from app.evaluation.study.estimators import WarpEstimator, mean_rms
from app.evaluation.study.mask import PEAKS_E, WARP, LinearPass, mask_changes
from app.evaluation.study.noise import bound_rad, camera, without_prior
from app.evaluation.study.sweeps import NEAR_SOURCE, lit_views
from app.progress import Progress
from reconstruction.arrays import Image
from reconstruction.errors import ReconstructionError

_SAMPLES: dict[str, dict[str, Any]] = {"bench": {}, "source": NEAR_SOURCE | {"rms_rad": 2.0}}  # changes of the screen
_BOUNDS = {peak_e: f"bound_{peak_e:.0f}_rad" for peak_e in PEAKS_E}
_BIASES = {sample: f"bias_{sample}_rad" for sample in _SAMPLES}
_PICTURES = (".npy", ".png", ".tif", ".tiff")


def many_masks_study(names: Sequence[str]) -> "MaskComparison":
    """Return the comparison of masks named as for `mask_study`; a folder stands for all pictures in it.

    Raises `InputError` if there is none, or if one is unknown or no image.
    """
    files: list[str] = []
    for name in names:
        inside = sorted(Path(name).iterdir()) if Path(name).is_dir() else ()
        found = [str(each) for each in inside if each.suffix.lower() in _PICTURES]
        if Path(name).is_dir() and not found:
            raise InputError(f"the folder {name} holds no picture of a mask: NPY, PNG or TIFF")
        files += found or [name]
    return MaskComparison(
        name="masks",
        title=f"Masks in one pass with the {WARP} warp, predicted",
        measure=partial(_measure, sources=mask_changes("masks", files)),
    )


def _measure(
    bench: Bench, seeds: range, progress: Progress, *, sources: Mapping[str, dict[str, Any]]
) -> Iterator[CaseResult]:
    square, views = NoiseFreeFrames(bench).reference("square"), lit_views(with_source(bench, mask="square"))
    for index, (name, changes) in enumerate(sources.items()):
        progress(name, index / len(sources))
        at, problem, values = {"mask": name}, "", {}
        try:
            values = _predicted(with_source(bench, **changes), square, views, seeds)
        except (InputError, ReconstructionError) as error:  # the others are still worth comparing
            problem = str(error)
        yield CaseResult(at=at, values=values, problem=problem)


def _predicted(bench: Bench, square: Image, views: NDArray[np.bool_], seeds: range) -> dict[str, float]:
    """Light over the square's, hidden displacements, bound at each exposure, and bias: mean over the seeds.

    The views are those inside the square, also where the mask is smaller: else small masks would seem better.
    """
    reference, seen = NoiseFreeFrames(bench).reference(), camera(bench)
    if not lit_views(bench).any():
        raise InputError("no view lies inside it")
    counts = seen.counts(reference * np.float32(PEAKS_E[1] / square.max()))
    estimator = WarpEstimator(bench, counts, WARP, noise=seen.noise, reconstruction=without_prior(bench))
    reconstructor = estimator.reconstructor
    light, peak = float(reference.sum() / square.sum()), float(reference.max() / square.max())
    values = {"light": light, "peak": peak, "hidden": float(reconstructor.hidden)}
    modes = reconstructor.register(counts).modes.count
    for peak_e, bound in _BOUNDS.items():
        try:
            values[bound] = bound_rad(bench, reconstructor, modes, views, exposure=peak_e / PEAKS_E[1])
        except ReconstructionError:  # the mask shows nothing of some wavefronts
            values[bound] = math.nan
    predict = LinearPass(bench, estimator, counts)
    for sample, changes in _SAMPLES.items():
        errors = []
        for screen in seeded(with_screen(bench, **changes), seeds):
            frames = NoiseFreeFrames(screen)
            wavefront = reconstructor.solve(predict(frames.sample))
            error = wavefront.views - frames.renderer.truth_wavefront(0)
            errors.append(mean_rms(error, wavefront.displacement.valid, views))
        values[_BIASES[sample]] = float(np.mean(errors))
    return values


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskComparison(Study):
    """Predictions for many masks, sorted by the bound at the middle exposure."""

    dims: ClassVar = ("mask",)

    @staticmethod
    def summary(data: pd.DataFrame) -> pd.DataFrame:
        """Return a row for each mask that could be predicted: means over the seeds, the best first."""
        means = data.groupby("mask", observed=True).mean(numeric_only=True)
        if "light" not in means:
            raise InputError("; ".join(f"mask {row.mask}: {row.problem}" for row in data.itertuples()))
        return means.dropna(subset="light").sort_values(_BOUNDS[PEAKS_E[1]]).reset_index()

    def output(self, results: Sequence[StudyResult]) -> Output:
        """Return the masks, the best first, and error against light."""
        data = results[-1].data
        lines = known_rows(self.summary(data).astype({"mask": str}))
        return Output({"seeds": results[-1].seeds, "title": self.title, "masks": lines}, lines, self.figure(data))

    def printed(self, data: pd.DataFrame) -> Printed:
        """Return a line for each mask, the best first."""
        numbers = [*_BOUNDS.values(), *_BIASES.values()]
        lines = [
            [str(row["mask"]), f"{row['light']:.2f}", f"{row['hidden']:.0f}", *(f"{row[each]:.4f}" for each in numbers)]
            for row in self.summary(data).to_dict("records")
        ]
        headings = ("mask", "light", "hides", *(f"bound, {peak_e:g} e-" for peak_e in PEAKS_E))
        notes = ["rad; equal exposure; light over the square's; displacements of each lenslet that it hides"]
        notes += [f"{row.mask}: {row.problem}" for row in data.itertuples() if row.problem]
        return Printed(self.title, (*headings, "bias, bench's screen", "bias, near the source"), lines, notes)

    def figure(self, data: pd.DataFrame) -> Figure:
        """Draw error (bound and bias) against light, a panel for each exposure, with the names of the best three."""
        masks = self.summary(data)
        figure = Figure(figsize=(12.0, 4.2), layout="constrained")
        panels = figure.subplots(1, len(PEAKS_E), sharex=True)
        for peak_e, panel in zip(PEAKS_E, panels, strict=True):
            bound = masks[_BOUNDS[peak_e]]
            for sample, marker in (("bench", "o"), ("source", "x")):
                error = np.hypot(bound, masks[_BIASES[sample]])
                label = "bench's screen" if sample == "bench" else "near the source"
                panel.plot(masks["light"], error, marker, markersize=4, alpha=0.7, label=label)
            panel.plot(masks["light"], bound, "k_", markersize=6, label="bound alone")
            best = masks.assign(bound=bound).nsmallest(3, "bound")
            names = []
            for rank, row in enumerate(best.itertuples(), 1):
                at = (row.light, row.bound)
                panel.annotate(f"{rank}", at, (0, -9), textcoords="offset points", fontsize=7, ha="center")
                names.append(f"{rank}  {Path(str(row.mask)).name}")
            panel.set(title=f"{peak_e:g} e-", yscale="log", ymargin=0.12)
            panel.set_xlabel("\n".join(["light over the square's", *names]), fontsize=8)
            panel.grid(visible=True, which="both", linewidth=0.3)
        panels[0].set_ylabel("error: bound and bias (rad)")
        panels[0].legend(fontsize=7)
        figure.suptitle(self.title, fontsize=10)
        return figure
