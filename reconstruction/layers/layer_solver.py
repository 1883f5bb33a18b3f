"""Fit of one or two thin layers at given distances to the displacements of a frame.

Rays meet a layer at s = u + ratio x. Its phase is a sum of Legendre polynomials over the part that they meet, its
footprint (docs/layers.md). Behind each lenslet it is projected on local wavefronts P_m(xi) P_n(eta) times field modes,
to which the response of the registration is known: displacements are linear in the layers' phases. Over the lattice it
is projected on pupil modes times field modes: phi(u, x) = Phi(u + ratio x).

The smoothness prior: each coefficient is normally distributed about zero with standard deviation s k^-5, k the degree
of the polynomial over the layer. Strength and noise level maximise the evidence.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Floats
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.polynomials import legendre_orders, legendre_products, legendre_projection, number_up_to
from reconstruction.modes.pupil_modes import PupilModes, pupil_modes
from reconstruction.runtime.deferred import Remembered
from reconstruction.solve.evidence import Components, FitQuality
from reconstruction.solve.expected_errors import ExpectedErrors, Whitened
from reconstruction.solve.modal import PRIOR_EXPONENT, UNSEEN, ModalSolver

_FIELD_NODES = {"square": 12, "circle": 24}  # along each axis; exact on a square


def field_projection(field: Field, field_modes: FieldModes) -> tuple[Floats, Floats]:
    """Nodes along the field's axes, (node,), and projection on its modes, (field_mode, node_y, node_x)."""
    nodes, weights = series.leggauss(_FIELD_NODES[field.shape])
    inside = field.contains(nodes, nodes[:, None])
    values = field_modes.values(nodes, nodes[:, None]) * inside
    weighted = values * np.outer(weights, weights)
    gram = np.tensordot(weighted, values, axes=([1, 2], [1, 2]))
    return nodes, np.tensordot(np.linalg.inv(gram), weighted, axes=1)


def layer_orders(degree: int) -> NDArray[np.intp]:
    """Orders (i, j) along x and y of a layer's polynomials up to a degree, without the constant, (k, xy)."""
    return np.array(legendre_orders(number_up_to(degree)))[1:]


class LayerDesign:
    """Design matrices of layers for one reference."""

    def __init__(self, sensor: Sensor, field: Field, field_modes: FieldModes, errors: ExpectedErrors) -> None:
        self._sensor, self._field = sensor, field
        response = errors.response  # (L, K, n, m, field_mode)
        self._n, self._m = np.nonzero(np.any(response, axis=(0, 1, 4)))
        chosen = response[:, :, self._n, self._m]
        self._response = np.ascontiguousarray(chosen.reshape(*chosen.shape[:2], -1), np.float32)  # (L, K, n m mode)
        self._highest = response.shape[3] - 1
        self._nodes, self._to_modes = field_projection(field, field_modes)

    def footprint_m(self, ratio: float) -> Floats:
        """Half width (xy,) of the part of a layer that rays meet."""
        return np.asarray(np.array(self._sensor.pupil_half_width_m) + abs(ratio) * self._field.half_width_m)

    def rows(self, ratio: float, degree: int) -> NDArray[np.float32]:
        """Whitened displacements per rad of a layer's polynomials, (L, K, k)."""
        i, j = layer_orders(degree).T
        half_x_m, half_y_m = self.footprint_m(ratio)
        sensor, reach_m = self._sensor, ratio * self._field.half_width_m
        along_y = self._along(sensor.pupil_y_m / half_y_m, half_y_m, reach_m, degree)  # (row, j, n, node)
        of_y = np.ascontiguousarray(along_y.transpose(1, 2, 0, 3)[j])  # (k, n, row, node)
        modes, nodes = self._to_modes.shape[:2]
        rows, columns = sensor.lenslets
        local = np.empty((rows, columns, len(i), len(self._n), modes), np.float32)
        step = 1 if sensor.arrangement == "square" else 2  # odd rows of a hexagonal lattice are shifted
        for first, x_m in enumerate(sensor.lenslet_centers_m[:step, :, 0]):
            along_x = self._along(x_m / half_x_m, half_x_m, reach_m, degree)  # (column, i, m, node)
            half = np.tensordot(along_x, self._to_modes, axes=([3], [2]))  # (column, i, m, field_mode, node_y)
            of_x = half.transpose(1, 2, 4, 3, 0)[i].reshape(len(i), self._highest + 1, nodes, -1)
            for place, (n, m) in enumerate(zip(self._n, self._m, strict=True)):
                found = np.matmul(of_y[:, n, first::step], of_x[:, m])  # (k, row, field_mode column)
                found = found.reshape(len(i), -1, modes, columns)
                local[first::step, :, :, place] = found.transpose(1, 3, 0, 2)
        per_rad = np.swapaxes(local.reshape(rows * columns, len(i), -1), 1, 2)
        return np.asarray(np.matmul(self._response, per_rad))

    def _along(self, center: Floats, half_width_m: float, reach_m: float, degree: int) -> Floats:
        """P_i((c + w xi + r x) / h) = sum_m a_m P_m(xi) at the field's nodes x: (cell, i, m, node).

        `center` (cell,) is in half widths of the footprint.
        """
        nodes, project = legendre_projection(self._highest, degree)
        lenslet = nodes * self._sensor.aperture_width_m / 2 / half_width_m
        at = center[:, None, None] + lenslet[:, None] + self._nodes * reach_m / half_width_m  # (cell, xi, x)
        values = series.legvander(at, degree)  # (cell, xi, x, i)
        return np.asarray(np.einsum("cgxi,gm->cimx", values, project, optimize=True))


class LayerModes:
    """Projection of a layer's polynomials on pupil modes times field modes.

    Both are Legendre polynomials P_i(x) P_j(y) without the constant, ordered as `legendre_orders`.
    """

    def __init__(self, degree: int, sensor: Sensor, field: Field, field_modes: FieldModes) -> None:
        self._orders = layer_orders(degree)  # (k, xy)
        self._highest = degree
        self._share = field.half_width_m / np.array(sensor.pupil_half_width_m)
        self._nodes, self._to_modes = field_projection(field, field_modes)
        self.pupil_modes: PupilModes = pupil_modes(sensor, "legendre", len(self._orders) + 1)
        # A layer's polynomial of degree k has no product of a higher degree in pupil and field together.
        within = self._orders.sum(axis=1)[:, None] + field_modes.degree <= degree
        self.columns: Booleans = np.asarray(within)  # (pupil_mode - 1, field_mode)

    def __call__(self, ratio: float) -> Floats:
        """Coefficients of every polynomial at `columns`, rad, (column, k)."""
        along_x, along_y = (self._along(float(of_axis)) for of_axis in ratio * self._share)
        half = np.tensordot(self._to_modes, along_x, axes=([2], [1]))  # (field_mode, y, i, m)
        i, j = self._orders.T
        products = np.empty((len(i), *self.columns.shape))
        for k, (i_k, j_k) in enumerate(self._orders):
            full = np.tensordot(half[:, :, i_k], along_y[j_k], axes=([1], [0]))  # (field_mode, m, n)
            products[k] = full[:, i, j].T
        return np.ascontiguousarray(products[:, self.columns].T)

    def _along(self, ratio: float) -> Floats:
        """P_i((xi + ratio x) / (1 + |ratio|)) = sum_m a_m P_m(xi) at the nodes x: (i, node, m)."""
        nodes, project = legendre_projection(self._highest, self._highest)
        values = series.legvander((nodes[:, None] + ratio * self._nodes) / (1 + abs(ratio)), self._highest)
        return np.asarray(np.einsum("pxi,pm->ixm", values, project, optimize=True))


# Degree of a layer's phase: the field positions of a lenslet lie between those of its neighbours, so that more than the
# lenslets alone can carry are seen.
_MORE_THAN_LENSLETS, _HIGHEST_DEGREE = 3, 18
SKETCH_DEGREE = 9  # enough to tell distances apart on a coarse grid
_LEAST_LENSLETS = 9
_REMEMBERED_BYTES = 7e7  # of design matrices: a coarse grid for 15 x 15 lenslets, and more
# Systematic error: share of the displacement in one parameter of the warp that appears in another one, or is missing in
# itself, alike for all lenslets of a frame. What the mask hides of a displacement shows in the others to second order.
# Fitted to the distances in frames without and with noise (docs/layers.md).
_SYSTEMATIC_SHARE, _SHARE_PER_HIDDEN = 0.0009, 0.00025


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Phase of one layer, in coordinates s = u + ratio x."""

    ratio: float  # of field position to pupil position where rays meet the layer; negative before the lenslets
    ratio_sigma: float  # NaN if the ratio was given
    half_width_m: Floats  # of the footprint, (xy,)
    coefficients: Floats  # of the polynomials over the footprint, rad, (k,)
    root_covariance: Floats  # rad, (k, n); the components n are those of all layers of a fit
    _first: int  # the lowest polynomial of the map: 1, or 3 without tilt

    def phase(self, x_m: Floats, y_m: Floats, *, with_tilt: bool = False) -> Floats:
        """Phase at positions s (...), broadcast together, rad; NaN outside the footprint.

        It has no tilt if there is another layer, because the tilts of two layers cannot be separated; `with_tilt` adds
        the share of this layer.
        """
        return self._on(x_m, y_m, self.coefficients[:, None], 1 if with_tilt else self._first)[..., 0]

    def sigma(self, x_m: Floats, y_m: Floats) -> Floats:
        """Standard deviation of `phase` (...), rad."""
        return np.asarray(np.linalg.norm(self._on(x_m, y_m, self.root_covariance, self._first), axis=-1))

    def _on(self, x_m: Floats, y_m: Floats, coefficients: Floats, first: int) -> Floats:
        """Polynomials from `first` on, with coefficients (k, n), at positions s (...): (..., n)."""
        x, y = np.asarray(x_m / self.half_width_m[0]), np.asarray(y_m / self.half_width_m[1])
        outside = np.maximum(np.abs(x), np.abs(y)) > 1 + 1e-9
        products = legendre_products(len(coefficients) + 1)[first:]
        matrix = np.tensordot(products, coefficients[first - 1 :], axes=(0, 0))  # (degree in y, degree in x, n)
        highest = len(matrix) - 1
        along_x, along_y = (series.legvander(np.clip(at, -1, 1), highest) for at in (x, y))
        inner = np.tensordot(along_x, matrix, axes=([-1], [1]))  # (..., degree in y, n)
        values = np.matmul(along_y[..., None, :], inner)[..., 0, :]
        values[outside] = np.nan
        return np.asarray(values)


@dataclass(frozen=True, slots=True, eq=False)
class LayerFit:
    """Layers at given distances, and how well they explain the displacements."""

    layers: tuple[Layer, ...]
    quality: FitQuality
    ratio_covariance: Floats  # of the layers' ratios, (layer, layer); 0 if they were given

    def wavefront(self, sensor: Sensor, x_m: float, y_m: float) -> Floats:
        """Wavefront of a field position, rad, without piston, (lenslet_row, lenslet_column)."""
        u_m, v_m = np.moveaxis(sensor.lenslet_centers_m, -1, 0)
        each = [layer.phase(u_m + layer.ratio * x_m, v_m + layer.ratio * y_m, with_tilt=True) for layer in self.layers]
        total = np.sum(each, axis=0)
        return np.asarray(total - total.mean())


def prior_scale(degree: int) -> Floats:
    """Standard deviation of a layer's polynomials up to a degree over the prior's strength, (k,)."""
    return np.asarray(np.sum(layer_orders(degree), axis=1) ** -PRIOR_EXPONENT)


def principal(gram: Floats) -> tuple[Floats, Floats]:
    """Singular values, (n,), and vectors, (n, n), of a normal matrix (n, n) in units of the prior.

    What the displacements do not show has the value 0: it keeps the prior's variance.
    """
    square, vectors = np.linalg.eigh(gram)
    return np.sqrt(np.where(square > UNSEEN * square[-1], square, 0.0)), vectors


def divided(columns: Floats, singular: Floats) -> Floats:
    """Columns (..., n) over their singular values (n,); 0 where these are 0."""
    return np.divide(columns, singular, where=singular > 0, out=np.zeros_like(columns))


def require_lenslets(frame: Whitened) -> None:
    """Raise `ReconstructionError` if there are too few valid lenslets for layers."""
    if np.count_nonzero(frame.share) < _LEAST_LENSLETS:
        raise ReconstructionError(f"layers need at least {_LEAST_LENSLETS} valid lenslets")


class LayerSolver:
    """Fits layers to the displacements measured against one reference.

    `free` fits the same displacements without assuming layers. `hidden` is the number of displacements of a lenslet
    that the mask does not show.
    """

    def __init__(
        self, sensor: Sensor, field: Field, field_modes: FieldModes, free: ModalSolver, *, hidden: int
    ) -> None:
        if field_modes.count < 2:
            raise ReconstructionError("the distance of a layer needs displacements that change over the field")
        self.free, self.errors = free, free.errors
        self.systematic_share = _SYSTEMATIC_SHARE + _SHARE_PER_HIDDEN * hidden
        self.degree = min(min(sensor.lenslets) + _MORE_THAN_LENSLETS, _HIGHEST_DEGREE)
        self._design = LayerDesign(sensor, field, field_modes, free.errors)
        self.footprint_m = self._design.footprint_m
        size = free.errors.colour.shape[0] * free.errors.colour.shape[1] * 4
        self._exact = Remembered[NDArray[np.float32]](4)
        sketched = size * len(layer_orders(SKETCH_DEGREE))
        self._sketched = Remembered[NDArray[np.float32]](max(2, int(_REMEMBERED_BYTES / sketched)))

    def rows(self, ratio: float, degree: int) -> NDArray[np.float32]:
        """Whitened displacements per rad of a layer's polynomials, (L, K, k)."""
        remembered = self._sketched if degree == SKETCH_DEGREE else self._exact
        return remembered(self._design.rows, ratio, degree)


class FrameEquations:
    """Displacements of one frame, to which layers at any distance can be fitted."""

    def __init__(self, solver: LayerSolver, displacement: Displacement, weights: Floats | None = None) -> None:
        """`ReconstructionError` if too few lenslets are valid; `weights` as in `ModalSolver`."""
        self.solver, self._displacement, self._weights = solver, displacement, weights
        self._frame = solver.errors.whitened(displacement, weights)
        require_lenslets(self._frame)
        if not self._frame.total > 0:
            raise ReconstructionError("the displacements are all zero: there is no layer to find")
        self._products: dict[tuple[float, float, int], Floats] = {}
        self._columns: dict[tuple[float, int], Floats] = {}

    def fit(self, *ratios: float, strengths: tuple[float, ...] = ()) -> LayerFit:
        """Fit layers at some ratios of field to pupil position; their priors have the same strength by default."""
        components, vectors, scale = self._components(ratios, strengths, self.solver.degree)
        estimate = components.estimate()
        variance = estimate.noise * estimate.ratio / (1 + estimate.ratio * components.singular**2)
        found, root = scale * (vectors @ estimate.values), scale[:, None] * vectors * np.sqrt(variance)
        first = 1 if len(ratios) == 1 else 3  # the tilts of two layers cannot be separated
        layers = tuple(
            Layer(ratio, math.nan, self.solver.footprint_m(ratio), coefficients, covariance, first)
            for ratio, coefficients, covariance in zip(
                ratios, *(np.split(every, len(ratios)) for every in (found, root)), strict=True
            )
        )
        return LayerFit(layers, components.quality(), np.zeros((len(layers), len(layers))))

    def quality(self, *ratios: float, degree: int, strengths: tuple[float, ...] = ()) -> FitQuality:
        """Quality of the fit of layers with polynomials up to a degree; see `fit`."""
        return self._components(ratios, strengths, degree)[0].quality()

    def any_wavefront(self) -> FitQuality:
        """Quality of the fit of a wavefront without assuming layers."""
        return self.solver.free.quality(self._displacement, weights=self._weights)

    def distance_covariance(self, fit: LayerFit, before: list[LayerFit], after: list[LayerFit], step: float) -> Floats:
        """Covariance of the distances caused by systematic errors of the displacements, (n, n).

        `before` and `after` are the fits with each distance a step shorter and longer; the unit is that of the step.
        """
        explained, colour = self.explained(fit), self.solver.errors.colour
        slopes = np.array([self.explained(far) - self.explained(near) for near, far in zip(before, after, strict=True)])
        slopes /= 2 * step
        weighted = slopes * self._frame.share[:, None]
        normal = np.einsum("ilk,jlk->ij", weighted, slopes)
        influence = np.tensordot(np.linalg.pinv(normal, hermitian=True), weighted, axes=1)  # of displacements
        per_px = np.linalg.solve(colour.transpose(0, 2, 1), influence[..., None])[..., 0]
        per_error = np.einsum("nlk,lj->nkj", per_px, np.matvec(colour, explained))
        return np.asarray(self.solver.systematic_share**2 * np.einsum("nkj,mkj->nm", per_error, per_error))

    def explained(self, fit: LayerFit) -> Floats:
        """Whitened displacements that a fit explains, (L, K)."""
        each = [self.solver.rows(layer.ratio, self.solver.degree) @ layer.coefficients for layer in fit.layers]
        return np.asarray(np.sum(each, axis=0))

    def _components(
        self, ratios: tuple[float, ...], strengths: tuple[float, ...], degree: int
    ) -> tuple[Components, Floats, Floats]:
        """The displacements in components of layers, in units of the prior, the vectors of these, and the prior."""
        scale = prior_scale(degree)
        for ratio in ratios:
            if (ratio, degree) not in self._columns:
                # In double precision, as the products below: layers close to each other differ little.
                self._columns[ratio, degree] = scale * (self._frame.weighted.ravel() @ self._rows(ratio, degree))
        strength = np.repeat(strengths or np.ones(len(ratios)), len(scale))
        gram = np.block([[self._product(one, other, degree, scale) for other in ratios] for one in ratios])
        columns = strength * np.concatenate([self._columns[ratio, degree] for ratio in ratios])
        singular, vectors = principal(strength[:, None] * gram * strength)
        along = divided(columns @ vectors, singular)
        components = Components(singular, along, self._frame.total, self._frame.number)
        return components, vectors, strength * np.tile(scale, len(ratios))

    def _product(self, one: float, other: float, degree: int, scale: Floats) -> Floats:
        """Product of the design matrices of two layers in units of the prior, (k, k)."""
        if (one, other, degree) not in self._products:
            share = np.repeat(self._frame.share, self._frame.weighted.shape[1])[:, None]
            # In double precision: the prior makes small eigenvalues count.
            found = self._rows(one, degree).T.astype(np.float64) @ (share * self._rows(other, degree))
            found = scale[:, None] * found * scale
            self._products[one, other, degree], self._products[other, one, degree] = found, found.T
        return self._products[one, other, degree]

    def _rows(self, ratio: float, degree: int) -> NDArray[np.float32]:
        """`LayerSolver.rows` as a matrix, (L * K, k)."""
        rows = self.solver.rows(ratio, degree)
        return rows.reshape(-1, rows.shape[2])
