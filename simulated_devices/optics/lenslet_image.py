"""Image of one lenslet, and its derivatives with respect to the wavefront over the lenslet.

The field of an object point over a lenslet is a product of functions of u and v, and so is its image without a sample:
|F(x)|^2 |F(y)|^2. A small wavefront a P_m(xi) P_n(eta) adds a * 2 Re[i c_m(x) c_n(y)] with c_m = conj(F) F_m, F_m the
transform of the field times P_m. On samples symmetric about the axis, c_m is real for even m and imaginary for odd m:
to first order only wavefronts with odd m + n change the image. A hexagonal aperture is a sum of a few such products.

A wavefront that changes over the field gathers light on the lenslets, too: (f1 / k) sum_j d2 phi / dx_j du_j of that of
an object point, which adds Re of the same products with the derivative of P_m or P_n (docs/methods.md).

With a small wavefront b P_k(xi) P_l(eta) of the lenslet's own, F becomes F + i b F_kl. With odd k + l it changes the
image to first order, and so it changes what other odd wavefronts do.
"""

import math
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre as series

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor, centered_steps
from simulated_devices.optics.forward_model import lenslet_aperture
from simulated_devices.optics.source import SourcePoints

_PIXEL_NODES = 4  # of Gauss-Legendre quadrature over a pixel
_UNCHANGED = 0, 0  # orders of a factor 1
_NOTHING = 1e-12  # singular value of an aperture, over the largest, that is rounding


class LensletImage:
    """Model of one lenslet with its source, on a square window about its axis; a `LensletModel`.

    `width` is the side of the window, px; `pupil_samples` and `pixel_fill_factor` are those of `ForwardModel`.
    """

    def __init__(
        self,
        sensor: Sensor,
        field: Field,
        source: SourcePoints,
        *,
        width: int,
        pupil_samples: int,
        pixel_fill_factor: float,
    ) -> None:
        lit = source.area_m2 > 0
        self._light = source.area_m2[lit]  # (point,)
        self.position = source.position_m[lit] / field.half_width_m  # normalised, (point, xy)
        self._position_m = source.position_m[lit]
        self._nodes, self._weights = np.polynomial.legendre.leggauss(_PIXEL_NODES)
        self._pixel_m = centered_steps(width) * sensor.pixel_pitch_m
        self._node_m = self._nodes * pixel_fill_factor * sensor.pixel_pitch_m / 2
        aperture = lenslet_aperture(sensor.arrangement, pupil_samples)
        samples = len(aperture)
        self._along = 2 * centered_steps(samples) / samples  # xi at the samples
        self._sample_m = self._along * sensor.aperture_width_m / 2
        self._tilt_per_m = sensor.wavenumber_rad_per_m / field.collimator_focal_length_m
        self._wave_per_m = sensor.wavenumber_rad_per_m / sensor.lenslet_focal_length_m
        period_px = 2 * math.pi / self._wave_per_m * samples / sensor.aperture_width_m / sensor.pixel_pitch_m
        # Share of light that a wavefront gathers, per rad, in units of the field's and the lenslet's half width.
        gathered = field.collimator_focal_length_m / sensor.wavenumber_rad_per_m / field.half_width_m
        self._gathered = 0.0 if field.neglect_propagation else 2 * gathered / sensor.aperture_width_m
        self._factors = _factors(aperture)  # along x and y, each (term, sample)
        self._terms = len(self._factors[0]) ** 2  # of a product of two fields
        self._scale = 1 / (math.sqrt(np.sum(aperture)) * period_px)  # light of a point, over one period, is 1

    def image(self, brightness: Floats | float = 1.0) -> Floats:
        """Image without a sample, (row, column): share of the light of all points, times a `brightness`."""
        along_x, along_y = self._squares
        return np.asarray((along_y * np.repeat(self._light * brightness, self._terms)) @ along_x.T)

    @cached_property
    def _squares(self) -> tuple[Floats, Floats]:
        """F F along x and y, each (pixel, point * term)."""
        return self._products(0, 0)[0], self._products(0, 1)[0]

    def derivatives(self, degree: int, values: Floats, gradients: Floats, own: tuple[int, int] | None = None) -> Floats:
        """Derivatives of the image by wavefronts P_m(xi) P_n(eta) T_q over the lenslet, m + n <= degree.

        Parameters
        ----------
        degree : int
            Highest m + n.
        values : (field_mode, point)
            T_q at `position`.
        gradients : (field_mode, point, xy)
            Gradients of T_q there, normalised.
        own : (n, m), optional
            Of odd m + n: derive once more by the lenslet's own wavefront P_m(xi) P_n(eta).

        Returns
        -------
        (n, m, field_mode, row, column)
            Change of the image per rad, with `own` per rad^2, as a share of the light; zero beyond the degree.
        """
        # A wavefront changes the field F by i F_mn, and by the part of its slopes that is light, F_s.
        if own is None:
            return self._combined(degree, values, gradients, phase=1j, light=1)  # conj(F) i F_mn, conj(F) F_s
        # The own one changes each field by i times that with its factor; the first of a product is conjugated.
        of_first = self._combined(degree, values, gradients, phase=1, light=-1j, own=(own, _UNCHANGED))
        return of_first + self._combined(degree, values, gradients, phase=-1, light=1j, own=(_UNCHANGED, own))

    def _combined(
        self,
        degree: int,
        values: Floats,
        gradients: Floats,
        *,
        phase: complex,
        light: complex,
        own: tuple[tuple[int, int], tuple[int, int]] = (_UNCHANGED, _UNCHANGED),
    ) -> Floats:
        """Add up Re of factors times products of two fields, for the phase and the light of wavefronts.

        The two fields have their `own` factors P_m(xi) P_n(eta), (n, m). An odd function's transform has an i.
        """
        first, second = own
        along_y, along_x = (self._products(degree, 1 - axis, first[axis], second[axis]) for axis in (0, 1))
        derive = series.legder(np.eye(degree + 1)) if degree else np.zeros((0, 1))
        slope_y, slope_x = (np.tensordot(derive, along[:-1], axes=(0, 0)) for along in (along_y, along_x))
        of_phase, light_x, light_y = (
            np.repeat(weight * self._light, self._terms, axis=1)
            for weight in (2 * values, self._gathered * gradients[..., 0], self._gathered * gradients[..., 1])
        )
        count, width = len(values), len(self._pixel_m)
        derivatives = np.zeros((degree + 1, degree + 1, count, width, width))

        def turned(factor: complex, n: int, m: int) -> float:
            of_second = (n + second[0]) % 2 + (m + second[1]) % 2
            return float((factor * 1j ** (of_second - first[0] % 2 - first[1] % 2)).real)

        for n in range(degree + 1):
            for m in range((n + 1) % 2, degree + 1 - n, 2):
                parts = [(turned(phase, n, m) * of_phase, along_y[n], along_x[m])]
                if self._gathered:
                    parts.append((turned(light, n, m + 1) * light_x, along_y[n], slope_x[m]))
                    parts.append((turned(light, n + 1, m) * light_y, slope_y[n], along_x[m]))
                for weight, of_y, of_x in parts:
                    rows = (weight[:, None] * of_y).reshape(-1, weight.shape[1])
                    derivatives[n, m] += (rows @ of_x.T).reshape(count, width, width)
        return derivatives

    def _products(self, degree: int, axis: int, first: int = 0, second: int = 0) -> Floats:
        """F F_m averaged over each pixel, without the i of odd functions: (m, pixel, point * term).

        F is of the field times P_first, F_m of the field times P_m and P_second.
        """
        position_m, of_point = np.unique(self._position_m[:, axis], return_inverse=True)  # a grid has few along an axis
        y_m = self._pixel_m[:, None, None] + self._node_m[:, None]  # (pixel, node, 1)
        wave = self._tilt_per_m * position_m - self._wave_per_m * y_m  # rad/m, (pixel, node, position)
        parts = (np.cos, np.sin) if max(degree, first, second) else (np.cos,)  # without odd functions no sine is needed
        of_parity = [part(wave[..., None] * self._sample_m) for part in parts]
        polynomials = np.polynomial.legendre.legvander(self._along, max(degree, first, second)).T  # (m, sample)
        factors = self._factors[axis].T  # (sample, term)

        def transform(m: int, times: int = 0) -> Floats:
            of_sample = factors * (polynomials[m] * polynomials[times])[:, None]
            return np.asarray(of_parity[(m + times) % 2] @ of_sample)

        field = transform(first) * (self._weights[:, None, None] / 2 * self._scale)
        products = [np.einsum("inpr,inps->iprs", field, transform(m, second)) for m in range(degree + 1)]
        return np.stack(products)[:, :, of_point].reshape(degree + 1, len(y_m), -1)


def _factors(aperture: Floats) -> tuple[Floats, Floats]:
    """Functions of x and y, each (term, sample), whose products add up to the aperture (sample_row, ...)."""
    along_y, size, along_x = np.linalg.svd(aperture)
    count = np.count_nonzero(size > _NOTHING * size[0])
    return along_x[:count], (along_y[:, :count] * size[:count]).T
