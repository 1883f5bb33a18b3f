"""The nonlinearity of a camera: its curve, and its fit to exposures whose light is known."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from reconstruction.annotated_settings import SettingError
from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.frame.linearity import Linearity
from reconstruction.frame.linearity_fit import Exposures, MeasuredLinearity
from reconstruction.frame.pixels import DarkSubtractor, KnownCamera

FULL = 60_000.0  # counts above the dark
TIMES = np.geomspace(0.1, 1.0, 8)
ORDER = np.concatenate([TIMES, TIMES[::-1]] * 2)
MEASURED = Linearity(quadratic=0.05, cubic=-0.01, highest_counts=40_000.0)


def signal_of(light: Floats, loss: float) -> Floats:
    """Signal of a camera that loses this share of the light of full scale."""
    return light - loss * light**2 / FULL


def light_of(signal: float, loss: float) -> float:
    """Its inverse, in closed form."""
    part = loss / FULL
    return float((1 - np.sqrt(1 - 4 * part * signal)) / (2 * part))


def exposures(
    loss: float,
    *,
    late: float = 0.0,
    drift: tuple[float, float] = (0.0, 0.0),
    flicker: float = 0.0,
    order: Floats = ORDER,
    fill: float = 0.85,
    per_electron: float = 0.2,
    seed: int = 1,
) -> Exposures:
    """Photographs of a smooth image with shot noise, 4 frames averaged; light in counts of a faint signal."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:160, :160]
    image = np.clip(np.sin(x / 4) * np.sin(y / 5), 0, 1) * (1 + 0.2 * np.sin(x / 40)) / 1.2

    def photograph(length: float, brightness: float) -> tuple[Image, Image]:
        light = image * fill * FULL * max(length + late, 0) * brightness
        noisy = random.poisson(light[..., None] / per_electron, (*light.shape, 4)) * per_electron
        counts = signal_of(np.asarray(noisy, np.float64), loss) + 5 * random.standard_normal(noisy.shape)
        return counts.mean(axis=-1).astype(np.float32), (counts.var(axis=-1, ddof=1) / 4).astype(np.float32)

    made = Exposures(photograph(1.0, 1.0)[0], FULL)
    for length, when in zip(order, np.linspace(0, 1, len(order)), strict=True):
        brightness = 1 + drift[0] * when + drift[1] * when**2 + flicker * random.standard_normal()
        made.add(*photograph(length, brightness), float(length))
    return made


def off(found: MeasuredLinearity, loss: float) -> float:
    """Error of the light over the signal at the highest signal."""
    curve = found.linearity
    return curve.quadratic + curve.cubic + 1 - light_of(curve.highest_counts, loss) / curve.highest_counts


def test_light_is_the_polynomial_and_goes_on_straight() -> None:
    signal = np.array([-100.0, 0.0, 10_000.0, 40_000.0, 50_000.0])
    share = signal[:4] / 40_000
    np.testing.assert_allclose(MEASURED.light(signal)[:4], signal[:4] * (1 + 0.05 * share - 0.01 * share**2), rtol=1e-6)
    np.testing.assert_allclose(MEASURED.light(signal)[4], 40_000 * 1.04 + 10_000 * (1 + 0.1 - 0.03), rtol=1e-6)


def test_slope_is_the_derivative_of_the_light() -> None:
    signal = np.array([0.0, 5_000.0, 20_000.0, 39_000.0, 45_000.0])
    difference = (MEASURED.light(signal + 1) - MEASURED.light(signal - 1)) / 2
    np.testing.assert_allclose(MEASURED.slope(signal), difference, rtol=1e-5)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("has_dark", [True, False])
def test_frames_are_corrected_above_the_dark(kind: Any, has_dark: bool) -> None:
    counts = np.random.default_rng(3).integers(10, 250, (40, 56)).astype(kind)
    measured = Linearity(quadratic=-0.2, cubic=0.1, highest_counts=200.0)
    dark = np.full(counts.shape, 7.5) if has_dark else None
    light, _ = DarkSubtractor(counts.shape, KnownCamera(dark, linearity=measured))(counts, "frame")
    signal = counts - (7.5 if has_dark else np.percentile(counts, 1.0))
    share = np.minimum(signal, 200.0) / 200
    expected = 200 * share * (1 - 0.2 * share + 0.1 * share**2) + np.maximum(signal - 200, 0) * (1 - 0.4 + 0.3)
    np.testing.assert_allclose(light, expected, atol=1e-3)
    assert light.dtype == np.float32


@pytest.mark.parametrize(
    ("conditions", "loss"),
    [
        ({}, 0.05),
        ({}, -0.05),
        ({}, 0.0),
        ({"late": 0.02}, 0.05),
        ({"drift": (0.02, 0.02)}, 0.05),
        ({"drift": (-0.04, 0.0), "late": -0.01}, 0.03),
        ({"flicker": 2e-3}, 0.05),
    ],
)
def test_common_scale_does_not_change_curve(conditions: Any, loss: float) -> None:
    found = exposures(loss, **conditions).fit(amplifier="", em_gain=1.0)
    truncated = 2e-4  # a cubic instead of a root
    assert abs(off(found, loss or 1e-12)) < 4 * found.sigma + truncated
    assert found.sigma < 1e-3
    assert found.linearity.quadratic == pytest.approx(loss * found.linearity.highest_counts / FULL, abs=0.004)
    assert found.late_s == pytest.approx(conditions.get("late", 0.0), abs=4 * found.late_sigma_s + 2e-4)
    assert found.drift == pytest.approx(sum(conditions.get("drift", (0.0,))), abs=3e-3)
    assert found.flicker == pytest.approx(conditions.get("flicker", 0.0), rel=0.4, abs=1e-3)
    assert 0.7 < found.linearity.chi_square < 1.4


@pytest.mark.slow
@pytest.mark.long
def test_standard_error_is_the_scatter() -> None:
    found = [
        exposures(0.03, flicker=1e-3, per_electron=20.0, seed=seed).fit(amplifier="", em_gain=1.0) for seed in range(24)
    ]
    pulls = [off(each, 0.03) / each.sigma for each in found]
    assert 0.65 < np.std(pulls) < 1.4
    assert abs(np.mean(pulls)) < 1.0


def refused() -> Iterator[tuple[Any, str]]:
    """Conditions that do not tell a nonlinearity, and why."""
    yield {"order": np.concatenate([TIMES[5:], TIMES[5:][::-1]] * 2)}, "3 exposure times that span a factor of 1.9"
    yield {"order": np.linspace(0.5, 1, 16)}, "span a factor of 2"
    yield {"order": TIMES}, "at least twice"
    yield {"drift": (0.1, 0.0)}, "drifted by 9"
    yield {"flicker": 0.05}, "flickers by"
    yield {"fill": 0.3}, "reaches 29% of full scale"
    yield {"per_electron": 3000.0}, "known to .* only"
    yield {"late": -0.2}, "no light above its dark"


@pytest.mark.parametrize(("conditions", "why"), list(refused()))
def test_exposures_that_do_not_tell_it_are_refused(conditions: Any, why: str) -> None:
    with pytest.raises(ReconstructionError, match=why):
        exposures(0.05, **conditions).fit(amplifier="", em_gain=1.0)


def test_saturated_pixels_are_refused() -> None:
    clipped = exposures(0.0)
    for moments in clipped._moments:
        moments[:] = np.minimum(moments, np.array([[0.6], [0.36], [0.216]]))
    with pytest.raises(ReconstructionError, match="saturated"):
        clipped.fit(amplifier="", em_gain=1.0)


def test_few_lit_pixels_are_refused() -> None:
    point = np.zeros((100, 100), np.float32)
    point[40:50, 40:50] = 50_000
    with pytest.raises(ReconstructionError, match="only 100 pixels have light"):
        Exposures(point, FULL)


def test_curve_that_falls_is_refused() -> None:
    with pytest.raises(SettingError, match="quadratic and cubic make the light fall"):
        Linearity(quadratic=-0.5, cubic=-0.1, highest_counts=1000.0)
