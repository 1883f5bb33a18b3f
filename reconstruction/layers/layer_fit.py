"""Phase of layers as a fit to displacements gives it, with error bars.

The smoothness prior: each coefficient is normally distributed about zero with standard deviation s k^-5, k the degree
of the polynomial over the layer. Strength and noise level maximise the evidence.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre as series

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.modes.legendre import legendre_products
from reconstruction.solve.evidence import FitQuality, fit_quality, maximize_evidence, prior_and_noise

UNSEEN = 1e-14  # eigenvalue over the largest, below which it is rounding

Footprints = tuple[tuple[float, Floats], ...]  # ratio and half width (xy,), m, of each layer


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
        """Phase at positions s, broadcast together, rad; NaN outside the footprint.

        It has no tilt if there is another layer, because the tilts of two layers cannot be told apart; `with_tilt` adds
        the share of this layer.
        """
        return self._on(x_m, y_m, self.coefficients[:, None], 1 if with_tilt else self._first)[..., 0]

    def sigma(self, x_m: Floats, y_m: Floats) -> Floats:
        """Standard deviation of `phase`, rad."""
        return np.asarray(np.linalg.norm(self._on(x_m, y_m, self.root_covariance, self._first), axis=-1))

    def _on(self, x_m: Floats, y_m: Floats, coefficients: Floats, first: int) -> Floats:
        """Values at positions s of polynomials with coefficients (k, n), from the polynomial `first` on: (..., n)."""
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
        """Wavefront of a field position at the lenslet centres, rad, without piston, (lenslet_row, lenslet_column)."""
        u_m, v_m = np.moveaxis(sensor.lenslet_centers_m, -1, 0)
        each = [layer.phase(u_m + layer.ratio * x_m, v_m + layer.ratio * y_m, with_tilt=True) for layer in self.layers]
        total = np.sum(each, axis=0)
        return np.asarray(total - total.mean())


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """A frame's whitened displacements, projected on the columns of a design matrix."""

    columns: Floats  # (column,)
    total: float  # sum of squares of the displacements
    count: int  # of displacements


class Spectrum:
    """Eigenvalues and eigenvectors of a normal matrix in units of the prior."""

    def __init__(self, gram: Floats) -> None:
        square, self._vectors = np.linalg.eigh(gram)
        self._square = np.where(square > UNSEEN * square[-1], square, 0.0)  # unseen ones keep the prior's variance

    def fit(self, moments: Moments, scale: Floats, footprints: Footprints) -> LayerFit:
        """Fit layers with those footprints; `scale` (column,) is the prior's standard deviation over its strength."""
        square, vectors = self._square, self._vectors
        along = self._along(moments)
        singular, relative = np.sqrt(square), square / square[-1]
        ratio, noise = prior_and_noise(relative, along, moments.total, moments.count)
        variance = noise * ratio / square[-1]  # of the prior
        found = scale * (vectors @ (variance / noise / (1 + ratio * relative) * singular * along))
        root = scale[:, None] * vectors * np.sqrt(variance / (1 + ratio * relative))
        first = 1 if len(footprints) == 1 else 3  # the tilts of two layers cannot be told apart
        parts = (np.split(every, len(footprints)) for every in (found, root))
        layers = tuple(
            Layer(at, math.nan, half_width_m, coefficients, covariance, first)
            for (at, half_width_m), coefficients, covariance in zip(footprints, *parts, strict=True)
        )
        return LayerFit(layers, self.quality(moments), np.zeros((len(layers), len(layers))))

    def quality(self, moments: Moments) -> FitQuality:
        """Quality of the fit alone."""
        along, relative = self._along(moments), self._square / self._square[-1]
        ratio, _ = maximize_evidence(relative, along, moments.total, moments.count)
        return fit_quality(ratio, relative, along, moments.total, moments.count)

    def _along(self, moments: Moments) -> Floats:
        """The data along the singular vectors, (n,); 0 where nothing is seen."""
        along, seen = np.zeros_like(self._square), self._square > 0
        along[seen] = (moments.columns @ self._vectors)[seen] / np.sqrt(self._square[seen])
        return along
