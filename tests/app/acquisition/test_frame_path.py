"""Latency by the camera's clock, which drifts beside the computer's."""

from __future__ import annotations

import numpy as np
import pytest

from app.acquisition.frame_path import FramePath
from app.measurement.measurement import Measurement
from app.timing import Timings
from drivers.interface import Frame

EXPOSED = np.zeros((2, 2), np.uint16)


@pytest.mark.parametrize("drift", [-50e-6, 0.0, 50e-6, 200e-6])
def test_exposure_end_follows_a_drifting_clock(drift: float) -> None:
    """Two hours at 1 Hz; transfers take 10 ... 30 ms."""
    path = FramePath((), Timings(), lambda _: False)
    rng = np.random.default_rng(0)
    for index in range(7200):
        end_s = 100.0 + index
        arrived_s = end_s + rng.uniform(0.01, 0.03)
        path._count(Frame(EXPOSED, index, (1 - drift) * index, arrived_s, 0.1, 1.0))
    frame = Frame(EXPOSED, 7200, (1 - drift) * 7200, 7300.02, 0.1, 1.0)
    measured = path._completed(Measurement(frame, None, ""), None)
    # The fastest transfer, 10 ms, counts as none.
    assert measured.exposure_end_s == pytest.approx(100.0 + 7200 + 0.01, abs=0.011)


def test_lost_frames_are_counted_and_noted_with_the_next() -> None:
    path, made = FramePath((), Timings(), lambda _: False), list[Measurement]()
    for index in (0, 1, 4, 5, 2):  # the camera was restarted before the last
        frame = Frame(EXPOSED, index, float(index), 100.0 + index, 0.1, 1.0)
        path._count(frame)
        made.append(path._completed(Measurement(frame, None, ""), None))
    assert [each.lost for each in made] == [0, 0, 2, 0, 2]
    assert [each.counts.lost for each in made] == [0, 0, 2, 2, 4]
    assert [each.counts.acquired for each in made] == [1, 2, 3, 4, 5]
