"""Small benches for the tests, and phases in closed form to put in front of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image, PointField
from reconstruction.displacement import Displacement, diagonal_covariance
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.frame.pixels import KnownCamera
from reconstruction.geometry import Field, Lattice, Sensor
from reconstruction.modes.field_modes import FieldModes
from reconstruction.reconstructor import Reconstructor
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, SampleModel, Warp
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.source import SourcePoints, source_points
from simulated_devices.settings import Source

VIEWS = np.array([-5.0, 0.0, 5.0]) / 6  # where the views of FIELD lie, in units of its half width
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)  # in real light
PAPER = replace(FIELD, neglect_propagation=True)  # the paper's simulation: uniform light, conserved flux


def sensor_of(rows: int, columns: int) -> Sensor:
    """A sensor of the paper's lenslets on 16 um pixels."""
    return Sensor(
        lenslet_rows=rows,
        lenslet_columns=columns,
        lenslet_pitch_m=500e-6,
        lenslet_focal_length_m=46.7e-3,
        wavelength_m=462e-9,
        pixel_pitch_m=16e-6,
    )


def at_views(displacement: Displacement) -> Floats:
    """Displacements at the views, px: (lenslet_row, lenslet_column, view_row, view_column, xy)."""
    values = displacement.modes.values(VIEWS, VIEWS[:, None])
    return np.asarray(np.einsum("rcqd,qyx->rcyxd", displacement.coefficients, values))


def converged(modes: FieldModes, coefficients: Floats, variance: Floats) -> Displacement:
    """Displacements (lenslet_row, lenslet_column, field_mode, xy), px, of lenslets that are all valid."""
    lenslets = coefficients.shape[:2]
    return Displacement(
        modes, coefficients, diagonal_covariance(variance), np.zeros(lenslets, np.int8), *np.zeros((3, *lenslets))
    )


PointValues = Callable[[float, float], Image]  # of an object point (x_m, y_m), at the pupil samples


def phase_only(phase: PointValues) -> PointField:
    """Field of uniform light with a phase at the pupil samples, (sample_row, sample_column), rad."""
    return lambda x_m, y_m: np.exp(1j * phase(x_m, y_m)).astype(np.complex64)


def checkerboard(cells: int = 6, object_samples: int = 24) -> SourcePoints:
    """A square of bright and dark cells, whose inside shows displacements in real light, too."""
    points = source_points("square", Source(), object_samples=object_samples)
    cell = np.floor((points.position_m / FIELD.half_width_m + 1) / 2 * cells * (1 - 1e-9)).astype(int)
    return SourcePoints(position_m=points.position_m, area_m2=points.area_m2 * (cell.sum(axis=1) % 2 == 0))


class SmallBench:
    """A non-square lattice, off centre and turned, on a non-square camera; renders without noise.

    Its source is a uniform square, unless given.
    """

    def __init__(
        self,
        rows: int = 7,
        columns: int = 9,
        rotation_rad: float = 0.004,
        *,
        field: Field = FIELD,
        source: SourcePoints | None = None,
    ) -> None:
        self.field = field
        self.sensor = sensor_of(rows, columns)
        self.frame_shape = (int(rows * 31.25) + 14, int(columns * 31.25) + 30)
        self.lattice = Lattice(
            center_x_px=self.frame_shape[1] / 2 + 2.3,
            center_y_px=self.frame_shape[0] / 2 - 1.4,
            pitch_px=31.25,
            rotation_rad=rotation_rad,
        )
        self.model = ForwardModel(
            self.sensor,
            self.lattice,
            field,
            shape=self.frame_shape,
            pupil_samples=12,
            pixel_fill_factor=1.0,
            border_lenslets=0,
        )
        self.source = source or source_points("square", Source(), object_samples=19)
        self.reference = self.model.irradiance(self.source) * 1e14
        y, x = np.meshgrid(self.sensor.pupil_y_m, self.sensor.pupil_x_m, indexing="ij")
        self.pupil_x_m, self.pupil_y_m = x, y  # of the lenslet centres, (lenslet_row, lenslet_column)

    def frame(self, phase: PointValues, amplitude: PointValues | None = None) -> NDArray[np.float32]:
        """Render the frame behind a phase that each object point sees, phase(x_m, y_m) at the pupil samples.

        In real light a phase that changes over the field gathers light: `amplitude` is sqrt(det(1 + f1/k d2phi/dxdu)).
        """
        wave = phase_only(phase)
        field = wave if amplitude is None else lambda x_m, y_m: amplitude(x_m, y_m) * wave(x_m, y_m)
        return self.model.irradiance(self.source, field) * np.float32(1e14)

    def tilted(self, tilt: float, growth: float) -> tuple[NDArray[np.float32], Floats]:
        """A frame of a tilt that grows with the field's x, rad/m, and the displacements at the views it makes, px."""
        u, v = self.samples()
        half_m = self.field.half_width_m
        frame = self.frame(lambda x, _y: ((tilt + growth * x / half_m) * u + 1000.0 * v).astype(np.float32))
        slopes = np.stack(np.broadcast_arrays(tilt + growth * VIEWS, np.full((3, 3), 1000.0)), axis=-1)
        return frame, slopes / self.sensor.slope_per_px

    def subimages(self) -> ReferenceSubimages:
        """The reference as the methods of registration see it."""
        return ReferenceSubimages(self.reference, sensor=self.sensor, lattice=self.lattice, field=self.field)

    def samples(self) -> tuple[Floats, Floats]:
        """Pupil positions x (1, sample_column) and y (sample_row, 1) at which a phase is asked for."""
        return self.model.sample_x_m[None, :], self.model.sample_y_m[:, None]

    def reconstructor(
        self,
        warp: str = "affine",
        method: str = "modal",
        pupil_modes: int | None = 21,
        sample: SampleModel = "free",
        *,
        noise: CameraNoise | None = None,
        **changes: object,
    ) -> Reconstructor:
        """A reconstructor for this bench; `changes` are other arguments of `Reconstructor`."""
        settings: dict[str, Any] = {
            "reference": self.reference,
            "sensor": self.sensor,
            "lattice": self.lattice,
            "field": self.field,
            "registration": RegistrationSettings(warp=cast("Warp", warp)),
            "reconstruction": ReconstructionSettings(
                method=cast("Literal['zonal', 'modal']", method), pupil_modes=pupil_modes, sample=sample
            ),
            "camera": KnownCamera(noise=KnownNoise(noise)),
        }
        return Reconstructor(**{**settings, **changes})
