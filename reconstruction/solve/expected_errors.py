"""Expected displacements of one reference's lenslets, and their errors, the unit of the solves.

A lenslet's displacement is written in K parameters, the rows of `parameters` (K, x modes and then y modes).
`Sensitivity` is the displacement caused by the modes of a wavefront: the design matrix of the modal reconstruction.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Floats, median
from reconstruction.displacement import SYSTEMATIC_PX, Displacement
from reconstruction.geometry import Sensor
from reconstruction.modes.polynomials import legendre_slopes
from reconstruction.modes.pupil_modes import PupilModes, aperture_rule, local_wavefronts
from reconstruction.solve.evidence import Estimate

Lenslets: TypeAlias = slice | NDArray[np.intp]
_DEGREE = 4  # of the local wavefronts whose mean gradients stand for a response


class MeanGradients:
    """Mean gradients of a wavefront over each lenslet, the same for all field modes."""

    def __init__(self, sensor: Sensor, parameters: Floats) -> None:
        """`parameters` (K, 2Q) found for a displacement (x modes, y modes)."""
        self._sensor = sensor
        self._along = parameters.reshape(len(parameters), 2, -1) / sensor.slope_per_px  # (K, xy, field_mode)

    @property
    def response(self) -> Floats:
        """Parameters, px, per rad of local wavefronts P_m(xi) P_n(eta) T_q, (1, n, m, field_mode, K)."""
        sensor = self._sensor
        half_m = sensor.aperture_width_m / 2
        position, weights = aperture_rule(sensor.arrangement)
        xi, eta = position.T * sensor.lenslet_pitch_m / half_m
        (p, slope_p), (r, slope_r) = ((series.legvander(at, _DEGREE), legendre_slopes(at, _DEGREE)) for at in (xi, eta))
        along_x, along_y = (np.einsum("a,an,am->nm", weights, *pair) / half_m for pair in ((r, slope_p), (slope_r, p)))
        within = np.add.outer(np.arange(_DEGREE + 1), np.arange(_DEGREE + 1)) <= _DEGREE
        gradient = np.stack([along_x, along_y]) * within  # 1/m, (xy, n, m)
        return np.asarray(np.einsum("anm,kaq->nmqk", gradient, self._along))[None]

    def __call__(self, modes: PupilModes, lenslets: Lenslets) -> Floats:
        """Parameters, px, of some lenslets per rad of each mode but the piston.

        (lenslet, K, pupil_mode - 1, field_mode).
        """
        gradients = modes.gradients[1:].reshape(len(modes.gradients) - 1, -1, 2)[:, lenslets]
        return np.asarray(np.einsum("plx,kxq->lkpq", gradients, self._along, optimize=True))


class Response:
    """Response of the registration to local wavefronts, see `registration.response`."""

    def __init__(self, sensor: Sensor, response: Floats) -> None:
        """`response` is (lenslet, n, m, field_mode, K), px per rad."""
        self._sensor, self._shape = sensor, response.shape
        self._n, self._m = np.nonzero(np.any(response, axis=(0, 3, 4)))
        self._shown = response[:, self._n, self._m]  # a quarter of all: the others are 0

    @property
    def response(self) -> Floats:
        """As given."""
        response = np.zeros(self._shape)
        response[:, self._n, self._m] = self._shown
        return response

    def __call__(self, modes: PupilModes, lenslets: Lenslets) -> Floats:
        """Parameters per rad of each mode; see `MeanGradients`."""
        row, column = np.divmod(np.arange(len(self._shown))[lenslets], self._sensor.lenslets[1])
        rows, place = np.unique(row, return_inverse=True)  # only these: preparing asks for few lenslets at a time
        local = local_wavefronts(modes.products[1:], self._sensor, self._shape[1] - 1, rows)
        local = local[place[:, None], column[:, None], self._n, self._m]  # (lenslet, j, pupil_mode - 1)
        return np.asarray(np.einsum("ljp,ljqk->lkpq", local, self._shown[lenslets], optimize=True))


Sensitivity: TypeAlias = MeanGradients | Response
"""Parameters of the lenslets' warps per rad, of local wavefronts and of pupil modes."""

_ALIKE = 0.1  # share of the systematic error that all parameters have alike, if the noise is unknown
# Lenslets whose systematic errors count as one, if the noise is unknown. So the error bars of single layers without
# noise cover 69 and 66 % of the errors with a checkerboard (l = 1.25, 2 mm), 63 and 74 % with a square; with 1 it was
# 39 to 52 %, with 9 80 to 88. If the noise is known, fewer errors count as systematic: on the benches "none",
# "absorption" and "all" of the study `imperfect_bench`, error bars of any wavefront cover 64, 64 and 72 % of errors,
# those over layers 67, 63 and 63 %; with 4 it was 69, 70 and 77 %, and 60, 55 and 55 %. Samples with depth (two, four
# and six layers that `LayeredLight` propagates, 3,000 and 10,000 e-) have 62 to 73 % with their own share of systematic
# errors, 49 to 62 % with that of one layer.
_ALIKE_IF_UNKNOWN = 4.0
ALIKE_IF_FREE, ALIKE_IN_LAYERS = 3.0, 6.0  # if it is known
_BY_CHANCE = 1.2  # noise found over that expected, below which it may be by chance
_LEAST_NOISE = 1e-6  # variance of the noise over that of the systematic error, below which the noise is unknown


class Whitened(NamedTuple):
    """Displacements of a frame in units of their expected errors."""

    share: Floats  # certainty of each lenslet over the expected one, (L,); 0 where lost
    weighted: Floats  # share times displacements, (L, K)
    total: float  # share times their squares, summed
    number: int  # of displacements


class ExpectedErrors:
    """Whitens displacements: K independent numbers for each of L lenslets, with an expected variance of 1.

    Parameters
    ----------
    sensitivity : Sensitivity
        Parameters of the lenslets' warps per rad.
    parameters : (K, 2Q)
        Displacement (x modes, y modes) of each parameter, orthonormal rows.
    covariance : (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy)
        Expected covariance of a frame's displacements, px^2; NaN where lost, 0 if unknown.
    inside : (lenslet_row, lenslet_column)
        Lenslets to use.
    """

    def __init__(self, sensitivity: Sensitivity, parameters: Floats, covariance: Floats, inside: Booleans) -> None:
        field_modes = parameters.shape[1] // 2
        self._sensitivity = sensitivity
        # From displacements (field_mode, xy).
        self._to_parameters = parameters.reshape(-1, 2, field_modes).transpose(2, 1, 0).reshape(2 * field_modes, -1)
        expected, is_known, self.share_of_noise = _expected_covariance(covariance, self._to_parameters)
        self.is_usable = is_known & inside.ravel()  # (L,)
        self.colour = np.linalg.cholesky(expected)  # from whitened numbers to parameters, px, (L, K, K)
        self._whiten = np.linalg.inv(self.colour)

    def whitened(self, displacement: Displacement, weights: Floats | None = None) -> Whitened:
        """Whiten displacements; `weights` (lenslet_row, lenslet_column) of the lenslets are 1 by default."""
        used = displacement.valid.ravel() & self.is_usable
        share = np.where(used, 1.0 if weights is None else weights.ravel(), 0.0)
        px = displacement.coefficients.reshape(len(used), -1) @ self._to_parameters
        data = np.matvec(self._whiten, np.where(used[:, None], px, 0.0))
        weighted = share[:, None] * data
        return Whitened(share, weighted, float(np.vdot(data, weighted)), np.count_nonzero(share) * data.shape[1])

    def variance(self, estimate: Estimate, singular: Floats, alike: float, *, has_depth: bool = False) -> Floats:
        """Variance of the components of an estimate with those singular values (n,); see `larger`."""
        noise, larger = estimate.noise, self.larger(estimate.noise, alike, has_depth=has_depth)
        if not larger:  # data without any misfit
            return np.zeros_like(singular)
        return np.asarray(larger / (singular**2 + larger / (noise * estimate.ratio)))

    def larger(self, noise: float, alike: float, *, has_depth: bool = False) -> float:
        """Variance of errors that are partly systematic, over the expected one.

        Systematic errors are alike in neighbouring lenslets, so that they average less than noise: those of `alike`
        lenslets count as one. The expected ones are an upper limit, which counts where noise is smaller; if it is
        unknown, all errors count as systematic. Of a sample with depth (`has_depth`) they are larger than of one layer,
        unless they are corrected.
        """
        share = (1 - self.share_of_noise) ** (1 if has_depth else 2)
        systematic = share * min(noise, 1.0) + max(noise - _BY_CHANCE, 0.0)
        return noise + ((alike if self.share_of_noise else _ALIKE_IF_UNKNOWN) - 1) * systematic

    @property
    def response(self) -> Floats:
        """Whitened response to local wavefronts, per rad, (L, K, n, m, field_mode); 0 where unusable."""
        whitened = self._whiten * self.is_usable[:, None, None]
        per_rad = np.moveaxis(self._sensitivity.response, -1, 1)  # (lenslet or 1, K, n, m, field_mode)
        found = np.matmul(whitened, per_rad.reshape(*per_rad.shape[:2], -1))
        return np.asarray(found.reshape(*found.shape[:2], *per_rad.shape[2:]))

    def rows(self, modes: PupilModes, some: Lenslets) -> Floats:
        """Whitened displacements of some lenslets per rad, (lenslet * K, (pupil_mode - 1) * field_mode)."""
        sensitivity = self._sensitivity(modes, some)
        whitened = self._whiten[some] * self.is_usable[some, None, None]
        rows = np.matmul(whitened, sensitivity.reshape(*sensitivity.shape[:2], -1))
        return np.asarray(rows.reshape(-1, rows.shape[2]))


def _expected_covariance(covariance: Floats, to_parameters: Floats) -> tuple[Floats, Booleans, float]:
    """Covariance of parameters, (lenslet, K, K), whether it is known, (lenslet,), and the noise's share.

    It is that of the noise, enlarged by the systematic error; if the noise is unknown, that error alone, shared among
    the parameters as noise would be.
    """
    lenslets, columns = covariance.shape[0] * covariance.shape[1], len(to_parameters)
    covariance = covariance.reshape(lenslets, columns, columns)
    is_known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    of_noise = to_parameters.T @ np.where(is_known[:, None, None], covariance, 0.0) @ to_parameters
    alike = np.eye(of_noise.shape[1])
    variance = np.trace(of_noise, axis1=1, axis2=2) / len(alike)
    usual = float(np.median(variance[is_known])) if is_known.any() else 0.0
    if usual < _LEAST_NOISE * SYSTEMATIC_PX**2:
        seen = is_known & (variance > 0)
        if seen.any():  # as much more uncertain as noise would make them
            shape = np.mean(of_noise[seen] / variance[seen, None, None], axis=0)
            alike = (1 - _ALIKE) * shape + _ALIKE * alike
        return np.broadcast_to(SYSTEMATIC_PX**2 * alike, of_noise.shape), is_known, 0.0
    expected = (1 + SYSTEMATIC_PX**2 / usual) * of_noise + _LEAST_NOISE * usual * alike
    expected[~is_known] = alike
    return expected, is_known, usual / (usual + SYSTEMATIC_PX**2)


def relative_weights(variance: Floats, expected: Floats) -> Floats:
    """Weights (L,) of a frame's lenslets relative to those of the reference: 1, or less for noisier ones.

    `variance` (L,) of the frame's displacements, px^2 (NaN: weight 0), `expected` (L,) of the reference. The weight is
    divided by 4 for each factor of 4 by which the variance, relative to that of most lenslets, exceeds it: in powers of
    4, so that factorisations can be reused from frame to frame.
    """
    ratio = variance / expected
    known = np.isfinite(ratio)
    if not known.any():
        return np.zeros(ratio.shape)
    times = np.rint(np.log2(ratio / median(ratio[known])) / 2)
    return np.where(known, np.exp2(-2 * np.maximum(times, 0)), 0.0)
