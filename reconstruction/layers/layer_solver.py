"""Fit of one or two layers at given distances to the displacements of a frame.

The displacements of all lenslets are linear in the layers' phases, as they are in the wavefront (`solve.modal`). The
normal equations of all wavefronts are formed once per reference; those of layers at any distance follow from them.

The smoothness prior: each coefficient is normally distributed about zero with standard deviation s k^-5, k the degree
of the polynomial over the layer. Strength and noise level maximise the evidence.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field, Sensor
from reconstruction.layers.layer_modes import LayerModes
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.legendre import legendre
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.solve.evidence import log_evidence, maximize_evidence
from reconstruction.solve.expected_errors import ExpectedErrors

_HIGHEST_DEGREE = 13  # of a layer's phase, if there are as many lenslets
_PRIOR_EXPONENT, _PRIOR_PER_FIELD_DEGREE = 5.0, 0.5  # as in `solve.modal`
_UNSEEN = 1e-14  # eigenvalue over the largest, below which it is rounding
_AT_ONCE = 64  # lenslets whose design matrix is in memory at a time
_LEAST_LENSLETS = 9


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Phase of one layer, in coordinates s = u + ratio x."""

    ratio: float  # of field position to pupil position where rays meet the layer
    ratio_sigma: float  # NaN if the ratio was given
    half_width_m: Floats  # of the footprint, (xy,)
    _coefficients: Floats  # rad, (k,)
    _root_covariance: Floats  # rad, (k, n)
    _first: int  # the lowest polynomial of the map: 1, or 3 without tilt

    def phase(self, x_m: Floats, y_m: Floats, *, with_tilt: bool = False) -> Floats:
        """Phase at positions s, broadcast together, rad; NaN outside the footprint.

        It has no tilt if there is another layer, because the tilts of two layers cannot be told apart; `with_tilt` adds
        the share of this layer.
        """
        return self._on(x_m, y_m, self._coefficients[:, None], 1 if with_tilt else self._first)[..., 0]

    def sigma(self, x_m: Floats, y_m: Floats) -> Floats:
        """Standard deviation of `phase`, rad."""
        return np.asarray(np.linalg.norm(self._on(x_m, y_m, self._root_covariance, self._first), axis=-1))

    def _on(self, x_m: Floats, y_m: Floats, coefficients: Floats, first: int) -> Floats:
        x, y = np.broadcast_arrays(x_m / self.half_width_m[0], y_m / self.half_width_m[1])
        outside = np.maximum(np.abs(x), np.abs(y)) > 1 + 1e-9
        modes = legendre(len(coefficients) + 1, np.clip(x, -1, 1), np.clip(y, -1, 1))[first:]
        values = np.tensordot(modes, coefficients[first - 1 :], axes=(0, 0))
        values[outside] = np.nan
        return np.asarray(values)


@dataclass(frozen=True, slots=True, eq=False)
class LayerFit:
    """Layers at given distances, and how well they explain the displacements."""

    layers: tuple[Layer, ...]
    log_evidence: float  # of the displacements, up to a constant common to all fits of a frame
    chi_square: float  # reduced, of the displacements about the fit, in units of their expected errors
    misfit: float  # RMS of the displacements not explained over that of all, both in expected errors

    def wavefront(self, sensor: Sensor, x_m: float, y_m: float) -> Floats:
        """Wavefront of a field position at the lenslet centres, rad, without piston, (lenslet_row, lenslet_column)."""
        u_m, v_m = sensor.pupil_x_m, sensor.pupil_y_m[:, None]
        each = [layer.phase(u_m + layer.ratio * x_m, v_m + layer.ratio * y_m, with_tilt=True) for layer in self.layers]
        total = np.sum(each, axis=0)
        return np.asarray(total - total.mean())


class FrameEquations:
    """Normal equations of one frame; layers at any distance can be fitted to them."""

    def __init__(self, solver: "LayerSolver", gram: Floats, moment: Floats, total: float, count: int) -> None:
        self._solver, self._gram, self._moment = solver, gram, moment
        self._total, self._count = total, count
        self._of_layer = lru_cache(maxsize=64)(self._products)

    def fit(self, *ratios: float) -> LayerFit:
        """Fit layers at some ratios of field to pupil position."""
        solver = self._solver
        scale = np.tile(solver.scale, len(ratios))
        each = [self._of_layer(ratio) for ratio in ratios]
        gram = np.block([[basis.T @ product for _, product, _ in each] for basis, _, _ in each])
        root, found, evidence, chi_square, misfit = self._solve(gram, np.concatenate([moment for *_, moment in each]))
        without = 1 if len(ratios) == 1 else 3  # the tilts of two layers cannot be told apart
        size = len(solver.scale)
        layers = tuple(
            Layer(
                ratio,
                math.nan,
                solver.footprint_m(ratio),
                (scale * found)[first : first + size],
                (scale[:, None] * root)[first : first + size],
                without,
            )
            for ratio, first in zip(ratios, range(0, size * len(ratios), size), strict=True)
        )
        return LayerFit(layers, evidence, chi_square, misfit)

    def any_wavefront(self) -> LayerFit:
        """Fit the wavefront without assuming layers."""
        scale = self._solver.free_scale
        _, _, evidence, chi_square, misfit = self._solve(self._gram * np.outer(scale, scale), self._moment * scale)
        return LayerFit((), evidence, chi_square, misfit)

    def _products(self, ratio: float) -> tuple[Floats, Floats, Floats]:
        """Scaled basis of a layer, and its products with the normal matrix and the moments."""
        basis = self._solver.basis(ratio) * self._solver.scale
        return basis, self._gram @ basis, self._moment @ basis

    def _solve(self, gram: Floats, moment: Floats) -> tuple[Floats, Floats, float, float, float]:
        """Root of the covariance (n, n), found numbers (n,), log evidence, reduced chi-square and misfit."""
        square, vectors = np.linalg.eigh(gram)
        square = np.where(square > _UNSEEN * square[-1], square, 0.0)  # unseen components keep the prior's variance
        seen, singular = square > 0, np.sqrt(square)
        along = np.zeros_like(square)
        along[seen] = (vectors.T @ moment)[seen] / singular[seen]
        relative = square / square[-1]
        ratio, noise = maximize_evidence(relative, along, self._total, self._count)
        evidence = log_evidence(ratio, relative, along, self._total, self._count)
        kept = ratio * relative / (1 + ratio * relative)
        left = self._total - float(np.sum(along**2 * (1 - (1 - kept) ** 2)))
        chi_square = left / max(self._count - float(np.sum(kept)), 1.0)
        variance = noise * ratio / square[-1]  # of the prior
        found = variance / noise / (1 + ratio * relative) * singular * along
        root = vectors * np.sqrt(variance / (1 + ratio * relative))
        return root, vectors @ found, evidence, chi_square, math.sqrt(left / self._total)


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
        share = self._errors.share(displacement, weights)
        if np.count_nonzero(share) < _LEAST_LENSLETS:
            raise ReconstructionError(f"layers need at least {_LEAST_LENSLETS} valid lenslets")
        data = self._errors.whitened(displacement)
        weighted = share[:, None] * data
        moment = np.sum(
            [self._rows(some).T @ weighted[some].ravel() for some in self._chunks(np.flatnonzero(share))], axis=0
        )
        total = float(np.vdot(data, weighted))
        if not total > 0:
            raise ReconstructionError("the displacements are all zero: there is no layer to find")
        return FrameEquations(
            self, self._gram_of(share.tobytes()), moment, total, np.count_nonzero(share) * data.shape[1]
        )

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
