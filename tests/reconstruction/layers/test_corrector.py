"""Best command of a corrector against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.layers.corrector import Correction, Corrector, best_correction

SENSOR = sensor_of(9, 11)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
POSITIONS_M = np.array([(x, y) for y in (-0.5e-3, 0.1e-3, 0.4e-3) for x in (-0.6e-3, 0.0, 0.3e-3)])


def wavefronts(ratio: float, *, bend: float = 0.7, lost: int = 0) -> Floats:
    """Wavefronts of the layer bend s_x^2 + 0.3 s_x s_y - 0.2 s_y^3, s in mm."""
    found = []
    for x_m, y_m in POSITIONS_M:
        x = (SENSOR.pupil_x_m + ratio * x_m) * 1e3
        y = (SENSOR.pupil_y_m[:, None] + ratio * y_m) * 1e3
        phase = bend * x**2 + 0.3 * x * y - 0.2 * y**3
        found.append(phase - phase.mean())
    each = np.array(found)
    each[:, 0, :lost] = np.nan
    return each


def correct(phases: Floats, ratio: float, corrector: Corrector) -> Correction:
    return best_correction(
        phases, positions_m=POSITIONS_M, sensor=SENSOR, field=FIELD, ratio=ratio, corrector=corrector
    )


@pytest.mark.parametrize("influence", ["legendre", "zernike"])
@pytest.mark.parametrize("lost", [0, 4])
def test_corrector_in_the_layer_cancels_it(influence: str, lost: int) -> None:
    made = correct(wavefronts(0.8, lost=lost), 0.8, Corrector(influence, 15))  # type: ignore[arg-type] # a name
    np.testing.assert_allclose(made.residual_rad, 0, atol=1e-9)
    np.testing.assert_allclose(made.strehl, 1, atol=1e-12)
    x_m, y_m = np.linspace(-2e-3, 2e-3, 9), np.linspace(-2e-3, 2e-3, 9)[:, None]
    x, y = x_m * 1e3, y_m * 1e3
    added = made.phase(x_m, y_m) + 0.7 * x**2 + 0.3 * x * y - 0.2 * y**3
    np.testing.assert_allclose(added - added.mean(), 0, atol=1e-8)  # it adds the opposite


def test_corrector_at_the_pupil_leaves_the_change_over_the_field() -> None:
    """Of b (u + r x)^2 it leaves 2 b r u (x - mean x), without what is constant over the pupil."""
    ratio, bend = 0.8, 0.7
    phases = np.array([bend * (SENSOR.pupil_x_m + ratio * x_m) ** 2 * 1e6 for x_m, _ in POSITIONS_M])
    phases = np.broadcast_to(phases[:, None, :], (len(phases), *SENSOR.lenslets))
    made = correct(phases, 0.0, Corrector("legendre", 15))
    x_mm = POSITIONS_M[:, 0] * 1e3
    expected = 2 * bend * ratio * np.abs(x_mm - x_mm.mean()) * np.std(SENSOR.pupil_x_m * 1e3)
    np.testing.assert_allclose(made.residual_rad, expected, atol=1e-9)
    assert made.mean_residual_rad == pytest.approx(math.sqrt(np.mean(expected**2)))


def test_residual_is_least_at_the_layer() -> None:
    phases = wavefronts(0.8)
    ratios = np.array([0.0, 0.4, 0.7, 0.8, 0.9, 1.2])
    left = [correct(phases, ratio, Corrector("zernike", 21)).mean_residual_rad for ratio in ratios]
    assert ratios[int(np.argmin(left))] == 0.8
    assert left[0] > 5 * left[2]


def test_strehl_of_a_residual() -> None:
    """Without useful shapes the Strehl ratio is |<exp(i phi)>|^2 of the wavefront itself."""
    phases = np.zeros((1, *SENSOR.lenslets))
    phases[0, :, ::2] = 0.4  # no tilt, as the columns are symmetric
    made = best_correction(
        phases, positions_m=np.zeros((1, 2)), sensor=SENSOR, field=FIELD, ratio=0.0, corrector=Corrector("legendre", 3)
    )
    assert made.strehl[0] == pytest.approx(np.abs(np.mean(np.exp(1j * phases))) ** 2, rel=1e-9)


def test_actuators_have_the_coupling_and_follow_a_smooth_layer() -> None:
    corrector = Corrector("actuators", 81)
    side = np.linspace(-1, 1, 9)
    at_actuators = corrector.shapes(side, side[:, None]).reshape(9, 9, 9, 9)
    assert at_actuators[4, 4, 4, 4] == 1
    assert at_actuators[4, 4, 4, 5] == pytest.approx(0.15)
    assert at_actuators[2, 4, 3, 4] == pytest.approx(0.15)
    made = correct(wavefronts(0.8), 0.8, corrector)
    assert made.mean_residual_rad < 0.05 * np.std(wavefronts(0.8))


@pytest.mark.parametrize(
    ("influence", "count", "sentence"), [("actuators", 20, "square"), ("legendre", 1, "2 ..."), ("zernike", 999, "500")]
)
def test_impossible_correctors_are_refused(influence: str, count: int, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Corrector(influence, count)  # type: ignore[arg-type] # a name


def test_positions_without_lenslets_are_left_out() -> None:
    phases = wavefronts(0.8)
    part = best_correction(
        phases[1:],
        positions_m=POSITIONS_M[1:],
        sensor=SENSOR,
        field=FIELD,
        ratio=0.3,
        corrector=Corrector("legendre", 10),
    )
    phases[0] = np.nan
    made = correct(phases, 0.3, Corrector("legendre", 10))
    np.testing.assert_allclose(made.command, part.command, atol=1e-9)
    np.testing.assert_allclose(made.residual_rad, [np.nan, *part.residual_rad], atol=1e-9)
    assert np.isnan(made.strehl[0])
    assert made.mean_residual_rad == pytest.approx(part.mean_residual_rad)


def test_no_lenslets_are_refused() -> None:
    with pytest.raises(ValueError, match="no lenslet"):
        correct(np.full_like(wavefronts(0.0), np.nan), 0.0, Corrector("legendre", 6))


def test_unknown_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="legendre, zernike, actuators, not splines"):
        Corrector("splines", 45)  # type: ignore[arg-type] # as from Python
    with pytest.raises(ValueError, match=r"number of actuators must be 4 \.\.\. 1024"):
        Corrector("actuators", 10_000)
