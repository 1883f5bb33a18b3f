"""Scatter of an estimator over draws of camera noise, its error bars, and the Cramer-Rao bound."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from reconstruction.arrays import Floats
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.pipeline import Reconstructor
from reconstruction.quality.information import layered_information, wavefront_bound
from reconstruction.registration.response import mean_subimage
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import Wavefront, without_piston
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import source_points

_MODES = 45  # pupil modes for which noise is studied; a smooth wavefront needs about as many

Views = NDArray[np.bool_] | None  # the views that count, (view_row, view_column); None: all of them


@dataclass(frozen=True, slots=True)
class Scatter:
    """Means over the views of the RMS over the lenslets."""

    rms_rad: float  # standard deviation over the draws
    error_bar_rad: float  # as the estimator predicts it
    coverage: float  # share of the lenslets and draws within one error bar of the expected wavefront


def without_prior(bench: Bench) -> ReconstructionSettings:
    """Modal reconstruction with 45 modes, or all that the lattice carries: unbiased, as the bound requires."""
    all_modes = len(pupil_modes(bench.sensor, "legendre", None).degree)
    return ReconstructionSettings(pupil_modes=min(_MODES, all_modes))


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


def bound_rad(bench: Bench, mask: str, reconstructor: Reconstructor, field_modes: int, views: Views = None) -> float:
    """Cramer-Rao bound of `Scatter.rms_rad` for the modes of `without_prior`, from the exact model of the bench.

    The light is that of the reference, the noise that of a frame.
    """
    if reconstructor.noise is None:
        raise ValueError("without the noise of a frame there is no bound")
    subimages, modes = reconstructor.subimages, pupil_modes(bench.sensor, "legendre", without_prior(bench).pupil_modes)
    model, legendre = true_lenslet(bench, mask, subimages.width), LegendreModes(field_modes)
    _, light = mean_subimage(subimages)
    found = layered_information(
        model, light / model.image().sum(), reconstructor.noise, sensor=bench.sensor, modes=modes, field_modes=legendre
    )
    bound = wavefront_bound(*found, bench.field, modes, legendre)
    return _mean_rms(bound if views is None else bound[views])


def true_lenslet(bench: Bench, mask: str, width: int) -> LensletImage:
    """Exact model of one lenslet with a mask of the simulated bench, on `width` x `width` pixels."""
    simulation = bench.simulation
    return LensletImage(
        bench.sensor,
        bench.field,
        source_points(mask, simulation.source, object_samples=simulation.object_samples),
        width=width,
        pupil_samples=simulation.pupil_samples,
        pixel_fill_factor=bench.camera_model.pixel_fill_factor,
    )


def _mean_rms(deviation: Floats) -> float:
    """Mean of the RMS over the lenslets, (..., lenslet_row, lenslet_column), ignoring NaN."""
    return float(np.mean(np.sqrt(np.nanmean(deviation**2, axis=(-2, -1)))))
