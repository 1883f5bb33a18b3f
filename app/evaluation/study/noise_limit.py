"""Scatter of noisy wavefronts, their error bars, and the Cramer-Rao bound on both."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from app.bench.config import Bench
from app.bench.imaging_model import lenslet_image
from app.evaluation.study.estimators import Views
from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.pipeline import NOISE_MODES, Reconstructor
from reconstruction.quality.information import layered_information, wavefront_bound
from reconstruction.registration.response import mean_subimage
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import Wavefront, without_piston
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import source_points


@dataclass(frozen=True, slots=True)
class Scatter:
    """Means over the views of the RMS over the lenslets."""

    rms_rad: float  # standard deviation over the draws
    error_bar_rad: float  # as the estimator predicts it
    coverage: float  # share of the lenslets and draws within one error bar of the expected wavefront


def without_prior(bench: Bench) -> ReconstructionSettings:
    """Modal reconstruction with 45 modes, or all that the lattice carries.

    It is unbiased, as the bound requires.
    """
    all_modes = len(pupil_modes(bench.sensor, "legendre", None).degree)
    return ReconstructionSettings(pupil_modes=min(NOISE_MODES, all_modes))


def scatter_of(wavefronts: Iterable[Wavefront], expected: Floats, views: Views = None) -> Scatter:
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
    return Scatter(_mean_rms(np.sqrt(variance)), _mean_rms(sigma), covered)


def error_bar_rad(wavefront: Wavefront, views: Views = None) -> float:
    """Error bar of a wavefront: mean over the views of the RMS over the lenslets."""
    sigma = np.where(wavefront.displacement.valid, wavefront.sigma(), np.nan)
    return _mean_rms(sigma if views is None else sigma[views])


def bound_rad(
    bench: Bench,
    reconstructor: Reconstructor,
    *,
    field_modes: int,
    views: Views = None,
    exposure: float = 1.0,
    brightness_terms: int = 1,
) -> float:
    """Cramer-Rao bound of `Scatter.rms_rad` for the modes of `without_prior`, from the exact model of the bench.

    The light is that of the reference in `exposure` times its own, the noise that of a frame. The brightness of each
    subimage is unknown in that many polynomials over the field. NaN if the mask shows nothing of some wavefronts.
    """
    if reconstructor.noise is None:
        raise ValueError("without the noise of a frame there is no bound")
    subimages, modes = reconstructor.subimages, pupil_modes(bench.sensor, "legendre", without_prior(bench).pupil_modes)
    model, legendre = true_lenslet(bench, subimages.width), LegendreModes(field_modes)
    _, light = mean_subimage(subimages)
    light = exposure * light / model.image().sum()
    brightness, noise = LegendreModes(brightness_terms), reconstructor.noise
    try:
        found = layered_information(
            model, light, noise, sensor=bench.sensor, modes=modes, field_modes=legendre, brightness=brightness
        )
        bound = wavefront_bound(*found, bench.field, modes, legendre)
    except ReconstructionError:
        return math.nan
    return _mean_rms(bound if views is None else bound[views])


def true_lenslet(bench: Bench, width: int) -> LensletImage:
    """Exact model of one lenslet of the simulated bench, on `width` x `width` pixels."""
    simulation, source = bench.simulation, bench.simulation.source
    points = source_points(source.mask, source, object_samples=simulation.object_samples)
    return lenslet_image(bench, points, width, simulation.pupil_samples)


def _mean_rms(deviation: Floats) -> float:
    """Mean of the RMS over the lenslets, (..., lenslet_row, lenslet_column), ignoring NaN."""
    return float(np.mean(np.sqrt(np.nanmean(deviation**2, axis=(-2, -1)))))
