"""Lattice survey on frames drawn in closed form, with many defects."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.lattice_frames import FRAME, SENSOR, TRUTH, Shape, draw, drawn, image_of, photographed, sensor_with

from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey, survey

SHAPES: tuple[Shape, ...] = ("square", "disc", "stars", "ring", "pinhole")


def errors(found: Survey, truth: Lattice = TRUTH) -> tuple[float, float, float]:
    """Errors of centre (px), pitch (px) and rotation (mrad)."""
    lattice = found.lattice
    center_px = np.hypot(lattice.center_x_px - truth.center_x_px, lattice.center_y_px - truth.center_y_px)
    return (
        float(center_px),
        abs(lattice.pitch_px - truth.pitch_px),
        abs(lattice.rotation_rad - truth.rotation_rad) * 1e3,
    )


def check(found: Survey, truth: Lattice = TRUTH, *, times: float = 1.0) -> None:
    """Assert the required accuracy of the calibration, or a multiple of it."""
    center_px, pitch_px, rotation_mrad = errors(found, truth)
    assert center_px < 0.1 * times
    assert pitch_px < 0.02 * times
    assert rotation_mrad < 0.2 * times


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(draws=st.data())
def test_random_lattice_is_found_on_clean_frame(draws: st.DataObject) -> None:
    rows, columns = draws.draw(st.integers(4, 9)), draws.draw(st.integers(4, 9))
    pitch_px, blur_px = draws.draw(st.floats(14.0, 36.0)), draws.draw(st.floats(0.7, 1.4))
    shape: Shape = draws.draw(st.sampled_from(SHAPES))
    widest = min(0.27 if shape in {"ring", "stars"} else 0.4, 0.5 - 2 * blur_px / pitch_px)  # no light in the next cell
    half_width = draws.draw(st.floats(0.15, widest))
    rotation_rad, designed = draws.draw(st.floats(-0.1, 0.1)), draws.draw(st.floats(0.91, 1.1))
    margin = draws.draw(st.floats(0.2, 0.8))  # pitches
    reach = np.array([rows, columns]) + 2 * margin + 0.11 * max(rows, columns)
    frame = (int(reach[0] * pitch_px), int(reach[1] * pitch_px))
    truth = Lattice(
        center_x_px=frame[1] / 2 + draws.draw(st.floats(-2, 2)),
        center_y_px=frame[0] / 2 + draws.draw(st.floats(-2, 2)),
        pitch_px=pitch_px,
        rotation_rad=rotation_rad,
    )
    light = draw(
        frame,
        center_px=(truth.center_x_px, truth.center_y_px),
        pitch_px=pitch_px,
        rotation_rad=rotation_rad,
        brightness=np.ones((rows, columns)),
        image_px=image_of(shape, pitch_px, half_width, blur_px),
        blur_px=blur_px,
    )
    found = survey(light * 1000 + 100, sensor_with(rows, columns, pitch_px * designed))
    check(found, truth)
    assert (found.rows, found.columns) == (rows, columns)
    assert found.illuminated.all()


@pytest.mark.slow
@pytest.mark.long
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), shape=st.sampled_from(["square", "disc", "stars"]))
def test_lattice_is_found_on_faint_frames_with_dead_lenslets(seed: int, shape: Shape) -> None:
    rng = np.random.default_rng(seed)
    truth = Lattice(
        center_x_px=255.5 + rng.uniform(-3, 3),
        center_y_px=255.5 + rng.uniform(-3, 3),
        pitch_px=rng.uniform(30.9, 31.6),
        rotation_rad=rng.uniform(-0.02, 0.02),
    )
    dead = rng.random((17, 17)) < 0.1
    vignetting = np.add.outer(*(np.linspace(0.5, rng.uniform(0.3, 0.5), 17) for _ in range(2)))
    light = drawn(shape, 0.25, np.where(dead, 0, vignetting), truth)
    y, x = np.indices(FRAME)
    found = survey(photographed(light, rng, peak_e=200, background_e=20 + 0.05 * x + 0.02 * y), SENSOR)
    check(found, truth, times=2)
    np.testing.assert_array_equal(found.illuminated, ~dead[1:-1, 1:-1])


@pytest.mark.parametrize("shape", ["square", "disc"])
def test_almost_touching_images_are_calibrated(shape: Shape) -> None:
    dead = np.random.default_rng(4).random((17, 17)) < 0.1
    slope = np.linspace(0.4, 1, 17)
    light = drawn(shape, 0.44, np.where(dead, 0, slope))
    check(survey(photographed(light, np.random.default_rng(5), peak_e=2000), SENSOR))


def test_background_does_not_bias_centre() -> None:
    y, x = np.indices(FRAME) / 512
    light = drawn("square", 0.35, np.ones((17, 17))) * 1000 + 4000 * x + 2000 * y - 1500 * x**2
    center_px, pitch_px, _ = errors(survey(light, SENSOR))
    assert center_px < 0.01
    assert pitch_px < 0.001


def test_centre_of_asymmetric_image_has_first_harmonic_phase_zero() -> None:
    found = survey(drawn("corner", 0.15), SENSOR)
    # Along each axis two of the three stars lie at -0.15 pitches and one at 0.15.
    offset = np.angle(2 * np.exp(-2j * np.pi * 0.15) + np.exp(2j * np.pi * 0.15)) / (2 * np.pi) * TRUTH.pitch_px
    x_px, y_px = TRUTH.to_camera_px(np.array([offset, offset]))
    assert (found.lattice.center_x_px, found.lattice.center_y_px) == pytest.approx((x_px, y_px), abs=0.01)


def test_ring_with_negative_harmonic_is_centred_on_its_middle() -> None:
    check(survey(drawn("ring", 0.41), SENSOR))  # J0(2 pi 0.41) < 0


def test_stars_near_cell_edges_are_calibrated() -> None:
    check(survey(drawn("stars", 0.38), SENSOR))  # 1 + 2 cos(2 pi 0.38) < 0


@pytest.mark.parametrize("rotation_rad", [-0.7, 0.3, 0.75])
def test_rotation_up_to_45_degrees_is_found(rotation_rad: float) -> None:
    truth = Lattice(center_x_px=250.2, center_y_px=260.9, pitch_px=31.4, rotation_rad=rotation_rad)
    check(survey(drawn(lattice=truth, brightness=np.ones((10, 9))), sensor_with(10, 9, 31.25)), truth)


def test_rotation_beyond_45_degrees_is_reduced_by_90() -> None:
    turned = Lattice(center_x_px=255.5, center_y_px=255.5, pitch_px=31.4, rotation_rad=0.79)
    found = survey(drawn(lattice=turned, brightness=np.ones((9, 9))), sensor_with(9, 9, 31.25))
    assert found.lattice.rotation_rad == pytest.approx(0.79 - np.pi / 2, abs=2e-4)


def test_survey_reports_lit_lenslets_and_displacements() -> None:
    brightness = np.ones((15, 15))
    brightness[3, 4] = brightness[7, 7] = 0
    brightness[0, 14] = 0.05
    found = survey(drawn(brightness=brightness) * 1000, SENSOR)
    np.testing.assert_array_equal(found.illuminated, brightness > 0.1)
    assert np.isnan(found.displacement_px[~found.illuminated]).all()
    assert found.residual_px < 0.01
    assert found.likeness > 0.999


def test_residual_is_rms_distance_of_light_from_lattice() -> None:
    beside = np.random.default_rng(3).normal(0, 0.4, (15, 15, 2))
    light = draw(
        FRAME,
        center_px=(TRUTH.center_x_px, TRUTH.center_y_px),
        pitch_px=TRUTH.pitch_px,
        rotation_rad=TRUTH.rotation_rad,
        brightness=np.ones((15, 15)),
        image_px=image_of("square", TRUTH.pitch_px, 0.3, 1.2),
        beside_px=beside,
    )
    found = survey(light, SENSOR)
    assert found.residual_px == pytest.approx(np.sqrt(np.mean(np.sum(beside**2, axis=-1))), rel=0.05)
    mean = beside.mean(axis=(0, 1))
    np.testing.assert_allclose(found.displacement_px, beside - mean, atol=0.15)


def test_outlying_lenslets_do_not_bias_lattice() -> None:
    beside = np.zeros((15, 15, 2))
    beside[:3, :4] = 1.5  # a scratch, a bubble
    light = draw(
        FRAME,
        center_px=(TRUTH.center_x_px, TRUTH.center_y_px),
        pitch_px=TRUTH.pitch_px,
        rotation_rad=TRUTH.rotation_rad,
        brightness=np.ones((15, 15)),
        image_px=image_of("square", TRUTH.pitch_px, 0.3, 1.2),
        beside_px=beside,
    )
    _, pitch_px, rotation_mrad = errors(survey(light, SENSOR))
    assert pitch_px < 0.002
    assert rotation_mrad < 0.05


def test_extra_lenslets_on_frame_are_counted() -> None:
    found = survey(drawn(brightness=np.ones((15, 15))), sensor_with(9, 13, 31.25))
    assert (found.rows, found.columns) == (15, 15)
    check(found)  # the middle ones


def test_dead_lenslets_do_not_shift_block() -> None:
    """The middle of three blocks has four dead lenslets in a column that the first does not have."""
    brightness = np.ones((15, 15))
    brightness[[2, 5, 9, 11], 13] = 0
    check(survey(drawn(brightness=brightness), sensor_with(15, 13, 31.25)))


def test_lit_block_is_chosen_anywhere_on_frame() -> None:
    truth = Lattice(center_x_px=330.0, center_y_px=180.0, pitch_px=31.0, rotation_rad=-0.01)
    found = survey(drawn(lattice=truth, brightness=np.ones((6, 7))), sensor_with(6, 7, 31.25))
    check(found, truth)
    assert (found.rows, found.columns) == (6, 7)


def test_round_pupil_is_calibrated() -> None:
    y, x = np.indices((15, 15)) - 7
    found = survey(drawn(brightness=(np.hypot(x, y) < 7.6).astype(float)), SENSOR)
    check(found)
    np.testing.assert_array_equal(found.illuminated, np.hypot(x, y) < 7.6)


def test_dark_is_subtracted_and_hot_pixels_are_ignored() -> None:
    rng = np.random.default_rng(8)
    pattern = 300 * np.sin(2 * np.pi * np.indices(FRAME)[1] / 31.4)  # of the camera, with the pitch of the lattice
    light = drawn() * 400 + 1000 + pattern
    for row, column in rng.integers(0, 512, (40, 2)):
        light[row, column] = 60000
    check(survey(light, SENSOR, dark=1000 + pattern))
    assert errors(survey(light, SENSOR))[0] > 0.1


def test_bright_reflection_does_not_hide_lattice() -> None:
    y, x = np.indices(FRAME)
    light = drawn() * 100 + 5000 * np.exp(-((x - 300) ** 2 + (y - 100) ** 2) / 30)
    check(survey(light, SENSOR))


def _many(peak: float) -> NDArray[np.float32]:
    """A noisy frame with room for 2000 lenslets and 300 hot pixels, lit as brightly as `peak`."""
    side, rng = 750, np.random.default_rng(6)
    light = draw(
        (side, side),
        center_px=(374.6, 373.9),
        pitch_px=16.1,
        rotation_rad=0.004,
        brightness=np.ones((46, 46)),
        image_px=image_of("square", 16.1, 0.2, 1.2),
    )
    frame = light * peak + rng.normal(500, 8, (side, side))
    frame[tuple(rng.integers(0, side, (2, 300)))] = 400_000
    return frame.astype(np.float32)


def test_hot_pixels_do_not_hide_faint_lattice_on_large_frame() -> None:
    heard: list[tuple[str, float]] = []
    found = survey(_many(60), sensor_with(46, 46, 16.0), progress=lambda text, done: heard.append((text, done)))
    truth = Lattice(center_x_px=374.6, center_y_px=373.9, pitch_px=16.1, rotation_rad=0.004)
    check(found, truth)
    assert (found.rows, found.columns) == (46, 46)
    assert [done for _, done in heard] == sorted(done for _, done in heard)
    assert heard[-1][0] == "fitting the lattice"
