"""Removal of piston and Zernike modes from polynomials of the pupil."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.wavefront import without_zernikes

SENSOR = sensor_of(9, 13)
U, V = np.meshgrid(np.arange(13) - 6.0, np.arange(9) - 4.0)
PARTS = {  # by Noll's numbers, in closed form
    2: 0.2 * U,
    3: -0.1 * V,
    4: 0.05 * (U**2 + V**2),
    5: 0.03 * U * V,
    7: 2e-3 * (3 * (U**2 + V**2) / 4.5**2 - 2) * V,  # over the inscribed circle
    9: 1e-3 * (3 * U**2 * V - V**3),
}


@pytest.mark.parametrize("removed", [(), (2,), (3,), (4,), (2, 3, 4), (5, 7), (9,), tuple(PARTS)])
def test_only_chosen_modes_are_removed(removed: tuple[int, ...]) -> None:
    parts = {mode: part for mode, part in PARTS.items() if mode <= max(removed, default=9)}
    phase = np.stack([0.7 + sum(parts.values()), np.full(U.shape, np.nan)])
    before, left = phase.copy(), sum((part for mode, part in parts.items() if mode not in removed), 0 * U)
    found = without_zernikes(phase, removed, SENSOR)
    np.testing.assert_allclose(found[0], left - left.mean(), atol=1e-11)
    assert np.isnan(found[1]).all()
    np.testing.assert_array_equal(phase, before)


def test_lost_lenslets_do_not_bias_other_modes() -> None:
    phase = 0.7 + PARTS[2] + PARTS[3] + PARTS[4]
    phase[:4, 7:] = np.nan
    known = np.where(np.isnan(phase), np.nan, 0)
    np.testing.assert_allclose(without_zernikes(phase, (2, 3, 4), SENSOR), known, atol=1e-12)
    tilt = known + PARTS[2] + PARTS[3]
    np.testing.assert_allclose(without_zernikes(phase, (4,), SENSOR), tilt - np.nanmean(tilt), atol=1e-12)
