"""The forward model against a plain, slow Fourier sum, and against closed forms of optics."""

from __future__ import annotations

import _thread
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.optics import FIELD, sensor_of
from support.posix import press_ctrl_c

from reconstruction.arrays import Floats, PointField
from reconstruction.geometry import Arrangement, Lattice
from simulated_devices.optics import source
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.phase_screen import PhaseScreen, smooth_screen
from simulated_devices.optics.screen_light import RayMap, ScreenLight
from simulated_devices.optics.source import SourcePoints
from simulated_devices.sample import point_field
from simulated_devices.settings import Source

SENSOR = sensor_of(7, 9)
LATTICE = Lattice(center_x_px=151.3, center_y_px=118.9, pitch_px=31.25, rotation_rad=0.03)
ROWS, COLUMNS = 240, 300
SAMPLES = 12
RAY_MAP = RayMap.near_pupil(distance_m=0.195, collimator_focal_length_m=0.2)
POINTS = SourcePoints(
    position_m=np.array([[0.2e-3, -0.45e-3], [0.2e-3, 0.1e-3], [-0.55e-3, 0.3e-3]]),
    area_m2=np.array([1.0, 0.5, 2.0]) * 1e-9,
)


def model(lattice: Lattice = LATTICE, **changes: float) -> ForwardModel:
    options: dict[str, object] = {
        "shape": (ROWS, COLUMNS),
        "pupil_samples": SAMPLES,
        "pixel_fill_factor": 0.0,
        "border_lenslets": 0,
    }
    return ForwardModel(SENSOR, lattice, FIELD, **(options | changes))  # type: ignore[arg-type] # options by name


def behind(model: ForwardModel, screen: PhaseScreen, shift_m: tuple[float, float] = (0.0, 0.0)) -> PointField:
    """Field of a screen without propagation."""
    return point_field(ScreenLight(screen, None, RAY_MAP), model.sample_x_m, model.sample_y_m, shift_m)


def screen() -> PhaseScreen:
    generator = np.random.default_rng(3)
    samples = smooth_screen(generator, samples=241, sample_spacing_m=25e-6, correlation_length_m=0.8e-3)
    return PhaseScreen(samples * (6.0 / samples.std()), 25e-6)


def direct_irradiance(
    phase_screen: PhaseScreen,
    points: SourcePoints,
    offset_px: tuple[float, float] = (0.0, 0.0),
    lattice: Lattice = LATTICE,
) -> Floats:
    """Every pixel's Fourier sum written out, one lenslet and one object point after the other, beside the centre."""
    total = np.zeros((ROWS, COLUMNS))
    cosine, sine = math.cos(lattice.rotation_rad), math.sin(lattice.rotation_rad)
    k, f = 2 * math.pi / SENSOR.wavelength_m, SENSOR.lenslet_focal_length_m
    local = (np.arange(SAMPLES) + 0.5) / SAMPLES * 500e-6 - 250e-6
    row, column = np.mgrid[:ROWS, :COLUMNS].astype(float)

    def in_lattice_px(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        x, y = x - lattice.center_x_px, y - lattice.center_y_px
        return cosine * x + sine * y, -sine * x + cosine * y

    x_px, y_px = in_lattice_px(column, row)
    for i in range(SENSOR.lenslets[0]):
        for j in range(SENSOR.lenslets[1]):
            u, v = (j - 4) * 500e-6, (i - 3) * 500e-6
            here = (np.abs(x_px / 31.25 - (j - 4)) < 0.5) & (np.abs(y_px / 31.25 - (i - 3)) < 0.5)
            for (x_o, y_o), area in zip(points.position_m, points.area_m2, strict=True):
                phase = phase_screen.at(u + local[None, :] - 0.975 * x_o, v + local[:, None] - 0.975 * y_o)
                phase = phase + k / 0.2 * (local[None, :] * x_o + local[:, None] * y_o)
                x, y = in_lattice_px(column[here] + offset_px[0], row[here] + offset_px[1])
                x, y = (x - (j - 4) * 31.25) * 16e-6, (y - (i - 3) * 31.25) * 16e-6
                along_x = np.exp(-1j * k / f * np.outer(local, x))
                along_y = np.exp(-1j * k / f * np.outer(local, y))
                amplitude = np.einsum("vp,vu,up->p", along_y, np.exp(1j * phase), along_x, optimize=True)
                total[here] += area * np.abs(amplitude) ** 2
    period = SENSOR.wavelength_m * f * SAMPLES / 500e-6
    return total * (16e-6 / period) ** 2 / SAMPLES**2


def test_agrees_with_the_plain_fourier_sum() -> None:
    phase_screen = screen()
    fast = model()
    image = fast.irradiance(POINTS, behind(fast, phase_screen))
    truth = direct_irradiance(phase_screen, POINTS)
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, truth, rtol=0, atol=1e-5 * truth.max())


@pytest.mark.slow
@pytest.mark.parametrize("rotation_rad", [0.03, -0.6])
def test_pixel_averages_over_its_rotated_square(rotation_rad: float) -> None:
    phase_screen, lattice = screen(), replace(LATTICE, rotation_rad=rotation_rad)
    fast = model(lattice, pixel_fill_factor=1.0)
    point = SourcePoints(position_m=POINTS.position_m[:1], area_m2=POINTS.area_m2[:1])
    image = fast.irradiance(point, behind(fast, phase_screen))
    nodes, weights = np.polynomial.legendre.leggauss(3)  # exact to the sixth power over half a pixel either way
    truth = sum(
        (
            direct_irradiance(phase_screen, point, (x / 2, y / 2), lattice) * (p * q / 4)
            for x, p in zip(nodes, weights, strict=True)
            for y, q in zip(nodes, weights, strict=True)
        ),
        start=np.zeros((ROWS, COLUMNS)),
    )
    np.testing.assert_allclose(image, truth, rtol=0, atol=2e-5 * truth.max())


def test_reference_is_the_image_behind_a_flat_screen() -> None:
    flat = PhaseScreen(np.zeros((241, 241)), 25e-6)
    fast = model(pixel_fill_factor=1.0)
    image = fast.irradiance(POINTS, behind(fast, flat))
    np.testing.assert_allclose(fast.irradiance(POINTS), image, rtol=0, atol=1e-5 * image.max())


def centroids_px(image: NDArray[np.float32], lattice: Lattice, *, radius_px: float = 13.0) -> Floats:
    """Centroid of the light around each lenslet's centre in the lattice frame, (lenslet_row, lenslet_column, xy)."""
    row, column = np.mgrid[: image.shape[0], : image.shape[1]]
    position = lattice.from_camera_px(np.stack([column, row], axis=-1).astype(float))
    centers = (np.stack(np.meshgrid(np.arange(9) - 4, np.arange(7) - 3), axis=-1)) * lattice.pitch_px
    found = np.empty_like(centers, dtype=float)
    for index in np.ndindex(7, 9):
        offset = position - centers[index]
        near = (np.abs(offset) < radius_px).all(axis=-1)
        light = image[near] * (image[near] > 0.3 * image[near].max())
        found[index] = (offset[near] * light[:, None]).sum(axis=0) / light.sum()
    return found


def test_tilt_moves_light_to_positive_x_by_f_over_k_times_slope() -> None:
    slope_x, slope_y = 9000.0, -5000.0  # rad/m
    along_m = (np.arange(241) - 120) * 25e-6
    tilted = PhaseScreen(slope_y * along_m[:, None] + slope_x * along_m[None, :], 25e-6)
    fast = model()
    axis = SourcePoints(position_m=np.zeros((1, 2)), area_m2=np.ones(1))
    moved = centroids_px(fast.irradiance(axis, behind(fast, tilted)), LATTICE)
    expected = np.array([slope_x, slope_y]) * 46.7e-3 * 462e-9 / (2 * math.pi) / 16e-6
    assert expected[0] > 1.5
    np.testing.assert_allclose(moved.mean(axis=(0, 1)), expected, atol=0.02)
    np.testing.assert_allclose(moved, np.broadcast_to(expected, moved.shape), atol=0.2)  # coarse pixels


@pytest.mark.parametrize("border_lenslets", [0, 1])
@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
def test_tilt_of_one_lenslet_moves_its_light_alone(arrangement: Arrangement, border_lenslets: int) -> None:
    """A phase of 1 rad at the edge of the aperture."""
    sensor, lattice = replace(SENSOR, arrangement=arrangement), replace(LATTICE, arrangement=arrangement)
    optics = ForwardModel(
        sensor,
        lattice,
        FIELD,
        shape=(ROWS, COLUMNS),
        pupil_samples=SAMPLES,
        border_lenslets=border_lenslets,
        pixel_fill_factor=1.0,
    )
    axis = SourcePoints(position_m=np.zeros((1, 2)), area_m2=np.ones(1))
    still = optics.irradiance(axis)
    position_px = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).astype(float)
    for row, column in ((2, 3), (3, 3)):
        tilt = np.zeros((7, 9, 2, 2))
        tilt[row, column, 0, 1] = 1.0
        phase = optics.phase_of_lenslets(tilt)
        field = np.exp(1j * phase).astype(np.complex64)
        moved = optics.irradiance(axis, lambda _x, _y, field=field: field)  # type: ignore[misc] # mypy and defaults
        away_px = (position_px - lattice.lenslet_centers_px(7, 9)[row, column]) @ lattice.turn.T
        inside = np.abs(away_px).max(axis=-1) < lattice.pitch_px / 2
        change = moved - still
        assert np.sum(change[inside] ** 2) > 0.95 * np.sum(change**2)
        shift_px = np.sum(change[inside, None] * away_px[inside], axis=0) / np.sum(still[inside])
        expected_px = 1 / (sensor.aperture_width_m / 2) / sensor.slope_per_px
        np.testing.assert_allclose(shift_px, [expected_px, 0], atol=0.1 * expected_px)


def test_screen_moves_with_its_shift() -> None:
    along_m = (np.arange(281) - 140) * 25e-6
    bowl = 4e6 * along_m[None, :] ** 2 / 2 - 3e6 * along_m[:, None] ** 2 / 2
    curved = PhaseScreen(bowl, 25e-6)
    fast = model()
    axis = SourcePoints(position_m=np.zeros((1, 2)), area_m2=np.ones(1))
    images = [fast.irradiance(axis, behind(fast, curved, shift)) for shift in ((0.0, 0.0), (2e-4, 3e-4))]
    step = centroids_px(images[1], LATTICE) - centroids_px(images[0], LATTICE)
    expected = -np.array([4e6 * 2e-4, -3e6 * 3e-4]) * 46.7e-3 * 462e-9 / (2 * math.pi) / 16e-6
    np.testing.assert_allclose(step.mean(axis=(0, 1)), expected, atol=0.04)  # the centroids are thresholded


def test_object_point_keeps_its_place_in_every_subimage() -> None:
    fast = model()
    for x_o, y_o in ((0.5e-3, -0.2e-3), (-0.3e-3, 0.4e-3)):
        point = SourcePoints(position_m=np.array([[x_o, y_o]]), area_m2=np.ones(1))
        found = centroids_px(fast.irradiance(point), LATTICE)
        expected = np.array([x_o, y_o]) * 46.7e-3 / 0.2 / 16e-6
        np.testing.assert_allclose(found.mean(axis=(0, 1)), expected, atol=0.05)


def test_light_of_a_lenslet_is_the_emitting_area() -> None:
    square = source.source_points("square", Source(), object_samples=13)
    image = model().irradiance(square)
    per_lenslet = image.sum() / (7 * 9)
    area = (2 * 0.6e-3) ** 2
    assert 0.95 * area < per_lenslet < area  # a few per cent are diffracted beyond the cell


def test_pinhole_is_a_disc() -> None:
    points = source.stars(Source(star_rows=1, star_columns=1, pinhole_diameter_m=80e-6))
    assert points.area_m2.sum() == pytest.approx(math.pi * (40e-6) ** 2)
    mean_square = np.einsum("p,pi,pj->ij", points.area_m2, points.position_m, points.position_m) / points.area_m2.sum()
    np.testing.assert_allclose(mean_square, np.eye(2) * (40e-6) ** 2 / 4, rtol=1e-12, atol=1e-24)


def test_stars_stand_in_rows_and_columns() -> None:
    points = source.stars(Source(star_rows=2, star_columns=3, star_spacing_m=0.4e-3))
    stars = points.position_m.reshape(2, 3, 7, 2).mean(axis=2)
    np.testing.assert_allclose(stars[0, :, 0], [-0.4e-3, 0.0, 0.4e-3], atol=1e-15)
    np.testing.assert_allclose(stars[:, 0, 1], [-0.2e-3, 0.2e-3], atol=1e-15)


def test_border_lenslets_change_nothing_inside() -> None:
    plain, bordered = model().irradiance(POINTS), model(border_lenslets=1).irradiance(POINTS)
    assert not plain[0].any()
    lit = plain > 0
    np.testing.assert_array_equal(plain[lit], bordered[lit])
    assert (bordered > 0).sum() > 1.1 * lit.sum()


def test_result_does_not_depend_on_threads() -> None:
    square = source.source_points("square", Source(), object_samples=5)
    phase_screen = screen()
    one, two = model(threads=1), model(threads=2)
    image = one.irradiance(square, behind(one, phase_screen))
    np.testing.assert_allclose(
        two.irradiance(square, behind(two, phase_screen)), image, rtol=0, atol=2e-6 * image.max()
    )


def test_progress_rises_to_one() -> None:
    square = source.source_points("square", Source(), object_samples=7)
    heard: list[float] = []
    model().irradiance(square, progress=heard.append)
    assert heard[0] < 0.5
    assert heard == sorted(heard)
    assert heard[-1] == 1.0


MANY = source.source_points("square", Source(), object_samples=31)


def fail() -> None:
    raise ArithmeticError("enough")


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(
    ("end", "error"),
    [
        (fail, ArithmeticError),
        (press_ctrl_c, KeyboardInterrupt),
        (_thread.interrupt_main, KeyboardInterrupt),  # ends no wait: as Ctrl-C on Windows
    ],
)
@pytest.mark.parametrize("of_points", [False, True])
def test_exception_or_ctrl_c_ends_all_threads(
    end: Callable[[], object], error: type[BaseException], *, of_points: bool
) -> None:
    rendering, numbers = model(), itertools.count(1)  # safe in threads
    still = np.ones((len(rendering.sample_y_m), len(rendering.sample_x_m)), np.complex64)

    def field(_x_m: float, _y_m: float) -> NDArray[np.complex64]:
        if next(numbers) == 3:
            end()
        time.sleep(5e-3)
        return still

    with pytest.raises(error):
        _ = rendering.point_irradiances(MANY.position_m, field) if of_points else rendering.irradiance(MANY, field)
    begun = next(numbers)
    time.sleep(0.05)
    assert next(numbers) == begun + 1 < 900  # of 961
