"""Quality of a frame beside the one before it."""

import numpy as np

from reconstruction.arrays import Counts
from reconstruction.quality.verdict import Fault, Quality


def sequence_quality(before: Counts, frame: Counts, elapsed_s: float) -> Quality:
    """Find a camera that repeats itself, from two successive frames and the time between them on the camera's clock."""
    reasons: dict[Fault, str] = {}
    if before.shape == frame.shape and np.array_equal(before, frame):
        reasons[Fault.FROZEN] = "this frame is identical to the one before: the camera repeats itself"
    if elapsed_s <= 0:
        reasons[Fault.CLOCK] = f"the camera's clock went back by {-elapsed_s:.3g} s between two frames"
    return Quality(reasons)
