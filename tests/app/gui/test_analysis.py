"""What is found out beside the wavefront: only what is asked, off the window's thread, and never twice."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from support.gui_bench import BENCH, SENSOR
from support.patience import HANG_S
from support.wavefronts import U, V, bowl

from app.gui.analysis import Analysis, Analyst, Quantity, Question, analyse
from reconstruction.arrays import Floats
from reconstruction.quality.image_quality import diffraction_rad
from reconstruction.wavefront import Wavefront, without_piston


def question(quantity: Quantity, wavefront: Wavefront | None = None) -> Question:
    return Question(wavefront or bowl(), BENCH, quantity, None, None)


@pytest.fixture
def analyst() -> Iterator[Analyst]:
    made = Analyst()
    yield made
    made.close()


def wait(analyst: Analyst) -> Analysis:
    deadline_s = time.monotonic() + HANG_S
    while time.monotonic() < deadline_s:
        answer = analyst.answer()
        if answer is not None:
            return answer
        time.sleep(0.005)
    raise TimeoutError


def test_point_spread_lies_where_the_tilt_sends_it() -> None:
    tilt_rad_per_m = 2000.0
    found = analyse(question(Quantity.PSF, bowl(tilt_rad_per_m)))
    assert found.maps is not None
    spread = found.maps[1, 1]
    angle_rad = np.linspace(-found.reach_rad, found.reach_rad, spread.shape[0])
    center_rad = [(spread.sum(axis=axis) @ angle_rad) / spread.sum() for axis in (0, 1)]  # along x, along y
    np.testing.assert_allclose(
        center_rad, [tilt_rad_per_m / SENSOR.wavenumber_rad_per_m, 0], atol=0.2 * diffraction_rad(SENSOR)
    )
    wider = analyse(replace(question(Quantity.PSF), reach_rad=1.5e-3))
    assert wider.reach_rad == 1.5e-3
    assert wider.light_reach_rad < 1.5e-3


def test_what_was_measured_is_fitted_by_enough_modes() -> None:
    expected = without_piston(1e6 * (U**2 + V**2))
    for quantity, factor in ((Quantity.MEASURED, 1.0), (Quantity.FITTED, 1.0), (Quantity.DIFFERENCE, 0.0)):
        found = analyse(question(quantity)).maps
        assert found is not None
        np.testing.assert_allclose(found[1, 1], factor * expected, atol=1e-9)
        np.testing.assert_allclose(found[1, 2], factor * expected * (1 + 0.5 * 5 / 6), atol=1e-9)


def test_uncertainty_is_the_wavefronts_own() -> None:
    wavefront = bowl()
    found = analyse(question(Quantity.UNCERTAINTY, wavefront)).maps
    np.testing.assert_array_equal(found, wavefront.sigma())
    assert found is not None
    assert np.all(found > 0)


def test_only_what_is_asked_is_found_out() -> None:
    nothing = analyse(question(Quantity.WAVEFRONT))
    assert (nothing.maps, nothing.transfer, nothing.isoplanatism) == (None, None, None)
    curves = analyse(replace(question(Quantity.WAVEFRONT), view=(0, 2)))
    assert curves.maps is None
    assert curves.transfer is not None
    assert curves.isoplanatism is not None
    # the wavefronts differ by the growth of the bowl alone: 5e5 r^2 over the half width of the field
    growth_rad = np.std(5e5 * (U**2 + V**2))
    np.testing.assert_allclose(curves.isoplanatism.curve.most_rad[0], growth_rad * 2 / 7)


def test_same_question_is_answered_once_and_another_wavefront_waits_its_time(analyst: Analyst) -> None:
    first = question(Quantity.PSF)
    began_s = time.monotonic()  # the second waits from here on, however long the first answer takes
    analyst.ask(first)
    assert wait(analyst).question is first
    analyst.ask(first)
    assert analyst._answer is None
    second = question(Quantity.PSF)
    while analyst._answer is None:
        analyst.ask(second)
    assert time.monotonic() - began_s > 0.1
    wait(analyst)
    analyst.ask(replace(second, quantity=Quantity.DIFFERENCE))  # its user should not have to wait
    assert analyst._answer is not None


def test_what_goes_wrong_is_told_to_who_asked(analyst: Analyst) -> None:
    class Broken:
        def wavefront(self, field_modes: Floats) -> Floats:
            raise NotImplementedError("broken")

        sigma = wavefront

    analyst.ask(question(Quantity.UNCERTAINTY, replace(bowl(), solution=Broken())))
    with pytest.raises(NotImplementedError, match="broken"):
        wait(analyst)
    analyst.ask(question(Quantity.PSF))
    assert wait(analyst).maps is not None
