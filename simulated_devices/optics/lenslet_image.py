"""Image of one lenslet, and its derivatives with respect to the wavefront over the lenslet.

The field of an object point over a lenslet is a product of functions of u and v, and so is its image without a sample:
|F(x)|^2 |F(y)|^2. A small wavefront a P_m(xi) P_n(eta) adds a * 2 Re[i c_m(x) c_n(y)] with c_m = conj(F) F_m, F_m the
transform of the field times P_m. On samples symmetric about the axis, c_m is real for even m and imaginary for odd m:
to first order only wavefronts with odd m + n change the image.
"""

import math

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor, centered_steps
from simulated_devices.optics.source import SourcePoints

_PIXEL_NODES = 4  # of Gauss-Legendre quadrature over a pixel


class LensletImage:
    """Model of one lenslet with its source, on a square window of pixels about its axis; see `response.LensletModel`.

    Parameters
    ----------
    sensor, field
        Geometry of the bench.
    source : SourcePoints
        Object points and their light.
    width : int
        Side of the window, px.
    pupil_samples : int
        Samples along a side of the lenslet.
    pixel_fill_factor : float
        Width of a pixel's sensitive square over the pixel pitch.
    """

    def __init__(
        self,
        sensor: Sensor,
        field: Field,
        source: SourcePoints,
        *,
        width: int,
        pupil_samples: int,
        pixel_fill_factor: float = 1.0,
    ) -> None:
        lit = source.area_m2 > 0
        self._light = source.area_m2[lit]  # (point,)
        self.position = source.position_m[lit] / field.half_width_m  # normalised, (point, xy)
        self._position_m = source.position_m[lit]
        self._nodes, self._weights = np.polynomial.legendre.leggauss(_PIXEL_NODES)
        self._pixel_m = centered_steps(width) * sensor.pixel_pitch_m
        self._node_m = self._nodes * pixel_fill_factor * sensor.pixel_pitch_m / 2
        self._along = 2 * centered_steps(pupil_samples) / pupil_samples  # xi at the samples
        self._sample_m = self._along * sensor.lenslet_pitch_m / 2
        self._tilt_per_m = sensor.wavenumber_rad_per_m / field.collimator_focal_length_m
        self._wave_per_m = sensor.wavenumber_rad_per_m / sensor.lenslet_focal_length_m
        period_px = 2 * math.pi / self._wave_per_m * pupil_samples / sensor.lenslet_pitch_m / sensor.pixel_pitch_m
        self._scale = 1 / (pupil_samples * period_px)  # light of a point, integrated over one period, is 1

    def image(self) -> Floats:
        """Image without a sample, (row, column); a pixel's share of the light of all points."""
        along_x, along_y = (self._products(0, axis)[0] for axis in (0, 1))
        return np.asarray((along_y * self._light) @ along_x.T)

    def derivatives(self, degree: int, field_values: Floats) -> Floats:
        """Derivatives of the image by wavefronts P_m(xi) P_n(eta) T_q over the lenslet, m + n <= degree.

        Parameters
        ----------
        degree : int
            Highest m + n.
        field_values : (field_mode, point)
            T_q at `position`.

        Returns
        -------
        (n, m, field_mode, row, column)
            Change of the image per rad, as a share of the light; zero beyond the degree.
        """
        along_x, along_y = (self._products(degree, axis) for axis in (0, 1))
        count, width = len(field_values), len(self._pixel_m)
        derivatives = np.zeros((degree + 1, degree + 1, count, width, width))
        weighted = field_values * self._light
        for n in range(degree + 1):
            for m in range((n + 1) % 2, degree + 1 - n, 2):
                rows = (weighted[:, None] * along_y[n]).reshape(-1, weighted.shape[1])
                derivatives[n, m] = -2 * (rows @ along_x[m].T).reshape(count, width, width)
        return derivatives

    def _products(self, degree: int, axis: int) -> Floats:
        """F F_m averaged over each pixel, without the i of odd m: (m, pixel, point)."""
        y_m = self._pixel_m[:, None, None] + self._node_m[:, None]  # (pixel, node, 1)
        wave = self._tilt_per_m * self._position_m[:, axis] - self._wave_per_m * y_m  # rad/m, (pixel, node, point)
        even, odd = (part(wave[..., None] * self._sample_m) for part in (np.cos, np.sin))
        polynomials = np.polynomial.legendre.legvander(self._along, degree)  # (sample, m)
        field = even.sum(axis=-1)
        parts = [(odd if m % 2 else even) @ polynomials[:, m] for m in range(degree + 1)]
        return np.stack([np.tensordot(self._weights / 2, field * part, axes=(0, 1)) for part in parts]) * self._scale
