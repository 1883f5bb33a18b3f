"""Checks of signs, axes and units with light in closed form, for `svwfs selftest`.

A small non-square lattice, rotated and off centre, is simulated with each light and reconstructed. A wrong sign, axis
or unit gives a scale other than 1 between the result and the phase.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.measurement.calibration import Calibration
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Lattice, Sensor
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from reconstruction.wavefront import rms, without_piston
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.source import source_points
from simulated_devices.settings import Source

SENSOR = Sensor(
    lenslet_rows=5,
    lenslet_columns=7,
    lenslet_pitch_m=500e-6,
    lenslet_focal_length_m=46.7e-3,
    wavelength_m=462e-9,
    pixel_pitch_m=16e-6,
)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
FRAME_SHAPE = (172, 240)
LATTICE = Lattice(center_x_px=121.3, center_y_px=84.6, pitch_px=31.25, rotation_rad=0.003)

_TOLERANCE = 0.1  # far from the -1, 0 or 1.4 of a wrong sign, axis or unit

Complex = NDArray[np.complex64]
Phase = Callable[[Floats, Floats, float, float], Floats]
Intensity = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True, slots=True)
class Known:
    """Light in closed form: phase, rad, of pupil x, y and field x, y, m; intensity, of pupil x, y.

    What stretches a subimage gathers light by the same factor: A^2 = det(1 + (f1 / k) d^2 phi / dx du).
    """

    phase: Phase
    intensity: Intensity = lambda u, v: np.ones(np.broadcast_shapes(u.shape, v.shape))


_TILT_RAD_PER_M = 3000.0
_GROWTH_RAD_PER_M2 = _TILT_RAD_PER_M / FIELD.half_width_m
_BEND_RAD_PER_M3 = 6e5 / FIELD.half_width_m
_GATHERED_M2 = FIELD.collimator_focal_length_m / SENSOR.wavenumber_rad_per_m  # f1 / k

KNOWN: dict[str, Known] = {
    "tilt: light moves to +x": Known(lambda u, _v, _x, _y: _TILT_RAD_PER_M * u),
    "tilt: light moves to +y": Known(lambda _u, v, _x, _y: _TILT_RAD_PER_M * v),
    "defocus": Known(lambda u, v, _x, _y: 4e5 * (u**2 + v**2)),
    "astigmatism, +x against +y": Known(lambda u, v, _x, _y: 4e5 * (u**2 - v**2)),
    "tilt x that grows along field +x": Known(
        lambda u, _v, x, _y: _GROWTH_RAD_PER_M2 * u * x,
        lambda u, v: np.full(np.broadcast_shapes(u.shape, v.shape), 1 + _GATHERED_M2 * _GROWTH_RAD_PER_M2),
    ),
    # Layers that make the defocus also make astigmatism along the other axis.
    "defocus grows along field +y": Known(
        lambda u, v, x, y: _BEND_RAD_PER_M3 * ((u**2 + v**2) * y + 2 * u * v * x),
        lambda u, v: (
            (1 + 2 * _GATHERED_M2 * _BEND_RAD_PER_M3 * v) ** 2 - (2 * _GATHERED_M2 * _BEND_RAD_PER_M3 * u) ** 2
        ),
    ),
}


@dataclass(frozen=True, slots=True)
class PhaseCheck:
    """Comparison of one known phase with its reconstruction."""

    name: str
    rms_rad: float  # of the phase, over all views and lenslets
    scale: float  # measured over true phase; 1 is right
    residual_rad: float  # RMS of measured minus true phase

    @property
    def passes(self) -> bool:
        """True if sign, axis and unit are right; diffraction reduces variations over the field by up to 6 %."""
        return abs(self.scale - 1) < _TOLERANCE and self.residual_rad < _TOLERANCE * self.rms_rad


def run_checks() -> Iterator[PhaseCheck]:
    """Render and reconstruct every light."""
    model = ForwardModel(SENSOR, LATTICE, FIELD, shape=FRAME_SHAPE, pupil_samples=12, pixel_fill_factor=1.0)
    source = source_points("square", Source(), object_samples=25)
    bench = Bench(
        sensor=SENSOR,
        field=FIELD,
        registration=RegistrationSettings(warp="affine"),
        reconstruction=ReconstructionSettings(pupil_modes=6),
    )
    reconstructor = Calibration.of_images(bench, model.irradiance(source), lattice=LATTICE).reconstructor()
    v, u = np.meshgrid(SENSOR.pupil_y_m, SENSOR.pupil_x_m, indexing="ij")  # of the lenslet centres
    sample_x_m, sample_y_m = model.sample_x_m[None, :], model.sample_y_m[:, None]
    for name, known in KNOWN.items():
        amplitude = np.sqrt(known.intensity(sample_x_m, sample_y_m))

        def of_point(x_m: float, y_m: float, phase: Phase = known.phase, by: Floats = amplitude) -> Complex:
            return np.asarray(by * np.exp(1j * phase(sample_x_m, sample_y_m, x_m, y_m)), np.complex64)

        at_views = [[known.phase(u, v, x_m, y_m) for x_m in FIELD.view_x_m] for y_m in FIELD.view_y_m]
        truth, measured = without_piston(np.array(at_views)), reconstructor(model.irradiance(source, of_point)).views
        yield PhaseCheck(
            name=name,
            rms_rad=float(np.sqrt(np.mean(truth**2))),
            scale=float(np.sum(truth * measured) / np.sum(truth**2)),
            residual_rad=float(np.sqrt(np.mean(rms(measured - truth) ** 2))),
        )
