"""Image of one lenslet and its derivatives against the forward model, and against the shift of its object points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import legendre as series
from numpy.typing import NDArray
from support.optics import FIELD, PAPER, checkerboard, sensor_of

from reconstruction.arrays import Floats, Image
from reconstruction.geometry import Field, Lattice, Sensor
from reconstruction.modes.field_modes import LegendreModes
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import SourcePoints

SENSOR = sensor_of(2, 2)
HEXAGONAL = replace(SENSOR, arrangement="hexagonal")
SENSORS = pytest.mark.parametrize("sensor", [SENSOR, HEXAGONAL], ids=["square", "hexagonal"])
WIDTH, PITCH_PX, SAMPLES = 27, 31.25, 12
GENERATOR = np.random.default_rng(0)
SOURCE = SourcePoints(
    position_m=np.concatenate([GENERATOR.uniform(-0.6e-3, 0.6e-3, (8, 2)), np.zeros((1, 2))]),
    area_m2=np.r_[GENERATOR.uniform(0.2, 1.0, 8), 0.0],  # the last point is dark
)
MODES = LegendreModes(3)


def forward_model(fill_factor: float, sensor: Sensor) -> ForwardModel:
    """Two by two lenslets, of which the first one's axis is in the middle of the window."""
    x, y = (0.5, 0.5) if sensor is SENSOR else (0.75, 3**0.5 / 4)  # pitches to the middle of the lattice
    middle_px = (WIDTH - 1) / 2
    return ForwardModel(
        sensor,
        Lattice(
            center_x_px=middle_px + x * PITCH_PX,
            center_y_px=middle_px + y * PITCH_PX,
            pitch_px=PITCH_PX,
            arrangement=sensor.arrangement,
        ),
        FIELD,
        shape=(WIDTH, WIDTH),
        pupil_samples=SAMPLES,
        pixel_fill_factor=fill_factor,
        border_lenslets=0,
    )


def lenslet_image(
    fill_factor: float = 1.0, source: SourcePoints = SOURCE, sensor: Sensor = SENSOR, field: Field = FIELD
) -> LensletImage:
    return LensletImage(sensor, field, source, width=WIDTH, pupil_samples=SAMPLES, pixel_fill_factor=fill_factor)


@SENSORS
@pytest.mark.parametrize("fill_factor", [0.0, 0.6, 1.0])
def test_image_is_that_of_the_forward_model(fill_factor: float, sensor: Sensor) -> None:
    expected = forward_model(fill_factor, sensor).irradiance(SOURCE)
    np.testing.assert_allclose(lenslet_image(fill_factor, sensor=sensor).image(), expected, atol=2e-6 * expected.max())


@SENSORS
@pytest.mark.parametrize("field", [FIELD, PAPER], ids=["real light", "paper"])
@pytest.mark.parametrize("own", [None, (2, 1)])
def test_derivatives_are_those_of_the_forward_model(field: Field, sensor: Sensor, own: tuple[int, int] | None) -> None:
    """In real light the field's square is multiplied by 1 + f1/k (dT/dx dP/du + dT/dy dP/dv).

    The lenslet's `own` wavefront changes no light.
    """
    model, image = forward_model(0.6, sensor), lenslet_image(0.6, sensor=sensor, field=field)
    found = image.derivatives(4, MODES.values(*image.position.T), MODES.gradients(*image.position.T), own)
    assert found.shape == (5, 5, 3, WIDTH, WIDTH)
    half_m = 250e-6 if sensor is SENSOR else 500e-6 / 3**0.5
    middle_m = sensor.lenslet_centers_m[0, 0]
    xi, eta = (
        (at - middle) / half_m for at, middle in zip((model.sample_x_m, model.sample_y_m), middle_m, strict=True)
    )
    along_x, along_y = (series.legvander(at, 4).T for at in (xi, eta))
    slope_x, slope_y = (series.legval(at, series.legder(np.eye(5))) for at in (xi, eta))
    gathered = 0.2 / sensor.wavenumber_rad_per_m / 0.6e-3 / half_m
    amplitude, own_amplitude, largest = 0.03, 0.1, np.abs(found).max()

    def image_of(n: int, m: int, q: int, rad: float, own_rad: float) -> Image:
        def light(x_m: float, y_m: float) -> NDArray[np.complex64]:
            x, y = x_m / field.half_width_m, y_m / field.half_width_m
            wave = np.exp(1j * rad * MODES.values(x, y)[q] * np.outer(along_y[n], along_x[m]))
            if not field.neglect_propagation:
                of_x, of_y = MODES.gradients(x, y)[q]
                slope = of_x * np.outer(along_y[n], slope_x[m]) + of_y * np.outer(slope_y[n], along_x[m])
                wave *= np.sqrt(np.maximum(1 + rad * gathered * slope, 0))  # below 0 on other lenslets only
            if own is not None:
                wave *= np.exp(1j * own_rad * np.outer(along_y[own[0]], along_x[own[1]]))
            return np.asarray(wave, np.complex64)

        return model.irradiance(SOURCE, light)

    for n, m, q in np.ndindex(5, 5, 3):
        if m + n > 4:
            assert not found[n, m, q].any()
            continue
        change = np.zeros((WIDTH, WIDTH))
        for sign, own_sign in [(1, 1), (-1, 1)] if own is None else [(1, 1), (-1, 1), (1, -1), (-1, -1)]:
            rendered = image_of(n, m, q, sign * amplitude, own_sign * own_amplitude)
            change += sign * (1 if own is None else own_sign / (2 * own_amplitude)) * rendered / (2 * amplitude)
        np.testing.assert_allclose(found[n, m, q], change, atol=(1e-3 if own is None else 3e-3) * largest)


@pytest.mark.parametrize(("n", "m"), [(0, 1), (1, 0)])
def test_tilt_moves_light_like_its_object_points(n: int, m: int) -> None:
    """A tilt of 1 rad at the lenslet's edge is that of a point farther along the axis by f1 / (k D / 2)."""
    image = lenslet_image()
    tilt = image.derivatives(1, np.ones((1, 8)), np.zeros((1, 8, 2)))[n, m, 0]
    per_rad_m = FIELD.collimator_focal_length_m / (SENSOR.wavenumber_rad_per_m * SENSOR.lenslet_pitch_m / 2)
    step = 1e-3

    def moved(rad: float) -> Floats:
        position_m = SOURCE.position_m + rad * per_rad_m * np.array([m, n])
        return lenslet_image(source=SourcePoints(position_m=position_m, area_m2=SOURCE.area_m2)).image()

    expected = (moved(step) - moved(-step)) / (2 * step)
    np.testing.assert_allclose(tilt, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(("field", "of_middle"), [(FIELD, 0.0), (PAPER, -1.0)], ids=["real light", "paper"])
def test_stretched_square_keeps_its_brightness_only_in_real_light(field: Field, of_middle: float) -> None:
    """A tilt that grows along x stretches the square; with conserved flux its brightness falls by as much."""
    bright = checkerboard(cells=1, object_samples=37)
    image = LensletImage(SENSOR, field, bright, width=WIDTH, pupil_samples=SAMPLES, pixel_fill_factor=1.0)
    x = image.position[:, :1].T
    stretch = image.derivatives(1, x, np.eye(1, 2) + 0 * image.position[None])[0, 1, 0]
    middle = WIDTH // 2
    per_rad = FIELD.collimator_focal_length_m / SENSOR.wavenumber_rad_per_m / FIELD.half_width_m / (500e-6 / 2)
    change = stretch[middle - 3 : middle + 4, middle - 3 : middle + 4] / image.image()[middle, middle]
    assert change.mean() == pytest.approx(of_middle * per_rad, abs=0.06 * per_rad)  # diffraction at the edges


def test_light_is_the_area_of_the_points() -> None:
    point = SourcePoints(position_m=np.zeros((1, 2)), area_m2=np.array([3.0]))
    image = LensletImage(SENSOR, FIELD, point, width=WIDTH, pupil_samples=60, pixel_fill_factor=1.0).image()
    # On each axis, diffraction by a square leaves about 1 / (pi^2 m) of the light beyond m zeros on both sides.
    zeros = WIDTH / 2 / (SENSOR.wavelength_m * SENSOR.lenslet_focal_length_m / SENSOR.lenslet_pitch_m / 16e-6)
    assert image.sum() == pytest.approx(3.0 * (1 - 1 / (np.pi**2 * zeros)) ** 2, rel=0.004)
