"""Estimators under study, prepared for one reference of one bench, and their wavefronts beside the truth."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.evaluation.studies import CaseResult, Position
from app.measurement.calibration import Calibration
from app.measurement.estimator import ROUNDS, Estimator
from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import Outcome
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, Warp
from reconstruction.wavefront import Wavefront, mean_rms

WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic", "quartic")
REFINED: tuple[Warp, ...] = ("quadratic", "cubic", "quartic")
AUTOMATIC = ReconstructionSettings()  # modal, the number of modes chosen from the lattice


def warp_estimator(
    bench: Bench,
    reference: Image,
    warp: Warp | None,
    *,
    reconstruction: ReconstructionSettings = AUTOMATIC,
    noise: CameraNoise | None = None,
) -> Estimator:
    """Prepare one warp for a reference (row, column) above the dark, in the unit of the frames."""
    method = replace(bench, registration=RegistrationSettings(warp=warp), reconstruction=reconstruction)
    lattice, dark = bench.design_lattice(*reference.shape), np.zeros_like(reference)
    given = Calibration.of_images(method, reference, dark=dark, lattice=lattice)
    return Estimator(replace(given, known=KnownNoise(noise)))


def warp_estimators(
    bench: Bench, reference: Image, warps: tuple[Warp, ...] = WARPS, noise: CameraNoise | None = None
) -> dict[Warp, Estimator]:
    """Prepare several warps for a reference, see `warp_estimator`."""
    return {warp: warp_estimator(bench, reference, warp, noise=noise) for warp in warps}


def compare(
    estimators: Mapping[Warp, Estimator],
    frame: Image,
    truth: Floats,
    at: Position,
    *,
    prefix: str = "",
    views: NDArray[np.bool_] | None = None,
    refined: tuple[Warp, ...] = REFINED,
) -> Iterator[CaseResult]:
    """Compare the wavefronts of a frame (row, column) with the truth, see `compared`.

    Each warp has one pass; those in `refined` have another with the layers found, and then their refinement.
    """
    for warp, estimator in estimators.items():
        curve = prefix + warp
        try:
            reconstructor = estimator.reconstructor  # may refuse
            displacement = reconstructor.register(frame)
            yield compared(curve, at, reconstructor.solve(displacement), truth, views=views)
            if warp in refined:
                sample = reconstructor.find_sample(displacement)
                wavefront = reconstructor.solve(displacement, sample=sample)
                yield compared(f"{curve} layers", at, wavefront, truth, views=views)
                curve += " refined"
                wavefront, _ = estimator.solve(displacement, sample=sample, rounds=ROUNDS)
                yield compared(curve, at, wavefront, truth, views=views)
        except ReconstructionError as error:
            yield without_wavefront(curve, at, estimator, error)


def without_wavefront(curve: str, at: Position, estimator: Estimator, why: ReconstructionError) -> CaseResult:
    """Return the result of a frame that has no wavefront: all lenslets are lost."""
    sensor = estimator.calibration.bench.sensor
    values = {"rms_rad": math.nan, "lost": float(sensor.lenslet_rows * sensor.lenslet_columns), "left_cell": 0.0}
    return CaseResult(at={"curve": curve, "at": at}, values=values, problem=str(why))


def compared(
    curve: str,
    at: Position,
    wavefront: Wavefront,
    truth: Floats,
    *,
    views: NDArray[np.bool_] | None = None,
    lenslets: Booleans | None = None,
) -> CaseResult:
    """Compare a wavefront with the truth (view_row, view_column, lenslet_row, lenslet_column), rad; see `with_rms`.

    Without `views` (view_row, view_column) all of them count, without `lenslets` the valid ones.
    """
    lenslets = wavefront.displacement.valid if lenslets is None else lenslets
    return with_rms(curve, at, wavefront, mean_rms_within(wavefront.views - truth, lenslets, views))


def with_rms(curve: str, at: Position, wavefront: Wavefront, rms_rad: float, **more: float) -> CaseResult:
    """Return an RMS with the counts of lost lenslets of a wavefront.

    More are `asked_rad`, a limit of its own, and `coverage`, the share of lenslets within the error bar `rms_rad`.
    """
    outcome = wavefront.displacement.outcome
    lost, left_cell = np.sum(outcome != Outcome.CONVERGED), np.sum(outcome == Outcome.LEFT_CELL)
    values = {"rms_rad": rms_rad, "lost": float(lost), "left_cell": float(left_cell)}
    return CaseResult(at={"curve": curve, "at": at}, values=values | more)


def mean_rms_within(difference: Floats, lenslets: Booleans, views: NDArray[np.bool_] | None = None) -> float:
    """Mean over the views of the RMS over the lenslets without piston; NaN if no view is known.

    `difference` (view_row, view_column, lenslet_row, lenslet_column), rad; `lenslets` and `views` that count.
    """
    counted = np.where(lenslets, difference, np.nan)
    return mean_rms(counted if views is None else counted[views])
