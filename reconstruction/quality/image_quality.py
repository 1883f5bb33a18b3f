"""What a wavefront does to an image: point-spread function and modulation transfer.

Both begin with the pupil's transmission exp(i phase) on a grid of 6 x 6 samples in each lenslet. Known is the phase at
the lenslet centres only; a bicubic spline runs through them, and on into the outer half of the lenslets at the edge and
beside lost ones, where the phase goes on with the least third differences (so that a plane or a defocus goes on as
such). Only the area of known lenslets transmits light. Six samples follow a phase that rises by up to 6 pi, 18 rad,
over one lenslet, more than a displacement within a subimage's own cell makes on the benches of this house.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor, centered_steps
from reconstruction.quality.extrapolation import extrapolate

_SAMPLES = 6  # along each side of a lenslet
_FARTHEST_PERCENT = 99.0  # of each wavefront's area sends its light within the reach
_DIFFRACTION = 4.0  # wavelengths over the pupil's width, by which the reach is wider than geometry says
_STEPS = 4  # in a wavelength over the pupil's width, so that speckle looks smooth
_MOST_STEPS = 100  # from the middle to the edge; beyond, speckle is only sampled

Transmission = NDArray[np.complex64]  # single precision: 1e-6 of the peak is below anything that is looked at


@dataclass(frozen=True, slots=True, eq=False)
class Mtf:
    """Modulation transfer of wavefronts along x and along y; 1 at frequency 0."""

    frequency_x_per_rad: Floats  # cycles per radian of object angle, (frequency_x,), up to pupil width / wavelength
    frequency_y_per_rad: Floats  # (frequency_y,)
    along_x: Floats  # (..., frequency_x); NaN where nothing is known of the wavefront
    along_y: Floats  # (..., frequency_y)
    limit_x: Floats  # diffraction limit: the same pupil without aberration, (..., frequency_x)
    limit_y: Floats  # (..., frequency_y)


def psf(phase: Floats, sensor: Sensor, *, angle_rad: Floats) -> Floats:
    """Point-spread function of wavefronts (..., lenslet_row, lenslet_column), rad, where light arrives at these angles.

    `angle_rad` (angle,) are the angles along x and along y: the result is (..., angle_row, angle_column). It is 1 at
    the peak of the same pupil without aberration, so at angle 0 it is the Strehl ratio, tilt included. A positive slope
    moves the light towards +x, as on the sensor: by slope / k. NaN where nothing is known of a wavefront.

    The transmission is Fourier transformed at these angles themselves (two matrix products), not on the grid of a
    padded FFT. It repeats after 6 wavelengths over the lenslet pitch, so ask for less than +-3 of them.
    """
    field = _transmission(phase)
    to_row, to_column = (
        np.exp(-1j * sensor.wavenumber_rad_per_m * angle_rad[:, None] * at_m).astype(np.complex64)
        for at_m in (_positions_m(phase.shape[-2], sensor), _positions_m(phase.shape[-1], sensor))
    )
    light = np.abs(to_row @ field @ to_column.T) ** 2
    area = np.abs(field).sum(axis=(-2, -1), dtype=np.float64)[..., None, None]
    return _where_known(light, area**2)


def mtf(phase: Floats, sensor: Sensor) -> Mtf:
    """Modulation transfer of wavefronts (..., lenslet_row, lenslet_column), rad, and its diffraction limit.

    It is the pupil's autocorrelation: at the frequency s / wavelength two points of the pupil a distance s apart
    interfere. So the frequencies are those of whole samples, and tilt makes no difference.
    """
    field = _transmission(phase)
    return Mtf(
        frequency_x_per_rad=_frequencies(phase.shape[-1], sensor),
        frequency_y_per_rad=_frequencies(phase.shape[-2], sensor),
        along_x=_overlap(field),
        along_y=_overlap(np.swapaxes(field, -2, -1)),
        limit_x=_overlap(np.abs(field)),
        limit_y=_overlap(np.swapaxes(np.abs(field), -2, -1)),
    )


def psf_reach_rad(phase: Floats, sensor: Sensor) -> float:
    """How far from angle 0 nearly all light of all wavefronts (..., lenslet_row, lenslet_column) arrives along x or y.

    Geometry says: as far as the slopes between neighbouring lenslets send it; diffraction widens that. NaN where no two
    neighbours are known.
    """
    views = phase.reshape(-1, *phase.shape[-2:])
    rises = [np.abs(np.concatenate([np.diff(view).ravel(), np.diff(view, axis=0).ravel()])) for view in views]
    known = [rise[np.isfinite(rise)] for rise in rises if np.isfinite(rise).any()]
    if not known:
        return float("nan")
    steepest_rad = max(float(np.percentile(rise, _FARTHEST_PERCENT)) for rise in known)
    geometry_rad = steepest_rad / sensor.lenslet_pitch_m / sensor.wavenumber_rad_per_m
    return geometry_rad + _DIFFRACTION * diffraction_rad(sensor)


def psf_angles_rad(sensor: Sensor, reach_rad: float) -> Floats:
    """Angles from -reach to +reach, 0 in the middle, at which a point-spread function shows its detail: (angle,)."""
    steps = min(max(math.ceil(_STEPS * reach_rad / diffraction_rad(sensor)), 1), _MOST_STEPS)
    return np.linspace(-reach_rad, reach_rad, 2 * steps + 1, dtype=np.float64)


def diffraction_rad(sensor: Sensor) -> float:
    """Wavelength over the pupil's width, the wider one: how fine the finest detail of a point-spread function is."""
    return sensor.wavelength_m / (2 * max(sensor.pupil_half_width_m))


def _transmission(phase: Floats) -> Transmission:
    """The pupil exp(i phase) on the fine grid, (..., sample_row, sample_column); zero where the phase is unknown."""
    rows, columns = phase.shape[-2:]
    fine = _to_samples(rows) @ extrapolate(phase) @ _to_samples(columns).T
    transmits = np.repeat(np.repeat(np.isfinite(phase), _SAMPLES, axis=-2), _SAMPLES, axis=-1)
    angle = np.where(transmits, np.remainder(fine, 2 * np.pi), 0).astype(np.float32)
    return np.asarray(np.where(transmits, np.exp(1j * angle), 0), np.complex64)


@lru_cache(maxsize=8)
def _to_samples(lenslets: int) -> Floats:
    """Spline interpolation from lenslet centres, and one more on either side, to the samples: (sample, lenslet + 2)."""
    centers = centered_steps(lenslets + 2)
    at = centered_steps(lenslets * _SAMPLES) / _SAMPLES
    return np.asarray(make_interp_spline(centers, np.eye(lenslets + 2), k=3)(at))


def _positions_m(lenslets: int, sensor: Sensor) -> Floats:
    """Pupil position of the samples along one axis, (sample,)."""
    return centered_steps(lenslets * _SAMPLES) / _SAMPLES * sensor.lenslet_pitch_m


def _frequencies(lenslets: int, sensor: Sensor) -> Floats:
    """Frequencies at which two samples along one axis interfere, cycles/rad, (frequency,)."""
    return np.arange(lenslets * _SAMPLES + 1) / _SAMPLES * sensor.lenslet_pitch_m / sensor.wavelength_m


def _overlap(field: NDArray[np.complex64] | NDArray[np.float32]) -> Floats:
    """Autocorrelation along the last axis over that without a shift, magnitude: (..., shift), from 0 to all samples."""
    samples = field.shape[-1]
    spectrum = (np.abs(np.fft.fft(field, 2 * samples, axis=-1)) ** 2).sum(axis=-2, dtype=np.float64)
    correlation = np.abs(np.fft.ifft(spectrum, axis=-1))[..., : samples + 1]
    return _where_known(correlation, correlation[..., :1])


def _where_known(values: NDArray[np.floating], whole: Floats) -> Floats:
    """Values over those of the whole pupil; NaN where there is no pupil."""
    with np.errstate(invalid="ignore"):
        return np.asarray(values / whole, np.float64)
