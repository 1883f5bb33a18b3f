"""Fisher information, against finite differences of the exact forward model and against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import legendre as series
from support.optics import sensor_of

from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise
from reconstruction.geometry import Field, Lattice
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.quality.information import layered_information, lenslet_information, wavefront_bound
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import SourcePoints

CELL_PX, SAMPLES = 31, 12
SENSOR = replace(sensor_of(2, 3), pixel_pitch_m=500e-6 / CELL_PX)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, view_rows=3, view_columns=3, view_spacing_m=0.5e-3)
NOISE = CameraNoise(counts_per_electron=0.5, read_noise_counts=3.0)
# Counts of each lenslet: very different, similar, and none.
LIGHT = np.array([[2e4, 2.02e4, 5e5], [1.98e4, 3e3, 0.0]])
MODES, FIELD_MODES = pupil_modes(SENSOR, "legendre", 10), LegendreModes(6)
STEP_RAD = 0.02


def uneven_source() -> SourcePoints:
    along_m = np.linspace(-1, 1, 9) * FIELD.half_width_m
    y_m, x_m = (grid.ravel() for grid in np.meshgrid(along_m, along_m, indexing="ij"))
    brightness = np.random.default_rng(1).uniform(0.2, 1.0, x_m.size)
    return SourcePoints(position_m=np.stack([x_m, y_m], axis=-1), area_m2=brightness / brightness.sum())


SOURCE = uneven_source()
MODEL = LensletImage(SENSOR, FIELD, SOURCE, width=CELL_PX, pupil_samples=SAMPLES, pixel_fill_factor=1.0)


@pytest.mark.parametrize("neglect_propagation", [False, True])
def test_information_matches_finite_differences_of_forward_model(neglect_propagation: bool) -> None:
    field = replace(FIELD, neglect_propagation=neglect_propagation)
    model = LensletImage(SENSOR, field, SOURCE, width=CELL_PX, pupil_samples=SAMPLES, pixel_fill_factor=1.0)
    information, basis = layered_information(model, LIGHT, NOISE, sensor=SENSOR, modes=MODES, field_modes=FIELD_MODES)
    some = np.random.default_rng(2).standard_normal((information.shape[0], 3))  # combinations of the basis
    coefficients = basis @ some  # (pupil_mode - 1, field_mode, 3)
    rows, columns = (CELL_PX * count for count in LIGHT.shape)
    exact = ForwardModel(
        SENSOR,
        Lattice(center_x_px=(columns - 1) / 2, center_y_px=(rows - 1) / 2, pitch_px=CELL_PX),
        FIELD,
        shape=(rows, columns),
        pupil_samples=SAMPLES,
        pixel_fill_factor=1.0,
        border_lenslets=0,
    )
    half_x_m, half_y_m = SENSOR.pupil_half_width_m

    def cells(coefficient: np.ndarray) -> np.ndarray:
        """Counts of every lenslet, (lenslet, pixel)."""

        def light(x_m: float, y_m: float) -> np.ndarray:
            x, y = x_m / FIELD.half_width_m, y_m / FIELD.half_width_m
            along = exact.sample_y_m / half_y_m, exact.sample_x_m / half_x_m
            products = np.tensordot(coefficient.T, MODES.products[1:], axes=1)  # (field_mode, n, m)
            phase = series.leggrid2d(*along, np.tensordot(FIELD_MODES.values(x, y), products, axes=1))
            if neglect_propagation:
                return np.asarray(np.exp(1j * phase), np.complex64)
            slopes = FIELD_MODES.gradients(x, y) / FIELD.half_width_m  # (field_mode, xy)
            of_u, of_v = (
                series.leggrid2d(*along, np.moveaxis(series.legder(products, axis=axis), 0, -1)) / half_m
                for axis, half_m in ((2, half_x_m), (1, half_y_m))
            )  # (field_mode, y, x)
            stretch = np.tensordot(slopes.T, np.stack([of_u, of_v], axis=1), axes=1)  # (xy, uv, y, x)
            stretch = (
                np.eye(2)[..., None, None] + stretch * FIELD.collimator_focal_length_m / SENSOR.wavenumber_rad_per_m
            )
            determinant = stretch[0, 0] * stretch[1, 1] - stretch[0, 1] * stretch[1, 0]
            return np.asarray(np.sqrt(determinant) * np.exp(1j * phase), np.complex64)

        frame = exact.irradiance(SOURCE, light).astype(np.float64)
        frame = frame.reshape(LIGHT.shape[0], CELL_PX, LIGHT.shape[1], CELL_PX).transpose(0, 2, 1, 3)
        return np.asarray(frame.reshape(LIGHT.size, -1) * LIGHT.reshape(-1, 1))

    at_rest = cells(np.zeros(coefficients.shape[:2]))
    variance = 0.5 * at_rest + 9.0
    changes = np.stack(
        [
            (cells(STEP_RAD * each) - cells(-STEP_RAD * each)) / (2 * STEP_RAD)
            for each in np.moveaxis(coefficients, 2, 0)
        ]
    )
    expected = np.zeros((3, 3))
    for lenslet in range(LIGHT.size):
        known = np.stack([at_rest[lenslet], np.ones(CELL_PX**2)], axis=1)
        inverse = np.diag(1 / variance[lenslet])
        of_all = np.concatenate([changes[:, lenslet].T, known], axis=1)
        fisher = of_all.T @ inverse @ of_all
        if LIGHT.flat[lenslet]:  # the Schur complement: gain and offset are unknown
            fisher = fisher[:3, :3] - fisher[:3, 3:] @ np.linalg.solve(fisher[3:, 3:], fisher[3:, :3])
            expected += fisher
    size = np.sqrt(np.diag(expected))
    assert np.abs(some.T @ information @ some - expected) / np.outer(size, size) == pytest.approx(0, abs=0.005)


def test_brightness_and_offset_carry_no_information() -> None:
    light = np.random.default_rng(3).uniform(10, 100, (5, 5))
    ramp = np.outer(np.ones(5), np.arange(5.0))
    changes = np.stack([light, 2 * light - 3, ramp, ramp + 7 - light])[:, None]
    information = lenslet_information(light, changes, NOISE, light[None])[:, 0, :, 0]
    assert information[:2] == pytest.approx(0, abs=1e-9)
    assert information[2, 2] > 1
    assert information[3, 3] == pytest.approx(information[2, 2])
    varied = np.stack([light, light * ramp])
    less = lenslet_information(light, np.concatenate([changes, (3 * varied[1:])[:, None]]), NOISE, varied)[:, 0, :, 0]
    assert less[4] == pytest.approx(0, abs=1e-9)
    assert 0 < less[2, 2] < information[2, 2]


def test_bound_falls_with_the_root_of_shot_noise_light() -> None:
    noise = replace(NOISE, read_noise_counts=0.0)

    def bound(factor: float) -> np.ndarray:
        found = layered_information(
            MODEL,
            np.full((2, 3), 1e4 * factor),
            noise,
            sensor=SENSOR,
            modes=pupil_modes(SENSOR, "legendre", 3),
            field_modes=LegendreModes(3),
        )
        return wavefront_bound(*found, FIELD, pupil_modes(SENSOR, "legendre", 3), LegendreModes(3))

    once, hundredfold = bound(1.0), bound(100.0)
    assert once.shape == (3, 3, 2, 3)
    assert hundredfold == pytest.approx(once / 10)


def test_frame_without_light_has_no_bound() -> None:
    information, basis = layered_information(
        MODEL, np.zeros((2, 3)), NOISE, sensor=SENSOR, modes=MODES, field_modes=FIELD_MODES
    )
    with pytest.raises(ReconstructionError, match="no information about some of the wavefronts"):
        wavefront_bound(information, basis, FIELD, MODES, FIELD_MODES)
