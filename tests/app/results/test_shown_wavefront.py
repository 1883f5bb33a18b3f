"""Display options against wavefronts in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.gui_bench import BENCH, FIELD, SENSOR
from support.wavefronts import bowl, modal

from app.errors import InputError
from app.results.dataset import result_dataset, stack_frames
from app.results.result_file import write_results
from app.results.shown_wavefront import DisplayOptions, StoredWavefront, Unit, WavefrontDisplay, with_views
from reconstruction.arrays import Floats
from reconstruction.displacement import LensletStatus
from reconstruction.geometry import Field
from reconstruction.pupil import Pupil
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Wavefront, without_piston

U, V = np.meshgrid(np.linspace(-1, 1, 27)[1::2], np.linspace(-1, 1, 19)[1::2])  # lenslet centres over the half width


def show(options: DisplayOptions, *wavefronts: Wavefront) -> Floats:
    display = WavefrontDisplay()
    display.options = options
    return [display(wavefront) for wavefront in wavefronts][-1].views


def growing() -> Wavefront:
    """Tilt along x, growing with the field's y, and constant defocus along x: 2 u (1 + y) + 0.5 P2(u)."""
    coefficients = np.zeros((6, 3))
    coefficients[1], coefficients[3, 0] = (2.0, 0.0, 2.0), 0.5
    return modal(coefficients)


def expected(y: float) -> Floats:
    return np.asarray(without_piston(2 * U * (1 + y) + 0.5 * (1.5 * U**2 - 0.5)))


def test_default_options_show_the_wavefront() -> None:
    wavefront = growing()
    np.testing.assert_array_equal(show(DisplayOptions(), wavefront), wavefront.views)


@pytest.mark.parametrize("count", range(1, 10))
def test_grids_cover_the_area_of_the_bench(count: int) -> None:
    views = show(DisplayOptions(views=count), growing())
    assert views.shape[:2] == (count, count)
    reach = 0.5e-3 / FIELD.half_width_m if count > 1 else 0.0
    for row, y in enumerate(np.linspace(-reach, reach, count)):
        for column in range(count):
            np.testing.assert_allclose(views[row, column], expected(y), atol=1e-4)


def test_grid_of_a_single_view_covers_the_field() -> None:
    field = with_views(Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, view_rows=1, view_columns=1), 3)
    np.testing.assert_allclose(field.view_x_m, [-0.4e-3, 0, 0.4e-3])


def test_tilt_and_defocus_are_removed_from_each_view() -> None:
    wavefront = growing()
    tilted = show(DisplayOptions(frozenset({4})), wavefront)
    np.testing.assert_allclose(show(DisplayOptions(frozenset({2, 3})), wavefront)[2, 1], expected(-1.0), atol=1e-4)
    both = show(DisplayOptions(frozenset({2, 3, 4})), wavefront)
    np.testing.assert_allclose(tilted[2, 1] - both[2, 1], 2 * U * (1 + 0.5 / 0.6), atol=1e-4)
    assert DisplayOptions(frozenset({2, 3, 5}), averaged=4).in_words == "no tilt, Z5, mean of 4 frames"
    assert DisplayOptions(frozenset({3})).in_words == "no Z3"


def test_mean_of_the_last_frames_is_shown() -> None:
    first, second, third = (modal(np.array([[0.0], [tilt]])) for tilt in (9.0, 1.0, 2.0))
    np.testing.assert_allclose(show(DisplayOptions(averaged=2), first, second, third)[1, 1], 1.5 * U, atol=1e-4)
    again = show(DisplayOptions(averaged=2), second, third, third)  # shown again, as after a change of options
    np.testing.assert_allclose(again[1, 1], 1.5 * U, atol=1e-4)


def test_lenslet_lost_in_one_frame_keeps_the_mean_of_the_others() -> None:
    first, second = bowl(), bowl(1000.0)
    valid = np.ones(U.shape, np.bool_)
    valid[2, 0] = False
    outcome = np.where(valid, second.displacement.outcome, LensletStatus.DARK)
    displacement = replace(second.displacement, outcome=outcome)
    lossy = replace(second, displacement=displacement, solution=ZonalSolution(SENSOR, displacement))
    x_m, y_m = np.meshgrid(SENSOR.pupil_x_m, SENSOR.pupil_y_m)
    shape = 1e6 * (x_m**2 + y_m**2)
    tilted = np.where(valid, shape + 1000 * x_m, np.nan)
    mean = np.nanmean([without_piston(shape), without_piston(tilted)], axis=0)
    np.testing.assert_allclose(show(DisplayOptions(averaged=2), first, lossy)[1, 1], without_piston(mean), atol=1e-6)


@pytest.mark.parametrize("views", [None, 5])
def test_stored_wavefront_is_subtracted_at_every_grid(views: int | None) -> None:
    wavefront, other = growing(), modal(np.array([[0.0], [0.0], [0.3]]))
    options = DisplayOptions(stored=StoredWavefront.of(other, "other"), views=views)
    np.testing.assert_allclose(show(options, wavefront)[0, 0], expected(-0.5 / 0.6) - 0.3 * V, atol=1e-4)
    itself = DisplayOptions(stored=StoredWavefront.of(wavefront, "itself"), views=views)
    np.testing.assert_allclose(show(itself, wavefront), 0, atol=1e-9)


def test_stored_mean_is_that_of_the_shown_frames() -> None:
    display = WavefrontDisplay()
    display.options = DisplayOptions(averaged=2)
    frames = [modal(np.array([[0.0], [tilt]])) for tilt in (1.0, 2.0)]
    for frame in frames:
        display(frame)
    stored = display.store(frames[-1], "mean")
    np.testing.assert_allclose(stored.at(FIELD)[1, 1], 1.5 * U, atol=1e-4)


def test_stored_wavefront_ends_where_its_field_ends() -> None:
    stored = StoredWavefront.of(growing(), "stored")
    wide = Field(collimator_focal_length_m=0.2, half_width_m=2e-3, view_rows=1, view_columns=3, view_spacing_m=1e-3)
    at = stored.at(wide)
    assert np.isnan(at[0, [0, 2]]).all()
    np.testing.assert_allclose(at[0, 1], expected(0.0), atol=1e-4)
    round_one = replace(stored, field=replace(FIELD, shape="circle"))
    assert np.isnan(round_one.at(FIELD)[0, 0]).all()  # x = y = -0.83 of the half width
    np.testing.assert_allclose(round_one.at(FIELD)[1, 0], expected(0.0), atol=1e-4)


@pytest.mark.parametrize("frames", [1, 2])
def test_stored_wavefront_of_a_file_is_the_mean_of_its_frames(tmp_path: Path, frames: int) -> None:
    path = tmp_path / "results.nc"
    both = [growing(), modal(2 * np.asarray(growing().coefficients))][:frames]
    datasets = [result_dataset(wavefront) for wavefront in both]
    count = range(frames)
    dataset = datasets[0] if frames == 1 else stack_frames(datasets, count, [0.0] * frames, [np.nan] * frames)
    write_results(path, dataset, bench=BENCH, inputs={})
    stored = StoredWavefront.from_results(path)
    factor = {1: 1.0, 2: 1.5}[frames]
    np.testing.assert_allclose(stored.at(with_views(FIELD, 5))[3, 2], factor * expected(0.25 / 0.6), atol=2e-4)


def test_file_without_coefficients_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "zonal.nc"
    write_results(path, result_dataset(bowl()), bench=BENCH, inputs={})
    with pytest.raises(InputError, match=r"zonal.nc: holds no coefficients: .*modal"):
        StoredWavefront.from_results(path)


def test_file_for_other_lenslets_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "results.nc"
    write_results(path, result_dataset(growing()), bench=BENCH, inputs={})
    with pytest.raises(InputError, match="is of other lenslets, or of another wavelength, than the bench"):
        StoredWavefront.from_results(path, replace(BENCH.sensor, lenslet_rows=15, lenslet_columns=15))


def test_file_at_another_wavelength_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "results.nc"
    write_results(path, result_dataset(growing()), bench=BENCH, inputs={})
    sensor = replace(BENCH.sensor, lenslet_rows=9, lenslet_columns=13)
    StoredWavefront.from_results(path, sensor)
    with pytest.raises(InputError, match="of another wavelength"):
        StoredWavefront.from_results(path, replace(sensor, wavelength_m=1.2 * sensor.wavelength_m))


def test_file_whose_coefficients_do_not_give_its_wavefront_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.nc"
    dataset = result_dataset(growing())
    write_results(path, dataset.assign(coefficients=dataset["coefficients"] + 0.1), bench=BENCH, inputs={})
    with pytest.raises(InputError, match="between its views"):
        StoredWavefront.from_results(path)


def test_units() -> None:
    assert Unit.WAVES.per_rad(SENSOR.wavelength_m) == pytest.approx(1 / 6.283185307)
    assert Unit.NM.per_rad(SENSOR.wavelength_m) == pytest.approx(462 / 6.283185307)
    assert Unit.RAD.per_rad(SENSOR.wavelength_m) == 1


def test_modes_are_removed_over_the_pupil_that_is_drawn() -> None:
    """What is left of spherical aberration and defocus is the defocus, only if both are those of the same circle."""
    radius_m = 4.1 * SENSOR.lenslet_pitch_m
    x, y = SENSOR.pupil_x_m / radius_m, SENSOR.pupil_y_m[:, None] / radius_m
    square = x**2 + y**2
    defocus = np.sqrt(3) * (2 * square - 1)
    wavefront = bowl()
    wavefront.views[:] = 0.3 * defocus + 0.5 * np.sqrt(5) * (6 * square**2 - 6 * square + 1)
    display = WavefrontDisplay()
    display.options = DisplayOptions(removed=frozenset({11}), pupil=Pupil.round((0.0, 0.0), radius_m))
    shown, inside = display(wavefront).views[1, 1], square <= 1
    left = 0.3 * (defocus - defocus[inside].mean())
    np.testing.assert_allclose(shown[inside], left[inside], atol=1e-9)
    assert np.isnan(shown[~inside]).all()
