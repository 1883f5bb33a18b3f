"""Point-spread function and modulation transfer of wavefronts.

The pupil's transmission exp(i phase) is sampled 6 x 6 times in each lenslet, which follows up to 6 pi rad per lenslet.
A bicubic spline interpolates the phase between the lenslet centres; beyond the outermost known ones it continues with
the smallest third differences. Only known lenslets transmit light. The rows of a hexagonal lattice are aligned first.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy  # which loads its parts when they are used
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from reconstruction.arrays import Booleans, Floats
from reconstruction.geometry import Arrangement, Sensor, centered_steps, lenslet_centers

SAMPLES = 6  # along each side of a lenslet
_FARTHEST_PERCENT = 99.0  # percentile of the slopes within the reach
DIFFRACTION = 4.0  # margin of the reach, in wavelengths over the pupil's width
_STEPS = 4  # per wavelength over the pupil's width, so that speckle looks smooth
_MOST_STEPS = 100  # from the middle to the edge


@dataclass(frozen=True, slots=True, eq=False)
class Mtf:
    """Modulation transfer of wavefronts along x and y; 1 at frequency 0."""

    frequency_x_per_rad: Floats  # cycles per radian of object angle, (frequency_x,), up to pupil width / wavelength
    frequency_y_per_rad: Floats  # (frequency_y,)
    along_x: Floats  # (..., frequency_x); NaN where nothing is known of the wavefront
    along_y: Floats  # (..., frequency_y)
    limit_x: Floats  # diffraction limit: the same pupil without aberration, (..., frequency_x)
    limit_y: Floats  # (..., frequency_y)


def psf(phase: Floats, sensor: Sensor, *, angle_rad: Floats) -> Floats:
    """Point-spread function of wavefronts, relative to the peak without aberration.

    The value at angle 0 is the Strehl ratio, tilt included. A positive slope moves the light towards +x by slope / k.
    The transform, evaluated at the given angles, repeats after 6 wavelengths over the lenslet pitch.

    Parameters
    ----------
    phase : (..., lenslet_row, lenslet_column)
        rad; NaN where unknown.
    sensor : Sensor
    angle_rad : (angle,)
        Angles along x and along y.

    Returns
    -------
    (..., angle_row, angle_column)
        NaN if nothing is known of a wavefront.
    """
    field = _transmission(aligned(phase, sensor.arrangement))
    rows, columns = phase.shape[-2:]
    to_row, to_column = (
        np.exp(-1j * sensor.wavenumber_rad_per_m * angle_rad[:, None] * at_m).astype(np.complex64)
        for at_m in (_positions_m(rows, sensor.row_spacing_m), _positions_m(columns, sensor.lenslet_pitch_m))
    )
    light = np.abs(to_row @ field @ to_column.T) ** 2
    area = np.abs(field).sum(axis=(-2, -1), dtype=np.float64)[..., None, None]
    return _over_whole(light, area**2)


def mtf(phase: Floats, sensor: Sensor) -> Mtf:
    """Modulation transfer of wavefronts, and its diffraction limit: the pupil's autocorrelation.

    Frequency s / wavelength corresponds to pupil points a distance s apart. Tilt has no effect. The phase is
    (..., lenslet_row, lenslet_column), rad, NaN where unknown.
    """
    field = _transmission(aligned(phase, sensor.arrangement))
    rows, columns = phase.shape[-2:]
    return Mtf(
        frequency_x_per_rad=_frequencies(columns, sensor.lenslet_pitch_m, sensor),
        frequency_y_per_rad=_frequencies(rows, sensor.row_spacing_m, sensor),
        along_x=_overlap(field),
        along_y=_overlap(np.swapaxes(field, -2, -1)),
        limit_x=_overlap(np.abs(field)),
        limit_y=_overlap(np.swapaxes(np.abs(field), -2, -1)),
    )


def psf_reach_rad(phase: Floats, sensor: Sensor) -> float:
    """Angle, rad, within which nearly all light of wavefronts (..., lenslet_row, lenslet_column), rad, arrives.

    From the slopes between neighbouring lenslets, plus diffraction. NaN if no two neighbours are known.
    """
    views = aligned(phase, sensor.arrangement).reshape(-1, *phase.shape[-2:])
    along_x, along_y = np.diff(views) / sensor.lenslet_pitch_m, np.diff(views, axis=1) / sensor.row_spacing_m
    slopes = np.abs(np.concatenate([each.reshape(len(views), -1) for each in (along_x, along_y)], axis=1))
    known = [slope[np.isfinite(slope)] for slope in slopes if np.isfinite(slope).any()]
    if not known:
        return float("nan")
    steepest = max(float(np.percentile(slope, _FARTHEST_PERCENT)) for slope in known)
    return steepest / sensor.wavenumber_rad_per_m + DIFFRACTION * diffraction_rad(sensor)


def psf_angles_rad(sensor: Sensor, reach_rad: float) -> Floats:
    """Angles (angle,) from -reach to +reach that resolve the detail of a point-spread function."""
    steps = min(max(math.ceil(_STEPS * reach_rad / diffraction_rad(sensor)), 1), _MOST_STEPS)
    return np.arange(-steps, steps + 1) / steps * reach_rad  # with an exact zero


def diffraction_rad(sensor: Sensor) -> float:
    """Diffraction limit: wavelength over the larger width of the pupil."""
    return sensor.wavelength_m / (2 * max(sensor.pupil_half_width_m))


def _transmission(phase: Floats) -> NDArray[np.complex64]:
    """exp(i phase) at the samples, (..., sample_row, sample_column), 0 where unknown, to 1e-6 in single precision."""
    rows, columns = phase.shape[-2:]
    fine = _to_samples(rows) @ extrapolate(phase) @ _to_samples(columns).T
    transmits = np.repeat(np.repeat(np.isfinite(phase), SAMPLES, axis=-2), SAMPLES, axis=-1)
    angle = np.where(transmits, np.remainder(fine, 2 * np.pi), 0).astype(np.float32)
    field = np.zeros(angle.shape, np.complex64)  # cosine and sine: several times as fast as a complex exponential
    np.cos(angle, out=field.real, where=transmits)
    np.sin(angle, out=field.imag, where=transmits)
    return field


@lru_cache(maxsize=8)
def _to_samples(lenslets: int) -> Floats:
    """Cubic spline interpolation from lenslets and one more on either side to samples: (sample, lenslet + 2).

    Its third derivative is continuous at the second and the last but one.
    """
    points = centered_steps(lenslets + 2)
    spline = scipy.interpolate.make_interp_spline(points, np.eye(points.size))
    return np.asarray(spline(centered_steps(lenslets * SAMPLES) / SAMPLES))


def _positions_m(lenslets: int, spacing_m: float) -> Floats:
    """Positions of the samples along one axis of the pupil, (sample,)."""
    return centered_steps(lenslets * SAMPLES) / SAMPLES * spacing_m


def _frequencies(lenslets: int, spacing_m: float, sensor: Sensor) -> Floats:
    """Frequencies at which samples along one axis interfere, cycles/rad, (frequency,)."""
    return np.arange(lenslets * SAMPLES + 1) / SAMPLES * spacing_m / sensor.wavelength_m


def _overlap(field: NDArray[np.complex64] | NDArray[np.float32]) -> Floats:
    """Magnitude of the normalised autocorrelation of a field (..., row, column) along its rows: (..., shift)."""
    samples = field.shape[-1]
    spectrum = (np.abs(np.fft.fft(field, 2 * samples, axis=-1)) ** 2).sum(axis=-2, dtype=np.float64)
    correlation = np.abs(np.fft.ifft(spectrum, axis=-1))[..., : samples + 1]
    return _over_whole(correlation, correlation[..., :1])


def _over_whole(values: NDArray[np.floating], whole: Floats) -> Floats:
    with np.errstate(invalid="ignore"):  # NaN where there is no pupil
        return np.asarray(values / whole, np.float64)


_THIRD = ((1.0, "xxx"), (3.0, "xxy"), (3.0, "xyy"), (1.0, "yyy"))  # weight and directions of the third differences
_STIFFNESS = 1e-7  # of first differences, which decide where too few lenslets are known for a curvature


def extrapolate(phase: Floats) -> Floats:
    """Extrapolate wavefronts (..., lenslet_row, lenslet_column), rad, by one lenslet on every side.

    Known values stay; the others minimise third differences, so that second-degree polynomials continue exactly. A
    wavefront without any known value becomes zero.
    """
    padded = np.pad(phase, [(0, 0)] * (phase.ndim - 2) + [(1, 1), (1, 1)], constant_values=np.nan)
    flat = padded.reshape(-1, *padded.shape[-2:])
    for wavefront in flat:
        known = np.isfinite(wavefront)
        if known.any():
            factors, coupling = _equations(known.tobytes(), *wavefront.shape)
            wavefront[~known] = factors.solve(-(coupling @ wavefront[known]))
        else:
            wavefront[:] = 0
    return flat.reshape(padded.shape)


@lru_cache(maxsize=16)
def _equations(known_bytes: bytes, rows: int, columns: int) -> tuple[SuperLU, sparse.csr_array]:
    """Least squares of all differences: factors (unknown, unknown) and coupling (unknown, known)."""
    known: Booleans = np.frombuffer(known_bytes, np.bool_)
    energy = sum(
        (weight * _energy(directions, rows, columns) for weight, directions in _THIRD),
        start=_STIFFNESS * (_energy("x", rows, columns) + _energy("y", rows, columns)),
    )
    of_unknown = sparse.csr_array(energy)[np.flatnonzero(~known)]
    return splu(of_unknown[:, np.flatnonzero(~known)].tocsc()), of_unknown[:, np.flatnonzero(known)].tocsr()


def _energy(directions: str, rows: int, columns: int) -> sparse.csr_array:
    """Sum of the squares of all differences along `directions`, as a quadratic form: (lenslet, lenslet)."""
    along_y = _differences(rows, directions.count("y"))
    along_x = _differences(columns, directions.count("x"))
    differences = sparse.kron(along_y, along_x, format="csr")
    return sparse.csr_array(differences.T @ differences)


def _differences(count: int, order: int) -> sparse.csr_array:
    """Matrix of the differences of that order between `count` neighbours: (count - order, count)."""
    return sparse.csr_array(np.diff(np.eye(count), order, axis=0))


_CUBIC = 3


def aligned(phase: Floats, arrangement: Arrangement) -> Floats:
    """Straighten the columns of wavefronts (..., lenslet_row, lenslet_column), rad.

    Each row moves by a quarter of a pitch. A cubic spline interpolates along each row. Lenslets stay unknown (NaN); a
    square lattice is returned as it is.
    """
    if arrangement == "square":
        return phase
    known = np.isfinite(phase)
    some = known.reshape(-1, *phase.shape[-2:]).any(axis=0)
    matrices = _alignment(some.tobytes(), *some.shape, arrangement)
    found = np.einsum("rij,...rj->...ri", matrices, np.where(known, phase, 0.0))
    return np.where(known, found, np.nan)


@lru_cache(maxsize=16)
def _alignment(known_bytes: bytes, rows: int, columns: int, arrangement: Arrangement) -> Floats:
    """Interpolation of each row from its known lenslets, (lenslet_row, column, lenslet_column)."""
    known = np.frombuffer(known_bytes, np.bool_).reshape(rows, columns)
    x = lenslet_centers(arrangement, rows, columns)[..., 0]
    matrices, unit = np.zeros((rows, columns, columns)), np.eye(columns)
    for row, is_known in enumerate(known):
        count = int(np.count_nonzero(is_known))
        if count:
            spline = scipy.interpolate.make_interp_spline(x[row, is_known], unit[is_known], k=min(count - 1, _CUBIC))
            matrices[row] = spline(x[:2].mean(axis=0))
    return matrices
