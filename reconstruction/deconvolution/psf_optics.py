"""Point-spread functions in the pixels of an image, from wavefronts at the lenslets."""

import math

import numpy as np
from scipy.interpolate import RectBivariateSpline

from reconstruction.arrays import Floats
from reconstruction.deconvolution.imaging import Imaging
from reconstruction.geometry import Field, Sensor, centered_steps
from reconstruction.quality.image_quality import DIFFRACTION, SAMPLES, aligned, extrapolate, psf_reach_rad

_FEWEST_SAMPLES = 64  # across the pupil


def psf_reach_px(imaging: Imaging, sensor: Sensor, field: Field, phase: Floats) -> int:
    """Half the width that holds nearly all light of wavefronts (..., lenslet_row, lenslet_column), rad."""
    geometry_px = psf_reach_rad(phase, sensor) * field.collimator_focal_length_m / imaging.pixel_m
    return math.ceil(geometry_px + DIFFRACTION * imaging.blur_px(sensor, field))


class PsfOptics:
    """Point-spread functions in the pixels of an image, from wavefronts at the lenslets; prepared once.

    `reach_px` is half their width. `ValueError` if the pupil is larger than the lattice, beyond which no wavefront is
    known.
    """

    def __init__(self, imaging: Imaging, sensor: Sensor, field: Field, reach_px: int) -> None:
        light_m, width_m = imaging.light_m(sensor), imaging.pupil_width_m(sensor, field)
        half_m, is_round = np.array(sensor.pupil_half_width_m), imaging.is_round
        if is_round and width_m > 2 * half_m.min() * (1 + 1e-9):
            raise ValueError(
                f"the imaging pupil of {width_m * 1e3:.4g} mm is wider than the lattice of {half_m.min() * 2e3:.4g} mm,"
                " beyond which no wavefront is known"
            )
        self._sensor, self._scale = sensor, sensor.wavelength_m / light_m
        reach_rad = reach_px * imaging.pixel_m / field.collimator_focal_length_m
        step_m = min(sensor.lenslet_pitch_m / SAMPLES, light_m / (2.1 * reach_rad + 1e-30), width_m / _FEWEST_SAMPLES)
        extent_m = np.full(2, width_m / 2) if is_round else np.abs(imaging.to_field.T) @ half_m
        x_m, y_m = (centered_steps(math.ceil(2 * each / step_m)) for each in extent_m)  # along the axes of the image
        x_m, y_m = x_m * (2 * extent_m[0] / len(x_m)), y_m * (2 * extent_m[1] / len(y_m))
        self._u_m = np.einsum("ij,j...->i...", imaging.to_field, np.stack(np.meshgrid(x_m, y_m)))
        edge_m = width_m / 2 - np.hypot(*self._u_m) if is_round else (half_m[:, None, None] - np.abs(self._u_m))
        share = np.clip(edge_m / step_m + 0.5, 0, 1)  # of a sample at the edge that lies within the pupil
        self._amplitude = share if is_round else share.prod(axis=0)
        pixel_rad = imaging.pixel_m / field.collimator_focal_length_m
        self._parts = math.ceil(2 / imaging.blur_px(sensor, field))  # of a pixel that resolve the pattern
        at_px = np.arange((2 * reach_px + 1) * self._parts) / self._parts - reach_px - (1 - 1 / self._parts) / 2
        turn = -2j * math.pi / light_m * pixel_rad * at_px[:, None]
        self._to_row, self._to_column = np.exp(turn * y_m).astype(np.complex64), np.exp(turn * x_m).astype(np.complex64)

    def __call__(self, phase: Floats) -> Floats:
        """Point-spread function of a wavefront, averaged over each pixel if pixels are coarse.

        A positive slope moves the light towards the field's +x. From rad at the sensor's wavelength, (lenslet_row,
        lenslet_column), NaN where unknown, to (2 reach + 1, 2 reach + 1) in the image's rows and columns; sum 1.
        """
        y_m, x_m = (centered_steps(count + 2) for count in phase.shape)
        y_m, x_m = y_m * self._sensor.row_spacing_m, x_m * self._sensor.lenslet_pitch_m
        spline = RectBivariateSpline(y_m, x_m, extrapolate(aligned(phase, self._sensor.arrangement)))
        fine = spline.ev(self._u_m[1], self._u_m[0]) * self._scale
        field = (self._amplitude * np.exp(1j * np.remainder(fine, 2 * math.pi))).astype(np.complex64)
        light = np.abs(self._to_row @ field @ self._to_column.T).astype(np.float64) ** 2
        side = len(light) // self._parts
        light = light.reshape(side, self._parts, side, self._parts).sum(axis=(1, 3))
        return np.asarray(light / light.sum())
