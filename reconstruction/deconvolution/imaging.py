"""Geometry of an image taken through the same sample: section `[imaging]` of a bench."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from typing_extensions import Doc

from reconstruction.annotated_settings import Checked
from reconstruction.arrays import Booleans, Floats
from reconstruction.geometry import Field, Sensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Imaging(Checked):
    """Geometry of an image of the field, its pupil, and its noise.

    The image's columns are reversed if `is_mirrored`, and then lie along the field's +x axis turned by `rotation_rad`;
    a positive rotation turns the field's +x towards its +y in the image.
    """

    pixel_m: Annotated[float, Ge(1e-10), Le(1e-2), Doc("Size of a pixel in the field")]
    center_x_px: Annotated[float, Doc("Middle of the field in the image; omitted: its middle")] | None = None
    center_y_px: float | None = None
    rotation_rad: Annotated[float, Ge(-4), Le(4)] = 0.0
    is_mirrored: bool = False
    pupil_diameter_m: Annotated[float, Ge(1e-6), Le(100), Doc("Round pupil; omitted: the lattice")] | None = None
    numerical_aperture: Annotated[float, Ge(1e-6), Le(2), Doc("Numerical aperture, not the diameter")] | None = None
    wavelength_m: Annotated[float, Ge(1e-8), Le(1e-3), Doc("Wavelength; omitted: the sensor's")] | None = None
    dark_counts: Annotated[float, Doc("Counts of a pixel without light")] = 0.0
    counts_per_electron: Annotated[float, Ge(1e-6), Le(1e6), Doc("Conversion gain; omitted: estimated")] | None = None
    read_noise_counts: Annotated[float, Ge(0)] = 0.0

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if self.pupil_diameter_m is not None and self.numerical_aperture is not None:
            yield "numerical_aperture", "must be left out if there is pupil_diameter_m"
        if self.read_noise_counts and self.counts_per_electron is None:
            yield "read_noise_counts", "needs counts_per_electron, too"

    @property
    def to_field(self) -> Floats:
        """Orthogonal matrix (2, 2) from directions (x, y) in the image to directions in the field."""
        cosine, sine = math.cos(self.rotation_rad), math.sin(self.rotation_rad)
        return np.array([[cosine, sine], [-sine, cosine]]) @ np.diag([-1.0 if self.is_mirrored else 1.0, 1.0])

    @property
    def is_round(self) -> bool:
        """True for a round pupil, False for the whole lattice."""
        return (self.pupil_diameter_m or self.numerical_aperture) is not None

    def pupil_width_m(self, sensor: Sensor, field: Field) -> float:
        """Diameter of a round pupil, or the smaller width of the lattice."""
        if self.numerical_aperture is not None:
            return 2 * self.numerical_aperture * field.collimator_focal_length_m
        return self.pupil_diameter_m or 2 * min(sensor.pupil_half_width_m)

    def light_m(self, sensor: Sensor) -> float:
        """Wavelength of the image."""
        return self.wavelength_m or sensor.wavelength_m

    def blur_px(self, sensor: Sensor, field: Field) -> float:
        """Optical resolution: wavelength over pupil width in the field; 2 pixels just sample it."""
        resolution_rad = self.light_m(sensor) / self.pupil_width_m(sensor, field)
        return resolution_rad * field.collimator_focal_length_m / self.pixel_m

    def center_px(self, shape: tuple[int, ...]) -> Floats:
        """Position (x, y) of the field's middle in an image of that shape."""
        x, y = self.center_x_px, self.center_y_px
        return np.array([(shape[1] - 1) / 2 if x is None else x, (shape[0] - 1) / 2 if y is None else y])

    def field_m(self, x_px: Floats, y_px: Floats, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Field positions x and y, m, each (...), of image positions (...) that broadcast against each other."""
        center = self.center_px(shape)
        columns, rows = np.broadcast_arrays(x_px - center[0], y_px - center[1])
        at_m = self.pixel_m * np.einsum("ij,j...->i...", self.to_field, np.stack([columns, rows]))
        return at_m[0], at_m[1]

    def inside(self, shape: tuple[int, ...], field: Field) -> Booleans:
        """True for the pixels (row, column) of an image that lie within the measured field."""
        rows, columns = (np.arange(count, dtype=np.float64) for count in shape)
        x_m, y_m = self.field_m(columns, rows[:, None], shape)
        return field.contains(x_m / field.half_width_m, y_m / field.half_width_m)
