"""Estimators under study, the camera whose noise they see, and their errors next to the truth."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from app.bench.config import Bench
from app.evaluation.frames import exposure_of
from app.evaluation.mask_accuracy import calibration_of, mean_deviation_rad
from app.measurement.estimator import ROUNDS, Estimator
from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.frame.linearity import Linearity
from reconstruction.frame.linearity_fit import Exposures
from reconstruction.frame.noise import CameraNoise
from reconstruction.reconstructor import Reconstructor
from reconstruction.settings import ReconstructionSettings, Warp
from reconstruction.wavefront import Wavefront, mean_rms, without_piston
from simulated_devices.detector import Detector
from simulated_devices.settings import SimulatedCameraSettings
from studies.tables import Row

WARPS: tuple[Warp, ...] = ("affine", "quadratic", "cubic", "quartic")
REFINED: tuple[Warp, ...] = ("quadratic", "cubic", "quartic")
FAST, SLOW = 3, 1  # read-out speeds of the EM amplifier: high and low read noise
_FILL, _SHARES, _EXPOSURE_DRAWS = 0.8, tuple(np.geomspace(0.1, 1, 8).tolist()), 4  # exposures for the nonlinearity


def warp_estimator(
    bench: Bench,
    reference: Image,
    warp: Warp | None,
    *,
    reconstruction: ReconstructionSettings | None = None,
    noise: CameraNoise | None = None,
) -> Estimator:
    """Prepare one warp for a reference (row, column) above the dark, in the unit of the frames."""
    return Estimator(calibration_of(bench, reference, warp, reconstruction, noise))


def warp_estimators(
    bench: Bench, reference: Image, warps: tuple[Warp, ...] = WARPS, noise: CameraNoise | None = None
) -> dict[Warp, Estimator]:
    """Prepare several warps for a reference (row, column), see `warp_estimator`."""
    return {warp: warp_estimator(bench, reference, warp, noise=noise) for warp in warps}


def compare(
    estimators: Mapping[Warp, Estimator],
    frame: Image,
    truth: Floats,
    *,
    at: float | str,
    prefix: str = "",
    views: Booleans | None = None,
    refined: tuple[Warp, ...] = REFINED,
) -> Iterator[Row]:
    """Compare the wavefronts of a frame (row, column) with the truth, see `residual`.

    Each warp has one pass; those in `refined` have another with the layers found, and then their refinement.
    """
    for warp, estimator in estimators.items():
        curve = prefix + warp
        try:
            reconstructor = estimator.reconstructor  # may refuse
            displacement = reconstructor.register(frame)
            yield residual(reconstructor.solve(displacement), truth, curve=curve, at=at, views=views)
            if warp in refined:
                sample = reconstructor.find_sample(displacement)
                wavefront = reconstructor.solve(displacement, sample=sample)
                yield residual(wavefront, truth, curve=f"{curve} layers", at=at, views=views)
                curve += " refined"
                wavefront, _ = estimator.solve(displacement, sample=sample, rounds=ROUNDS)
                yield residual(wavefront, truth, curve=curve, at=at, views=views)
        except ReconstructionError:
            yield without_wavefront(estimator, curve=curve, at=at)


def without_wavefront(estimator: Estimator, *, curve: str, at: float | str) -> Row:
    """Return the row of a frame that has no wavefront: all lenslets are lost."""
    sensor = estimator.calibration.bench.sensor
    return {"curve": curve, "at": at, "rms_rad": math.nan, "lost": math.prod(sensor.lenslets)}


def residual(
    wavefront: Wavefront,
    truth: Floats,
    *,
    curve: str,
    at: float | str,
    views: Booleans | None = None,
    lenslets: Booleans | None = None,
) -> Row:
    """Compare with the truth, rad, (view_row, view_column, lenslet_row, lenslet_column).

    Without `views` (view_row, view_column) all of them count, without `lenslets` the valid ones.
    """
    lenslets = wavefront.displacement.valid if lenslets is None else lenslets
    error = np.where(lenslets, wavefront.views - truth, np.nan)
    return row(wavefront, mean_rms(error if views is None else error[views]), curve=curve, at=at)


def row(wavefront: Wavefront, rms_rad: float, *, curve: str, at: float | str, **more: Any) -> Row:
    """Return an RMS with the counts of lost lenslets of a wavefront."""
    outcome = wavefront.displacement.outcome
    lost, left_cell = np.sum(outcome != LensletStatus.CONVERGED), np.sum(outcome == LensletStatus.LEFT_CELL)
    return {"curve": curve, "at": at, "rms_rad": rms_rad, "lost": lost, "left_cell": left_cell, **more}


@dataclass(frozen=True, slots=True)
class EmCamera:
    """The bench's EMCCD in one setting."""

    settings: SimulatedCameraSettings

    @property
    def noise(self) -> CameraNoise:
        """Noise of its pixels; the register turns one electron into G on average, with variance G (G - 1)."""
        settings = self.settings
        read_e = settings.em_read_noise_e[settings.readout_speed - 1]
        rounding_e = settings.electrons_per_count / math.sqrt(12)
        return CameraNoise(
            counts_per_electron=settings.em_gain / settings.electrons_per_count,
            read_noise_counts=math.hypot(read_e, rounding_e) / settings.electrons_per_count,
            excess_noise=2 - 1 / settings.em_gain,
        )

    def counts(self, electrons: Image) -> Image:
        """Mean counts above the offset from electrons (row, column) before the register."""
        signal = electrons * np.float32(self.settings.em_gain)
        signal -= np.float32(self.settings.loss_per_e) * signal**2
        return np.asarray(signal / np.float32(self.settings.electrons_per_count))

    def exposed(self, electrons: Image, seed: int, index: int) -> Image:
        """Counts above the offset of one noisy frame of an image (row, column), electrons."""
        settings = self.settings
        photons = electrons / np.float32(settings.quantum_efficiency)
        counts = Detector(settings, seed=seed).counts(photons, exposure_of(settings, index))
        return np.asarray(counts - np.float32(settings.offset_counts), np.float32)

    def linearity(self, electrons: Image, seed: int) -> Linearity:
        """Nonlinearity as `svwfs calibrate --linearity` finds it in exposures of an image (row, column), electrons."""
        settings, index = self.settings, count()
        full_scale = 2**settings.bits - 1 - settings.offset_counts
        longest = electrons * np.float32(_FILL * full_scale / self.counts(electrons).max())

        def averaged(share: float) -> tuple[Image, Image]:
            draws = [self.exposed(longest * np.float32(share), seed, next(index)) for _ in range(_EXPOSURE_DRAWS)]
            return np.mean(draws, axis=0), np.var(draws, axis=0, ddof=1) / _EXPOSURE_DRAWS

        exposures = Exposures(averaged(1.0)[0], full_scale)
        for share in (*_SHARES, *_SHARES[::-1]) * 2:
            exposures.add(*averaged(share), share)
        return exposures.fit(amplifier="", em_gain=1.0).linearity

    def reconstructor(self, bench: Bench, electrons: Image, warp: Warp | None = None, **more: Any) -> Reconstructor:
        """Prepare the reconstruction against a noise-free reference of electrons (row, column)."""
        return warp_estimator(bench, self.counts(electrons), warp, noise=self.noise, **more).reconstructor


def camera(bench: Bench, speed: int = SLOW, em_gain: float = 1.0) -> EmCamera:
    """Return the bench's camera with another read-out speed and gain; its exposure is allowed at every speed."""
    return EmCamera(replace(bench.camera_model, amplifier="em", readout_speed=speed, em_gain=em_gain, exposure_s=1.0))


class Scatter(NamedTuple):
    """Means over the views of the RMS over the lenslets."""

    rms_rad: float  # standard deviation over the draws
    error_bar_rad: float  # as the estimator predicts it
    coverage: float  # share of the lenslets and draws within one error bar of the expected wavefront


def scatter_of(wavefronts: Iterable[Wavefront], expected: Floats, views: Booleans | None = None) -> Scatter:
    """Scatter of the wavefronts of several draws of noise, at least two.

    `expected` (view_row, view_column, lenslet_row, lenslet_column), rad.
    """
    errors, sigmas = [], []
    for wavefront in wavefronts:
        valid = wavefront.displacement.valid
        errors.append(without_piston(np.where(valid, wavefront.views - expected, np.nan)))
        sigmas.append(np.where(valid, wavefront.sigma(), np.nan))
    error, sigma = np.array(errors), np.array(sigmas)
    if views is not None:
        error, sigma = error[:, views], sigma[:, views]
    known = np.isfinite(error)
    draws, error_or_0 = np.count_nonzero(known, axis=0), np.where(known, error, 0.0)
    with np.errstate(invalid="ignore"):  # lenslets lost in every draw
        mean = error_or_0.sum(axis=0) / draws
        variance = np.sum(np.where(known, error - mean, 0.0) ** 2, axis=0) / (draws - 1)
    covered = float(np.mean((np.abs(error) < sigma)[known]))
    return Scatter(mean_deviation_rad(np.sqrt(variance)), mean_deviation_rad(sigma), covered)
