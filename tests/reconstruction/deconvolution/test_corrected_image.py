"""Corrected images: which pixels, which way round, and refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from support.optics import sensor_of

from reconstruction.deconvolution.corrected_image import CorrectedImage, corrected_image
from reconstruction.deconvolution.imaging import Imaging
from reconstruction.geometry import Field

SENSOR = sensor_of(15, 15)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.3e-3, view_spacing_m=0.2e-3)
PIXEL_M = 5e-6
U, V = np.meshgrid(SENSOR.pupil_x_m, SENSOR.pupil_y_m)
TILT = PIXEL_M / FIELD.collimator_focal_length_m * SENSOR.wavenumber_rad_per_m  # rad/m that moves light by a pixel
STARS = {(52, 44): 900.0, (70, 91): 700.0, (90, 66): 1000.0}  # row, column: brightness
SHAPE = (141, 151)


def stars(offset: tuple[int, int] = (0, 0)) -> np.ndarray[Any, Any]:
    image = np.zeros(SHAPE)
    for (row, column), light in STARS.items():
        image[row + offset[0], column + offset[1]] = light
    return np.asarray(ndimage.gaussian_filter(image, 1.2) + 1.0)


def corrected(image: Any, phase_at: Any, **changes: Any) -> CorrectedImage:
    imaging = Imaging(**{"pixel_m": PIXEL_M, "counts_per_electron": 1.0, **changes})
    return corrected_image(
        image, phase_at, imaging, sensor=SENSOR, field=FIELD, method="richardson-lucy", iterations=15
    )


def peaks(image: Any) -> set[tuple[int, int]]:
    found = ndimage.maximum_filter(image, 9) == image
    return {(int(row), int(column)) for row, column in np.argwhere(found & (image > 20))}


@pytest.mark.parametrize(
    ("changes", "offset"),
    [
        ({}, (2, 6)),
        ({"is_mirrored": True}, (2, -6)),
        ({"rotation_rad": np.pi / 2}, (6, -2)),
        ({"rotation_rad": np.pi}, (-2, -6)),
    ],
)
def test_light_returns_to_where_it_came_from(changes: dict[str, Any], offset: tuple[int, int]) -> None:
    """A tilt of 6 px towards the field's +x and 2 px towards its +y is undone in the image's own directions."""
    made = corrected(stars(offset), lambda *_: TILT * (6 * U + 2 * V), **changes)
    assert peaks(made.image) == set(STARS)


@pytest.mark.slow
def test_tilt_that_grows_over_the_field_is_undone_at_its_own_side() -> None:
    """Light at the field's +x edge moves by +6 px, at its -x edge by -6 px; mirrored or swapped it would not return."""
    image = np.ones(SHAPE)
    for (row, column), light in STARS.items():
        moved = column + 6 * (column - 75) * PIXEL_M / FIELD.half_width_m
        image += light * np.exp(-((np.arange(151) - moved) ** 2 + (np.arange(141)[:, None] - row) ** 2) / 3)
    made = corrected(image, lambda x, _y: TILT * 6 * x / FIELD.half_width_m * U)
    assert peaks(made.image) == set(STARS)


def test_pixels_outside_the_field_are_untouched_and_marked() -> None:
    image = np.random.default_rng(1).poisson(stars()).astype(np.uint16)
    made = corrected(image, lambda *_: 0.1e6 * (U**2 + V**2), center_x_px=70.0, center_y_px=80.0)
    expected = np.zeros(SHAPE, np.bool_)
    expected[20:141, 10:131] = True  # 60 pixels to each side, and the middle one
    np.testing.assert_array_equal(made.inside, expected)
    np.testing.assert_array_equal(made.image[~expected], image[~expected])
    assert np.mean(made.image[expected] != image[expected]) > 0.9
    assert made.image.dtype == np.float32


def test_round_field_is_a_disc() -> None:
    round_field = Field(collimator_focal_length_m=0.2, half_width_m=0.3e-3, view_spacing_m=0.2e-3, shape="circle")
    asked: list[float] = []

    def phase_at(x_m: float, y_m: float) -> Any:
        asked.append(float(np.hypot(x_m, y_m)))
        return 0.1e6 * (U**2 + V**2)

    imaging = Imaging(pixel_m=PIXEL_M, counts_per_electron=1.0)
    made = corrected_image(
        stars(), phase_at, imaging, sensor=SENSOR, field=round_field, method="richardson-lucy", iterations=2
    )
    y, x = np.indices(SHAPE)
    np.testing.assert_array_equal(made.inside, np.hypot(x - 75, y - 70) <= 60)
    assert max(asked) <= 0.3e-3 * (1 + 1e-9)


def test_fine_pixels_are_binned_and_light_is_kept() -> None:
    """Pixels of 1/10 of the resolution are binned by 2; the picture stays where it is."""
    fine = ndimage.zoom(stars((2, 6)), 4, order=1, grid_mode=True, mode="nearest")
    made = corrected(fine, lambda *_: TILT * (6 * U + 2 * V), pixel_m=PIXEL_M / 4)
    inner = np.ascontiguousarray(made.image[80:-80, 80:-80])
    center = ndimage.center_of_mass(inner - 1.0)
    at, light = np.array(list(STARS)), np.array(list(STARS.values()))
    expected = 4 * (light @ at / light.sum()) + 1.5 - 80
    np.testing.assert_allclose(center, expected, atol=0.5)
    assert inner.sum() == pytest.approx(fine[80:-80, 80:-80].sum(), rel=0.02)


def test_dark_is_subtracted_and_added_again() -> None:
    without = corrected(stars(), lambda *_: 0.1e6 * (U**2 + V**2))
    with_dark = corrected(stars() + 100, lambda *_: 0.1e6 * (U**2 + V**2), dark_counts=100.0)
    np.testing.assert_allclose(with_dark.image, without.image + 100, rtol=1e-4, atol=0.02)


def test_wiener_restores_what_lucy_does() -> None:
    image = np.random.default_rng(1).poisson(stars() + 20).astype(np.float64)
    imaging = Imaging(pixel_m=PIXEL_M, counts_per_electron=1.0)
    made = corrected_image(
        image, lambda *_: 0.15e6 * (U**2 + V**2), imaging, sensor=SENSOR, field=FIELD, method="wiener", iterations=60
    )
    assert made.chi_square <= 1
    assert made.image.max() > 1.2 * image.max()


def test_nan_is_refused() -> None:
    image = stars()
    image[3, 4] = np.nan
    with pytest.raises(ValueError, match="image holds NaN"):
        corrected(image, lambda *_: 0 * U)


def test_image_without_light_is_refused() -> None:
    with pytest.raises(ValueError, match="image shows no light: no pixel is above dark_counts = 100"):
        corrected(np.full_like(stars(), 100.0), lambda *_: 0 * U, dark_counts=100.0)


def test_field_beside_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match=r"field covers 0 x 0 pixels .* check pixel_m, center_x_px"):
        corrected(stars(), lambda *_: 0 * U, center_x_px=1000.0)


def test_point_wider_than_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match=r"blurs over 5\.\d+e\+03 pixels, .*: check pixel_m, wavelength_m"):
        corrected(stars(), lambda *_: 0 * U, wavelength_m=1e-3)


def test_read_noise_needs_the_gain() -> None:
    with pytest.raises(ValueError, match="read_noise_counts needs counts_per_electron, too"):
        Imaging(pixel_m=PIXEL_M, read_noise_counts=2.0)


def test_unknown_wavefront_is_refused() -> None:
    with pytest.raises(ValueError, match="wavefront is unknown in a part of the field"):
        corrected(stars(), lambda x, _y: 0 * U + (np.nan if x > 0 else 0))


def test_wiener_without_noise_is_refused() -> None:
    imaging = Imaging(pixel_m=4 * PIXEL_M)  # too coarse to show noise
    with pytest.raises(ValueError, match="Wiener filter needs the noise"):
        corrected_image(stars(), lambda *_: 0 * U, imaging, sensor=SENSOR, field=FIELD, method="wiener", iterations=9)
