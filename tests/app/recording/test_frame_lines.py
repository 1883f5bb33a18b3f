"""The line of a frame: the sample that was assumed for it comes back exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.recording.frame_lines import FrameLine, SampleLine, assumed_sample, sample_line
from reconstruction.layers.layered_wavefront import FREE, AssumedSample

UNKNOWN: dict[str, Any] = dict.fromkeys(
    ("is_light_on", "light_current_a", "calibration", "bias", "bias_age_s", "rms_rad", "valid")
)
TIMES_S: dict[str, Any] = {"camera_time_s": 1.0, "host_time_s": 2.0, "exposure_s": 0.01}
LINE = FrameLine(index=3, camera_index=5, em_gain=1.0, lost=0, problem="", **TIMES_S, **UNKNOWN)


def back(sample: AssumedSample) -> AssumedSample:
    written = replace(LINE, sample=sample_line(sample)).to_json()
    return assumed_sample(FrameLine.from_json(written).sample)


def test_sample_comes_back_exactly() -> None:
    covariance = np.array([[1e-4, 1e-5], [1e-5, 2e-4]]) / 3
    found = back(AssumedSample((-1 / 3, -0.1), covariance, rivals=(-0.4, -0.2, -0.05)))
    assert (found.ratios, found.rivals) == ((-1 / 3, -0.1), (-0.4, -0.2, -0.05))
    np.testing.assert_array_equal(found.covariance, covariance)
    assert back(AssumedSample((-1 / 3,))).covariance is None
    assert back(FREE) is FREE


@pytest.mark.parametrize("numbers", [{"ratios": (np.nan,)}, {"rivals": (np.inf,)}, {"covariance": ((1.0, 0.0),)}])
def test_impossible_sample_is_refused(numbers: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="impossible"):
        replace(SampleLine((-0.5,), None), **numbers)
