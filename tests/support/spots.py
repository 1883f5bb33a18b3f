"""Frames of point sources in closed form: Gaussian spots, integrated over each pixel by the error function."""

from __future__ import annotations

import math

import numpy as np
from scipy import special

from reconstruction.arrays import Booleans, Floats
from reconstruction.geometry import Arrangement, Field, Lattice, Sensor


def spots(shape: tuple[int, int], center_px: Floats, *, sigma_px: float, light: Floats | float = 1.0) -> Floats:
    """Sum of spots at positions (..., xy), each of that light, on an image of a shape (row, column)."""
    center_px = center_px.reshape(-1, 2)
    x, y = (
        np.diff(special.ndtr((np.arange(count + 1) - 0.5 - center_px[:, axis, None]) / sigma_px), axis=1)
        for axis, count in ((0, shape[1]), (1, shape[0]))
    )
    return np.asarray((y * np.broadcast_to(light, len(center_px))[:, None]).T @ x)


class SpotBench:
    """A sensor with a single spot in each lenslet, perhaps turned; `pitch_px` wide cells."""

    def __init__(
        self,
        rows: int = 12,
        columns: int = 12,
        *,
        pitch_px: float = 24.0,
        rotation_rad: float = 0.0,
        margin_px: int = 10,
        field_half_width_px: float = 1.0,
        arrangement: Arrangement = "square",
        shape: tuple[int, int] | None = None,
    ) -> None:
        self.sensor = Sensor(
            lenslet_rows=rows,
            lenslet_columns=columns,
            lenslet_pitch_m=pitch_px * 10e-6,
            lenslet_focal_length_m=10e-3,
            wavelength_m=500e-9,
            pixel_pitch_m=10e-6,
            arrangement=arrangement,
        )
        self.field = Field(
            collimator_focal_length_m=0.1, half_width_m=field_half_width_px * 1e-4, view_rows=1, view_columns=1
        )
        self.shape = shape or (round(rows * pitch_px) + 2 * margin_px, round(columns * pitch_px) + 2 * margin_px)
        self.lattice = Lattice(
            center_x_px=(self.shape[1] - 1) / 2 + 0.31,
            center_y_px=(self.shape[0] - 1) / 2 - 0.22,
            pitch_px=pitch_px,
            rotation_rad=rotation_rad,
            arrangement=arrangement,
        )
        self.center_px = self.lattice.lenslet_centers_px(rows, columns)  # (row, column, xy)

    def image(
        self, moved_px: Floats | float = 0.0, *, sigma_px: float, light: Floats | float, lit: Booleans | None = None
    ) -> Floats:
        """Photons of spots displaced on the camera by (row, column, xy), px, where lit (row, column)."""
        lit = np.ones(self.center_px.shape[:2], np.bool_) if lit is None else lit
        light = np.broadcast_to(light, lit.shape)[lit]
        return spots(self.shape, (self.center_px + moved_px)[lit], sigma_px=sigma_px, light=light)


def fractions(rows: int, columns: int) -> Floats:
    """Displacements (row, column, xy), px, with all fractions of a pixel and up to two of them."""
    x, y = np.meshgrid(np.arange(columns) / columns, np.arange(rows) / rows)
    return np.stack([x + 2 * (y > 0.5) - 1, y - 2 * (x > 0.5) + 1], axis=-1)


def least_error_px(sigma_px: float, photons: float) -> float:
    """Cramer-Rao bound of a spot's position along one axis in photon noise, without pixels."""
    return sigma_px / math.sqrt(photons)
