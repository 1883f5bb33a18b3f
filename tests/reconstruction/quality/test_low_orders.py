"""Removal of piston, tilt and defocus from polynomials of the pupil."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction.wavefront import without_low_orders

U, V = np.meshgrid(np.arange(13) - 6.0, np.arange(9) - 4.0)
TILT, DEFOCUS, ASTIGMATISM = 0.2 * U - 0.1 * V, 0.05 * (U**2 + V**2), 0.03 * U * V


@pytest.mark.parametrize(
    ("tilt", "defocus", "left"),
    [
        (False, False, TILT + DEFOCUS + ASTIGMATISM),
        (True, False, DEFOCUS + ASTIGMATISM),
        (False, True, TILT + ASTIGMATISM),
        (True, True, ASTIGMATISM),
    ],
)
def test_only_what_is_asked_for_is_removed(tilt: bool, defocus: bool, left: np.ndarray) -> None:
    phase = np.stack([0.7 + TILT + DEFOCUS + ASTIGMATISM, np.full(U.shape, np.nan)])
    before = phase.copy()
    found = without_low_orders(phase, tilt=tilt, defocus=defocus, arrangement="square")
    np.testing.assert_allclose(found[0], left - left.mean(), atol=1e-12)
    assert np.isnan(found[1]).all()
    np.testing.assert_array_equal(phase, before)


def test_lost_lenslets_do_not_bias_tilt_and_defocus() -> None:
    phase = 0.7 + TILT + DEFOCUS
    phase[:4, 7:] = np.nan
    np.testing.assert_allclose(
        without_low_orders(phase, tilt=True, defocus=True, arrangement="square"),
        np.where(np.isnan(phase), np.nan, 0),
        atol=1e-12,
    )
    left = without_low_orders(phase, tilt=False, defocus=True, arrangement="square")
    expected = np.where(np.isnan(phase), np.nan, TILT)
    np.testing.assert_allclose(left, expected - np.nanmean(expected), atol=1e-12)
