"""Quality of a frame beside the one before it, or beside the reference."""

import numpy as np

from reconstruction.arrays import Counts
from reconstruction.quality.verdict import Fault, Quality


def sequence_quality(before: Counts, frame: Counts, elapsed_s: float) -> Quality:
    """Find a camera that repeats itself, from two successive frames and the time between them on the camera's clock."""
    reasons: dict[Fault, str] = {}
    if before.shape == frame.shape and np.array_equal(before, frame):
        reasons[Fault.FROZEN] = "this frame is identical to the one before: the camera repeats itself"
    if elapsed_s <= 0:
        moved = f"went back by {-elapsed_s:.3g} s" if elapsed_s < 0 else "stood still"
        reasons[Fault.CLOCK] = f"the camera's clock {moved} between two frames"
    return Quality(reasons)


def repeated_reference(frame: Counts, reference: Counts) -> Quality:
    """Find a frame that is the reference itself, perhaps rounded to whole counts: noise makes two exposures differ."""
    if frame.dtype == reference.dtype:
        is_same = np.array_equal(frame, reference)
    else:
        is_rounded = any(np.issubdtype(image.dtype, np.integer) for image in (frame, reference))
        difference = np.abs(np.subtract(frame, reference, dtype=np.float64)).max()
        is_same = bool(difference < 1 if is_rounded else difference == 0)
    return Quality({Fault.FROZEN: "the frame is the reference itself: give another exposure"} if is_same else {})
