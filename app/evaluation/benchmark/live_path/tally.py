"""What became of every frame of an acquisition, counted from the measurements themselves."""

from __future__ import annotations

import math
import time
from dataclasses import astuple, dataclass

from app.measurement.measurement import PASSED_OVER, Measurement


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """How many frames."""

    acquired: int = 0
    reconstructed: int = 0
    passed_over: int = 0  # read, but left for a newer one
    failed: int = 0  # no wavefront could be made of them
    lost: int = 0  # overwritten in the camera before they were read

    @property
    def share(self) -> float:
        """The reconstructed ones among all that the camera took, the lost ones included."""
        taken = self.acquired + self.lost
        return self.reconstructed / taken if taken else math.nan

    def since(self, before: FrameCounts) -> FrameCounts:
        """Those that have come since."""
        return FrameCounts(*(now - then for now, then in zip(astuple(self), astuple(before), strict=True)))


class Tally:
    """A sink of an acquisition, which counts."""

    def __init__(self) -> None:
        self.counts = FrameCounts()  # replaced by the worker with each frame, read by anybody
        self.first_wavefront_s: float | None = None  # when, by time.perf_counter()

    def take(self, measurement: Measurement) -> None:
        """Count one more."""
        is_reconstructed, is_passed_over = measurement.wavefront is not None, measurement.problem == PASSED_OVER
        if is_reconstructed and self.first_wavefront_s is None:
            self.first_wavefront_s = time.perf_counter()
        before = self.counts
        self.counts = FrameCounts(
            acquired=before.acquired + 1,
            reconstructed=before.reconstructed + is_reconstructed,
            passed_over=before.passed_over + is_passed_over,
            failed=before.failed + (not is_reconstructed and not is_passed_over),
            lost=measurement.counts.lost,
        )
