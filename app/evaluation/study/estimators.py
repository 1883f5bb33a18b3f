"""The estimators whose residual is studied, prepared for one reference of one bench."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.evaluation.study.exact import exact_wavefront
from app.evaluation.study.observations import At, Observation
from app.measurement.imaging_model import BenchModel
from reconstruction.arrays import Floats, Image, Mask
from reconstruction.displacement import Displacement, Outcome
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise
from reconstruction.refinement import Refinement
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, Warp
from reconstruction.wavefront import Wavefront, rms
from simulated_devices.sample import Sample

ROUNDS = 3
WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic")
REFINED: tuple[Warp, ...] = ("quadratic", "cubic")
AUTOMATIC = ReconstructionSettings()  # modal, by as many modes as the lattice carries, smoothly


class Estimator:
    """One warp and one way to the wavefront, with its refinement."""

    def __init__(
        self,
        bench: Bench,
        reference: Image,
        warp: Warp | None,
        *,
        reconstruction: ReconstructionSettings = AUTOMATIC,
        noise: CameraNoise | None = None,
    ) -> None:
        """Prepare for a reference (row, column) above the dark, in the unit of the frames to come."""
        self._bench = bench
        method = replace(bench, registration=RegistrationSettings(warp=warp), reconstruction=reconstruction)
        self.reconstructor = method.reconstructor(
            reference,
            lattice=bench.design_lattice(*reference.shape),
            dark=np.zeros_like(reference),
            noise=noise,
        )

    @cached_property
    def refinement(self) -> Refinement:
        """The model of the bench, made when it is first asked for."""
        return Refinement(self.reconstructor, BenchModel(self._bench, self.reconstructor))

    def rounds(self, displacement: Displacement, most: int = ROUNDS) -> list[tuple[Wavefront, float]]:
        """The wavefront after each round of refinement, and the seconds that it took.

        Where refinement ends itself, the rounds to come leave everything as it is.
        """
        results, refinement = [(self.reconstructor.solve(displacement), math.nan)], self.refinement
        start_s = time.perf_counter()
        for step in refinement.rounds(displacement, most):
            end_s = time.perf_counter()
            results.append((step.wavefront, end_s - start_s))
            start_s = end_s
        return results[1:] + [(results[-1][0], math.nan)] * (most + 1 - len(results))


class Estimators:
    """The estimators that most sweeps look at: each warp in one pass, and refined."""

    def __init__(
        self,
        bench: Bench,
        reference: Image,
        *,
        noise: CameraNoise | None = None,
        warps: tuple[Warp, ...] = WARPS,
        refined: tuple[Warp, ...] = REFINED,
    ) -> None:
        self._refined = refined
        self.by_warp = {warp: Estimator(bench, reference, warp, noise=noise) for warp in warps}

    def observe(
        self,
        frame: Image,
        truth: Floats,
        at: At,
        *,
        prefix: str = "",
        views: NDArray[np.bool_] | None = None,
        sample: Sample | None = None,
    ) -> Iterator[Observation]:
        """Look at a frame (row, column) whose wavefronts are `truth`; see `observed`.

        Where the `sample` is given, also at the wavefronts from its own slopes.
        """
        for warp, estimator in self.by_warp.items():
            curve = prefix + warp
            try:
                displacement = estimator.reconstructor.register(frame)
                wavefront = estimator.reconstructor.solve(displacement)
                yield observed(curve, at, wavefront, truth, views=views)
                if sample is not None:
                    wavefront = exact_wavefront(sample, estimator.reconstructor, displacement)
                    yield observed(f"{curve}, true slopes", at, wavefront, truth, views=views)
                if warp in self._refined:
                    curve += " refined"
                    wavefront, _ = estimator.rounds(displacement)[-1]
                    yield observed(curve, at, wavefront, truth, views=views)
            except ReconstructionError:
                yield nothing(curve, at, estimator)


def observed(
    curve: str,
    at: At,
    wavefront: Wavefront,
    truth: Floats,
    *,
    views: NDArray[np.bool_] | None = None,
    lenslets: Mask | None = None,
    seconds: float = math.nan,
) -> Observation:
    """Compare a wavefront with the truth (view_row, view_column, lenslet_row, lenslet_column), rad.

    All `views` (view_row, view_column) count if none are given, and the valid ones of the lenslets.
    """
    displacement = wavefront.displacement
    lenslets = displacement.valid if lenslets is None else lenslets
    outcome = displacement.outcome
    return Observation(
        curve=curve,
        at=at,
        rms_rad=mean_rms(wavefront.views - truth, lenslets, views),
        lost=int(np.count_nonzero(outcome != Outcome.CONVERGED)),
        left_cell=int(np.count_nonzero(outcome == Outcome.LEFT_CELL)),
        seconds=seconds,
    )


def mean_rms(difference: Floats, lenslets: Mask, views: NDArray[np.bool_] | None = None) -> float:
    """Mean over the views of the RMS over the lenslets, piston left out; NaN where no view is known."""
    of_views = rms(np.where(lenslets, difference, np.nan))
    of_views = of_views[np.isfinite(of_views) & (True if views is None else views)]
    return float(of_views.mean()) if of_views.size else math.nan


def nothing(curve: str, at: At, estimator: Estimator) -> Observation:
    """What there is to say where there is no result."""
    sensor = estimator.reconstructor.sensor
    return Observation(curve=curve, at=at, rms_rad=math.nan, lost=sensor.lenslet_rows * sensor.lenslet_columns)
