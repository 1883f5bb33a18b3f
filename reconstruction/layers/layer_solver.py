"""Fit of one or two layers at given distances to the displacements of a frame.

The displacements of all lenslets are linear in the layers' phases, as they are in the wavefront (`solve.modal`). The
normal equations of all wavefronts are formed once per reference; those of layers at any distance follow from them.
"""

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field, Sensor
from reconstruction.layers.layer_fit import LayerFit, Moments, Spectrum
from reconstruction.layers.layer_modes import LayerModes
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.solve.expected_errors import ExpectedErrors

_HIGHEST_DEGREE = 13  # of a layer's phase, if there are as many lenslets
_PRIOR_EXPONENT, _PRIOR_PER_FIELD_DEGREE = 5.0, 0.5  # as in `solve.modal`
_AT_ONCE = 64  # lenslets whose design matrix is in memory at a time
_LEAST_LENSLETS = 9
# Systematic error: share of the displacement in one parameter of the warp that appears in another one, or is missing in
# itself, alike for all lenslets of a frame. Fitted to the distances in noise-free frames (docs/layers.md).
_SYSTEMATIC_SHARE = 0.002


class FrameEquations:
    """Normal equations of one frame; layers at any distance can be fitted to them."""

    def __init__(self, solver: "LayerSolver", share: Floats, gram: Floats, moments: Moments) -> None:
        self._solver, self._share, self._gram, self._moments = solver, share, gram, moments
        # Not of a method: a cycle would keep up to 200 MB until Python collects its garbage.
        self._of_layer = lru_cache(maxsize=64)(partial(_products, solver, gram, moments.columns))

    def fit(self, *ratios: float) -> LayerFit:
        """Fit layers at some ratios of field to pupil position."""
        solver = self._solver
        each = [self._of_layer(ratio) for ratio in ratios]
        gram = np.block([[basis.T @ product for _, product, _ in each] for basis, _, _ in each])
        moments = replace(self._moments, columns=np.concatenate([columns for *_, columns in each]))
        footprints = tuple((ratio, solver.footprint_m(ratio)) for ratio in ratios)
        return Spectrum(gram).fit(moments, np.tile(solver.scale, len(ratios)), footprints)

    def any_wavefront(self) -> LayerFit:
        """Fit the wavefront without assuming layers."""
        scale = self._solver.free_scale
        moments = replace(self._moments, columns=self._moments.columns * scale)
        return Spectrum(self._gram * np.outer(scale, scale)).fit(moments, scale, ())

    def distance_covariance(self, fit: LayerFit, before: list[LayerFit], after: list[LayerFit], step: float) -> Floats:
        """Covariance of the distances caused by systematic errors of the displacements, (n, n).

        `before` and `after` are the fits with each distance a step shorter and longer; the unit is that of the step.
        """
        explained, *others = self._solver.explained([fit, *before, *after])
        slopes = np.array([far - near for near, far in zip(others[: len(before)], others[len(before) :], strict=True)])
        slopes /= 2 * step
        weighted = slopes * self._share[:, None]
        normal = np.einsum("ilk,jlk->ij", weighted, slopes)
        influence = np.tensordot(np.linalg.pinv(normal, hermitian=True), weighted, axes=1)  # of displacements
        return self._solver.systematic_covariance(explained, influence)


class LayerSolver:
    """Normal equations of one reference, prepared once."""

    def __init__(self, sensor: Sensor, field: Field, field_modes: FieldModes, errors: ExpectedErrors) -> None:
        self.degree = min(sensor.lenslet_rows - 1, sensor.lenslet_columns - 1, _HIGHEST_DEGREE)
        if field_modes.count < 2:
            raise ReconstructionError("the distance of a layer needs displacements that change over the field")
        self._sensor, self._field, self._errors = sensor, field, errors
        self._modes = LayerModes(self.degree, field, field_modes)
        self._pupil_modes = pupil_modes(sensor, "legendre", len(self._modes.orders) + 1)
        self.scale = self._modes.degree**-_PRIOR_EXPONENT  # of a layer's coefficients, (k,)
        columns = np.nonzero(self._modes.columns)
        self.free_scale = self.scale[columns[0]] * _PRIOR_PER_FIELD_DEGREE ** field_modes.degree[columns[1]]
        self._select = np.flatnonzero(self._modes.columns)
        self._all = self._gram(np.arange(len(errors.is_usable)), errors.is_usable.astype(np.float64))
        self._gram_of = lru_cache(maxsize=4)(self._down_dated)
        self.at = lru_cache(maxsize=2)(self._prepared_at)

    def footprint_m(self, ratio: float) -> Floats:
        """Half width (xy,) of the part of a layer that rays meet."""
        return np.asarray(np.array(self._sensor.pupil_half_width_m) + abs(ratio) * self._field.half_width_m)

    def basis(self, ratio: float) -> Floats:
        """Wavefronts of a layer's polynomials, rad, (column, k)."""
        return self._modes(ratio * self._field.half_width_m / np.array(self._sensor.pupil_half_width_m))

    def __call__(self, displacement: Displacement, weights: Floats | None = None) -> FrameEquations:
        """Form the normal equations of a frame's displacements.

        Raises `ReconstructionError` if too few lenslets are valid. `weights` as in `ModalSolver`.
        """
        share, weighted, total = self.data(displacement, weights)
        columns = np.sum(
            [self._rows(some).T @ weighted[some].ravel() for some in self._chunks(np.flatnonzero(share))], axis=0
        )
        moments = Moments(columns, total, np.count_nonzero(share) * weighted.shape[1])
        return FrameEquations(self, share, self._gram_of(share.tobytes()), moments)

    def data(self, displacement: Displacement, weights: Floats | None) -> tuple[Floats, Floats, float]:
        """Share of each lenslet (L,), whitened displacements times share (L, K), and their sum of squares.

        Raises `ReconstructionError` if they show no layer.
        """
        share = self._errors.share(displacement, weights)
        if np.count_nonzero(share) < _LEAST_LENSLETS:
            raise ReconstructionError(f"layers need at least {_LEAST_LENSLETS} valid lenslets")
        data = self._errors.whitened(displacement)
        weighted = share[:, None] * data
        total = float(np.vdot(data, weighted))
        if not total > 0:
            raise ReconstructionError("the displacements are all zero: there is no layer to find")
        return share, weighted, total

    def explained(self, fits: list[LayerFit]) -> Floats:
        """Whitened displacements that fits explain, (fit, L, K)."""
        columns = [
            np.sum([self.basis(layer.ratio) @ layer.coefficients for layer in fit.layers], axis=0) for fit in fits
        ]
        lenslets = np.arange(len(self._errors.is_usable))
        found = np.concatenate([self._rows(some) @ np.transpose(columns) for some in self._chunks(lenslets)])
        return np.asarray(found.T.reshape(len(fits), len(lenslets), -1))

    def systematic_covariance(self, explained: Floats, influence: Floats) -> Floats:
        """Covariance of n numbers caused by systematic errors of the displacements.

        `explained` (L, K): whitened displacements; `influence` (n, L, K): derivatives of the numbers by them.
        """
        per_px = np.linalg.solve(self._errors.colour.transpose(0, 2, 1), influence[..., None])[..., 0]
        per_error = np.einsum("nlk,lj->nkj", per_px, np.matvec(self._errors.colour, explained))
        return np.asarray(_SYSTEMATIC_SHARE**2 * np.einsum("nkj,mkj->nm", per_error, per_error))

    def _prepared_at(self, ratio: float) -> "FixedLayerSolver":
        """Prepare the fit of one layer at a fixed ratio of field to pupil position."""
        basis = self.basis(ratio) * self.scale
        rows = np.concatenate(
            [self._rows(some) @ basis for some in self._chunks(np.arange(len(self._errors.is_usable)))]
        )
        return FixedLayerSolver(self, ratio, basis.T @ (self._all @ basis), rows)

    def _down_dated(self, share_bytes: bytes) -> Floats:
        """Normal matrix of lenslets with that share of their certainty."""
        missing = np.subtract(self._errors.is_usable, np.frombuffer(share_bytes))
        return self._all - self._gram(np.flatnonzero(missing), missing)

    def _gram(self, lenslets: NDArray[np.intp], share: Floats) -> Floats:
        """Sum of products of the rows of some lenslets, each with its share, (column, column)."""
        total = np.zeros((len(self._select), len(self._select)))
        for some in self._chunks(lenslets):
            rows = self._rows(some).reshape(len(some), -1, len(self._select)) * np.sqrt(share[some])[:, None, None]
            rows = rows.reshape(-1, rows.shape[2])
            total += rows.T @ rows
        return total

    def _rows(self, some: NDArray[np.intp]) -> Floats:
        """Whitened displacements of some lenslets per rad of each column, (lenslet * K, column)."""
        return self._errors.rows(self._pupil_modes, some)[:, self._select]

    @staticmethod
    def _chunks(lenslets: NDArray[np.intp]) -> list[NDArray[np.intp]]:
        return [lenslets[first : first + _AT_ONCE] for first in range(0, len(lenslets), _AT_ONCE)]


class FixedLayerSolver:
    """Fit of one layer at a fixed distance, prepared once: a frame takes one matrix-vector product.

    Lost and faint lenslets are taken out of the normal matrix by down-dating, once for each set of them.
    """

    def __init__(self, solver: LayerSolver, ratio: float, gram: Floats, rows: Floats) -> None:
        """`gram` (k, k) is the normal matrix of all lenslets, `rows` (lenslet * K, k) its design matrix."""
        self._solver, self._gram = solver, gram
        self._footprints = ((ratio, solver.footprint_m(ratio)),)
        self._rows = rows
        self._spectrum_of = lru_cache(maxsize=16)(self._down_dated)

    def __call__(self, displacement: Displacement, weights: Floats | None = None) -> LayerFit:
        """Fit a frame's displacements as `LayerSolver` and `FrameEquations.fit` do, with the same errors."""
        share, weighted, total = self._solver.data(displacement, weights)
        moments = Moments(weighted.ravel() @ self._rows, total, np.count_nonzero(share) * weighted.shape[1])
        return self._spectrum_of(share.tobytes()).fit(moments, self._solver.scale, self._footprints)

    def _down_dated(self, share_bytes: bytes) -> Spectrum:
        """Spectrum of lenslets with that share of their certainty."""
        missing = 1 - np.frombuffer(share_bytes)  # rows of unusable lenslets are zero
        lost = np.flatnonzero(missing)
        rows = self._rows.reshape(len(missing), -1, self._rows.shape[1])[lost] * np.sqrt(missing[lost])[:, None, None]
        rows = rows.reshape(-1, rows.shape[2])
        return Spectrum(self._gram - rows.T @ rows)


def _products(solver: LayerSolver, gram: Floats, columns: Floats, ratio: float) -> tuple[Floats, Floats, Floats]:
    """Scaled basis of a layer, and its products with the normal matrix and the moments."""
    basis = solver.basis(ratio) * solver.scale
    return basis, gram @ basis, columns @ basis
