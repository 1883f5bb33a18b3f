"""RMS and peak to valley of wavefronts in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction.wavefront import peak_to_valley, rms, without_piston

STEPS = np.where(np.arange(6) % 2, 0.7, -0.7) + np.zeros((4, 1))  # half of the lenslets at +0.7 rad, half at -0.7
LOST = np.where(np.arange(6) == 5, np.nan, STEPS + 0.0)
LOST[:, 4] = np.nan


@pytest.mark.parametrize("phase", [STEPS, STEPS + 2.5, LOST], ids=["whole", "with piston", "with lost lenslets"])
def test_rms_and_peak_to_valley_match_two_levels(phase: np.ndarray) -> None:
    assert rms(phase) == pytest.approx(0.7)
    assert peak_to_valley(phase) == pytest.approx(1.4)
    np.testing.assert_allclose(without_piston(phase)[:, :4], STEPS[:, :4], atol=1e-12)


def test_leading_axes_are_kept_and_unknown_wavefronts_are_nan() -> None:
    views = np.stack([STEPS, np.full_like(STEPS, np.nan)])
    for value in (rms(views), peak_to_valley(views)):
        assert value.shape == (2,)
        assert np.isfinite(value).tolist() == [True, False]
