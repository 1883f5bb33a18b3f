"""Frame counts of an acquisition by outcome, and the memory of the process."""

from __future__ import annotations

import math
import os
import sys
from dataclasses import astuple, dataclass
from pathlib import Path

from app.measurement.measurement import SKIPPED, Measurement

_STATM = Path("/proc/self/statm")


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """Numbers of frames."""

    acquired: int = 0
    reconstructed: int = 0
    passed_over: int = 0  # read, but skipped for a newer one
    failed: int = 0  # without a wavefront
    lost: int = 0  # overwritten in the camera before they were read

    @property
    def share(self) -> float:
        """Share of reconstructed frames among all frames of the camera, lost ones included."""
        taken = self.acquired + self.lost
        return self.reconstructed / taken if taken else math.nan

    def since(self, before: FrameCounts) -> FrameCounts:
        """Return the difference from earlier counts."""
        return FrameCounts(*(now - then for now, then in zip(astuple(self), astuple(before), strict=True)))


class Tally:
    """Counting sink of an acquisition."""

    def __init__(self) -> None:
        self.counts = FrameCounts()  # replaced by the worker with each frame, safe to read in any thread

    def take(self, measurement: Measurement) -> None:
        """Count one more frame."""
        is_reconstructed, is_passed_over = measurement.wavefront is not None, measurement.problem == SKIPPED
        before = self.counts
        self.counts = FrameCounts(
            acquired=before.acquired + 1,
            reconstructed=before.reconstructed + is_reconstructed,
            passed_over=before.passed_over + is_passed_over,
            failed=before.failed + (not is_reconstructed and not is_passed_over),
            lost=measurement.counts.lost,
        )


def resident_mb() -> float | None:
    """Return the resident memory of this process, MB of 2**20 bytes; None if the system does not report it."""
    if sys.platform == "win32":
        return None
    try:
        pages = int(_STATM.read_text().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
