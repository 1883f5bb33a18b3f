"""Fit of one or two layers at given distances to the displacements of a frame.

The displacements of all lenslets are linear in the layers' phases, as they are in the wavefront (`solve.modal`).
"""

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field, Sensor
from reconstruction.layers.layer_design import LayerDesign, layer_orders
from reconstruction.layers.layer_fit import LayerFit, Moments, Spectrum
from reconstruction.modes.field_modes import FieldModes
from reconstruction.runtime.deferred import Remembered
from reconstruction.solve.evidence import FitQuality
from reconstruction.solve.modal import PRIOR_EXPONENT, ModalSolver

# Degree of a layer's phase: the field positions of a lenslet lie between those of its neighbours, so that more than the
# lenslets alone can carry are seen.
_MORE_THAN_LENSLETS, _HIGHEST_DEGREE = 3, 18
SKETCH_DEGREE = 9  # enough to tell distances apart on a coarse grid
_LEAST_LENSLETS = 9
_REMEMBERED_BYTES = 1e8  # of design matrices
# Systematic error: share of the displacement in one parameter of the warp that appears in another one, or is missing in
# itself, alike for all lenslets of a frame. What the mask hides of a displacement shows in the others to second order.
# Fitted to the distances in frames without and with noise (docs/layers.md).
_SYSTEMATIC_SHARE, _SHARE_PER_HIDDEN = 0.0009, 0.00025


def prior_scale(degree: int) -> Floats:
    """Standard deviation of a layer's polynomials up to a degree over the prior's strength, (k,)."""
    return np.asarray(np.sum(layer_orders(degree), axis=1) ** -PRIOR_EXPONENT)


def require_lenslets(lenslets: int) -> None:
    """Raise `ReconstructionError` if there are too few valid lenslets for layers."""
    if lenslets < _LEAST_LENSLETS:
        raise ReconstructionError(f"layers need at least {_LEAST_LENSLETS} valid lenslets")


class LayerSolver:
    """Fits layers to the displacements measured against one reference.

    Parameters
    ----------
    sensor, field
        Geometry of the bench.
    field_modes
        Of the displacements.
    free : ModalSolver
        Fits the same displacements without assuming layers.
    hidden : int
        Number of displacements of a lenslet that the mask does not show.
    """

    def __init__(
        self, sensor: Sensor, field: Field, field_modes: FieldModes, free: ModalSolver, hidden: int = 0
    ) -> None:
        if field_modes.count < 2:
            raise ReconstructionError("the distance of a layer needs displacements that change over the field")
        self.free, self.errors = free, free.errors
        self._systematic_share = _SYSTEMATIC_SHARE + _SHARE_PER_HIDDEN * hidden
        self.degree = min(min(sensor.lenslet_rows, sensor.lenslet_columns) + _MORE_THAN_LENSLETS, _HIGHEST_DEGREE)
        self._design = LayerDesign(sensor, field, field_modes, free.errors)
        self.footprint_m = self._design.footprint_m
        size = free.errors.colour.shape[0] * free.errors.colour.shape[1] * 4
        self._exact = Remembered(self._design.rows, 4)
        sketched = size * len(layer_orders(SKETCH_DEGREE))
        self._sketched = Remembered(self._design.rows, max(2, int(_REMEMBERED_BYTES / sketched)))

    def __call__(self, displacement: Displacement, weights: Floats | None = None) -> "FrameEquations":
        """Prepare the fits of a frame's displacements.

        Raises `ReconstructionError` if too few lenslets are valid. `weights` as in `ModalSolver`.
        """
        return FrameEquations(self, displacement, weights)

    def rows(self, ratio: float, degree: int) -> NDArray[np.float32]:
        """Whitened displacements per rad of a layer's polynomials, (L, K, k)."""
        remembered = self._sketched if degree == SKETCH_DEGREE else self._exact
        return remembered(ratio, degree)

    def systematic_covariance(self, explained: Floats, influence: Floats) -> Floats:
        """Covariance of n numbers caused by systematic errors of the displacements.

        `explained` (L, K): whitened displacements; `influence` (n, L, K): derivatives of the numbers by them.
        """
        colour = self.errors.colour
        per_px = np.linalg.solve(colour.transpose(0, 2, 1), influence[..., None])[..., 0]
        per_error = np.einsum("nlk,lj->nkj", per_px, np.matvec(colour, explained))
        return np.asarray(self._systematic_share**2 * np.einsum("nkj,mkj->nm", per_error, per_error))


class FrameEquations:
    """Displacements of one frame, to which layers at any distance can be fitted."""

    def __init__(self, solver: LayerSolver, displacement: Displacement, weights: Floats | None) -> None:
        self.solver, self._displacement, self._weights = solver, displacement, weights
        self._share = solver.errors.share(displacement, weights)  # (L,)
        lenslets = np.count_nonzero(self._share)
        require_lenslets(int(lenslets))
        data = solver.errors.whitened(displacement)
        self._weighted = self._share[:, None] * data
        self._total, self._count = float(np.vdot(data, self._weighted)), lenslets * data.shape[1]
        if not self._total > 0:
            raise ReconstructionError("the displacements are all zero: there is no layer to find")
        self._products: dict[tuple[float, float, int], Floats] = {}
        self._columns: dict[tuple[float, int], Floats] = {}

    def fit(self, *ratios: float) -> LayerFit:
        """Fit layers at some ratios of field to pupil position."""
        spectrum, moments, scale = self._problem(ratios, self.solver.degree)
        footprints = tuple((ratio, self.solver.footprint_m(ratio)) for ratio in ratios)
        return spectrum.fit(moments, scale, footprints)

    def quality(self, *ratios: float, degree: int) -> FitQuality:
        """Quality of the fit of layers with polynomials up to a degree."""
        spectrum, moments, _ = self._problem(ratios, degree)
        return spectrum.quality(moments)

    def any_wavefront(self) -> FitQuality:
        """Quality of the fit of a wavefront without assuming layers."""
        return self.solver.free.quality(self._displacement, weights=self._weights)

    def distance_covariance(self, fit: LayerFit, before: list[LayerFit], after: list[LayerFit], step: float) -> Floats:
        """Covariance of the distances caused by systematic errors of the displacements, (n, n).

        `before` and `after` are the fits with each distance a step shorter and longer; the unit is that of the step.
        """
        explained = self.explained(fit)
        slopes = np.array([self.explained(far) - self.explained(near) for near, far in zip(before, after, strict=True)])
        slopes /= 2 * step
        weighted = slopes * self._share[:, None]
        normal = np.einsum("ilk,jlk->ij", weighted, slopes)
        influence = np.tensordot(np.linalg.pinv(normal, hermitian=True), weighted, axes=1)  # of displacements
        return self.solver.systematic_covariance(explained, influence)

    def explained(self, fit: LayerFit) -> Floats:
        """Whitened displacements that a fit explains, (L, K)."""
        each = [self.solver.rows(layer.ratio, self.solver.degree) @ layer.coefficients for layer in fit.layers]
        return np.asarray(np.sum(each, axis=0))

    def _problem(self, ratios: tuple[float, ...], degree: int) -> tuple[Spectrum, Moments, Floats]:
        scale = prior_scale(degree)
        for ratio in ratios:
            if (ratio, degree) not in self._columns:
                # In double precision, as the products below: layers close to each other differ little.
                self._columns[ratio, degree] = scale * (self._weighted.ravel() @ self._rows(ratio, degree))
        gram = np.block([[self._product(one, other, degree, scale) for other in ratios] for one in ratios])
        columns = np.concatenate([self._columns[ratio, degree] for ratio in ratios])
        return Spectrum(gram), Moments(columns, self._total, self._count), np.tile(scale, len(ratios))

    def _product(self, one: float, other: float, degree: int, scale: Floats) -> Floats:
        """Product of the design matrices of two layers in units of the prior, (k, k)."""
        if (one, other, degree) not in self._products:
            share = np.repeat(self._share, self._weighted.shape[1])[:, None]
            # In double precision: the prior makes small eigenvalues count.
            found = self._rows(one, degree).T.astype(np.float64) @ (share * self._rows(other, degree))
            found = scale[:, None] * found * scale
            self._products[one, other, degree], self._products[other, one, degree] = found, found.T
        return self._products[one, other, degree]

    def _rows(self, ratio: float, degree: int) -> NDArray[np.float32]:
        rows = self.solver.rows(ratio, degree)
        return rows.reshape(-1, rows.shape[2])
