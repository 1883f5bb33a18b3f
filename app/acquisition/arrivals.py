"""Which frames have arrived, which were lost before them, and how long each has lain."""

from __future__ import annotations

import math
import time
from dataclasses import replace

from app.measurement.measurement import Counts
from drivers.interface import Frame


class Arrivals:
    """Counts the frames of a camera, written by one thread, and sets the camera's clock by this computer's."""

    def __init__(self) -> None:
        self.counts = Counts()  # replaced, never changed: anybody may read it
        self._next_index = 0
        self._clock_lag_s = math.inf  # host's clock minus camera's

    def count(self, frame: Frame) -> None:
        """Count a frame that has arrived, and those that were lost before it."""
        was_restarted = frame.index < self._next_index
        lost = frame.index if was_restarted else frame.index - self._next_index
        self._next_index = frame.index + 1
        self.counts = replace(self.counts, acquired=self.counts.acquired + 1, lost=self.counts.lost + lost)
        self.set_clock(frame)

    def count_reconstructed(self) -> None:
        """Count one of them as reconstructed."""
        self.counts = replace(self.counts, reconstructed=self.counts.reconstructed + 1)

    def set_clock(self, frame: Frame) -> None:
        """Set the camera's clock by the frame that came the fastest."""
        self._clock_lag_s = min(self._clock_lag_s, frame.host_time_s - frame.camera_time_s)

    def exposure_end_s(self, frame: Frame) -> float:
        """When the frame was exposed, by this computer's time.perf_counter()."""
        return frame.camera_time_s + self._clock_lag_s

    def age_s(self, frame: Frame) -> float:
        """Time since the end of the exposure."""
        return time.perf_counter() - self.exposure_end_s(frame)
