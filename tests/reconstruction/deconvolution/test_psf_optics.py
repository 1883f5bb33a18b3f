"""Point-spread functions of images: closed forms of the pupil, directions, and another simulator."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import special
from support.optics import sensor_of

from reconstruction.deconvolution.corrected_image import PsfOptics, psf_reach_px
from reconstruction.deconvolution.imaging import Imaging
from reconstruction.geometry import Field
from studies.photograph import true_psf

SENSOR = sensor_of(11, 15)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
PIXEL_M = 3e-6
FLAT = np.zeros((11, 15))
U, V = np.meshgrid(SENSOR.pupil_x_m, SENSOR.pupil_y_m)
REACH = 24


def psf(phase: np.ndarray[Any, Any], reach: int = REACH, **changes: Any) -> np.ndarray[Any, Any]:
    return PsfOptics(Imaging(**{"pixel_m": PIXEL_M, **changes}), SENSOR, FIELD, reach)(phase)


def test_lattice_without_aberration_is_the_product_of_sinc_patterns() -> None:
    angle = np.arange(-REACH, REACH + 1) * PIXEL_M / FIELD.collimator_focal_length_m / SENSOR.wavelength_m
    expected = np.sinc(5.5e-3 * angle)[:, None] ** 2 * np.sinc(7.5e-3 * angle) ** 2
    np.testing.assert_allclose(psf(FLAT), expected / expected.sum(), atol=1e-3 * expected.max() / expected.sum())


@pytest.mark.parametrize("round_pupil", [{"pupil_diameter_m": 5e-3}, {"numerical_aperture": 0.0125}])
def test_round_pupil_without_aberration_is_the_airy_pattern(round_pupil: dict[str, Any]) -> None:
    at = np.arange(-REACH, REACH + 1) * PIXEL_M / FIELD.collimator_focal_length_m
    v = np.pi * 5e-3 / SENSOR.wavelength_m * np.hypot(at, at[:, None])
    expected = np.where(v == 0, 1, 2 * special.j1(v) / np.where(v == 0, 1, v)) ** 2
    np.testing.assert_allclose(
        psf(FLAT, **round_pupil), expected / expected.sum(), atol=3e-3 * expected.max() / expected.sum()
    )


def test_longer_wavelength_widens_the_pattern() -> None:
    twice = psf(FLAT, wavelength_m=2 * SENSOR.wavelength_m, pixel_m=2 * PIXEL_M)
    np.testing.assert_allclose(twice, psf(FLAT), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "direction"),
    [
        ({}, (1.0, 0.5)),
        ({"is_mirrored": True}, (-1.0, 0.5)),
        ({"rotation_rad": np.pi / 2}, (-0.5, 1.0)),  # the field's x axis is the image's y axis
        ({"rotation_rad": np.pi / 2, "is_mirrored": True}, (0.5, 1.0)),
    ],
)
def test_positive_slope_moves_light_towards_positive_field_positions(
    changes: dict[str, Any], direction: tuple[float, float]
) -> None:
    slope = 8 * PIXEL_M / FIELD.collimator_focal_length_m * SENSOR.wavenumber_rad_per_m  # 8 px along x, 4 along y
    row, column = np.unravel_index(np.argmax(psf(slope * (U + 0.5 * V), **changes)), (2 * REACH + 1,) * 2)
    assert (int(column) - REACH, int(row) - REACH) == (8 * direction[0], 8 * direction[1])


def test_tilt_at_another_wavelength_moves_light_as_far() -> None:
    slope = 8 * PIXEL_M / FIELD.collimator_focal_length_m * SENSOR.wavenumber_rad_per_m
    row, column = np.unravel_index(np.argmax(psf(slope * U, wavelength_m=633e-9)), (2 * REACH + 1,) * 2)
    assert (int(column) - REACH, int(row) - REACH) == (8, 0)


def test_aberrated_pattern_is_that_of_another_simulator() -> None:
    square = replace(SENSOR, lenslet_rows=15)
    x, y = np.meshgrid(square.pupil_x_m, square.pupil_y_m)

    def phase(x_m: Any, y_m: Any) -> Any:
        x_mm, y_mm = x_m * 1e3, y_m * 1e3
        return 0.3 * x_mm**2 - 0.1 * x_mm * y_mm + 0.05 * y_mm**3 + 0.2 * x_mm

    reach = psf_reach_px(Imaging(pixel_m=PIXEL_M), square, FIELD, phase(x, y))
    ours = PsfOptics(Imaging(pixel_m=PIXEL_M), square, FIELD, reach)(phase(x, y))
    theirs = true_psf(
        lambda x_m, y_m: np.exp(1j * phase(x_m[None, :], y_m[:, None])),
        pixel_rad=PIXEL_M / FIELD.collimator_focal_length_m,
        wavelength_m=square.wavelength_m,
        pupil_width_m=7.5e-3,
        reach_px=reach,
    )
    assert np.linalg.norm(ours - theirs) < 0.01 * np.linalg.norm(theirs)
    assert np.linalg.norm(ours[:, ::-1] - theirs) > 0.3 * np.linalg.norm(theirs)
    assert np.linalg.norm(ours.T - theirs) > 0.3 * np.linalg.norm(theirs)


def test_coarse_pixels_hold_the_mean_over_their_area() -> None:
    coarse, fine = psf(FLAT, 8, pixel_m=9 * PIXEL_M), psf(FLAT, 76)  # 17 x 17 pixels of 9 x 9
    binned = fine.reshape(17, 9, 17, 9).sum(axis=(1, 3))
    np.testing.assert_allclose(coarse, binned, atol=0.01 * binned.max())


def test_reach_holds_nearly_all_light() -> None:
    phase = 2.0 * (U**2 - V**2) * 1e6 / 4 + 0.5 * (U * 1e3) ** 3 / 3
    reach = psf_reach_px(Imaging(pixel_m=PIXEL_M), SENSOR, FIELD, phase)
    wide = psf(phase, 3 * reach)
    assert wide[2 * reach : 4 * reach + 1, 2 * reach : 4 * reach + 1].sum() > 0.97


def test_pupil_beyond_the_lattice_is_refused() -> None:
    with pytest.raises(ValueError, match=r"imaging pupil of 6 mm is wider than the lattice of 5\.5 mm"):
        psf(FLAT, pupil_diameter_m=6e-3)


def test_hexagonal_lenslets_give_the_same_pattern_as_square_ones() -> None:
    def curved(u: np.ndarray[Any, Any], v: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.asarray(6e5 * u**2 - 4e5 * u * v + 3e5 * v**2 + 900 * u - 600 * v)

    imaging = Imaging(pixel_m=PIXEL_M, pupil_diameter_m=4.5e-3)
    hexagonal = replace(sensor_of(13, 11), arrangement="hexagonal")
    found = PsfOptics(imaging, hexagonal, FIELD, REACH)(curved(*np.moveaxis(hexagonal.lenslet_centers_m, -1, 0)))
    expected = PsfOptics(imaging, SENSOR, FIELD, REACH)(curved(U, V))
    np.testing.assert_allclose(found, expected, atol=5e-3 * expected.max())
