"""Verdict on the quality of an image: its faults, each with a plain reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from functools import reduce
from operator import or_
from typing import Self

import numpy as np

from reconstruction.arrays import Counts


class Fault(IntFlag):
    """Faults that make a wavefront doubtful although its lenslets are valid; stored as bits in results."""

    MISFIT = 1  # subimages look unlike the reference's, however they are warped
    SLOPES = 2  # slopes of no wavefront
    CLIPPED = 4  # many pixels at one highest count
    ILLUMINATION = 8  # lenslets blocked, or lit otherwise than in the reference
    RANGE = 16  # subimages have left their cells
    LATTICE = 32  # the reference shows the lenslets elsewhere
    DARK = 64  # the dark contains light
    RESPONSE = 128  # the reference does not look as the bench is modelled
    FROZEN = 256  # the same counts as the frame before, or as the reference
    CLOCK = 512  # not later than the frame before
    SAMPLE = 1024  # the reference was taken with a sample
    LINEARITY = 2048  # counts are not proportional to light
    PROPAGATION = 4096  # the light of subimages says that the bench's way of light is wrong
    SCALE = 8192  # the mask's image is not as large, or does not lie, as the bench says
    SEARCH = 16384  # live: nothing looks for layers and corrections any more


@dataclass(frozen=True, slots=True)
class Quality:
    """Faults with their reasons, the worst first; none if all is well."""

    reasons: Mapping[Fault, str] = field(default_factory=dict)
    unjudged: str = ""  # what could not be judged, and why

    @classmethod
    def of(cls, fault: Fault, reason: str) -> Self:
        """Make that of one fault; without a reason there is none."""
        return cls({fault: reason} if reason else {})

    @property
    def faults(self) -> Fault:
        """All faults together."""
        return reduce(or_, self.reasons, Fault(0))

    @property
    def sentence(self) -> str:
        """The reasons; empty if there are none."""
        return "; ".join(self.reasons.values())

    def __or__(self, other: Quality) -> Quality:
        """Faults of both; of two reasons for the same fault, the first one's."""
        reasons = {**other.reasons, **self.reasons} if self.reasons else other.reasons
        return Quality(reasons, self.unjudged or other.unjudged)


NO_FAULT = Quality()


def sequence_quality(before: Counts, frame: Counts, elapsed_s: float) -> Quality:
    """Find a camera that repeats itself, by two frames (row, column) and the time between them."""
    reasons: dict[Fault, str] = {}
    if _are_same(before, frame):
        reasons[Fault.FROZEN] = "this frame is identical to the one before: the camera repeats itself"
    if elapsed_s <= 0:
        moved = f"went back by {-elapsed_s:.3g} s" if elapsed_s < 0 else "stood still"
        reasons[Fault.CLOCK] = f"the camera's clock {moved} between two frames"
    return Quality(reasons)


def repeated_reference(frame: Counts, reference: Counts) -> Quality:
    """Find a frame that is the reference, both (row, column), perhaps rounded to counts: exposures differ in noise."""
    reason = "frame and reference are the same image: choose another frame" if _are_same(frame, reference) else ""
    return Quality.of(Fault.FROZEN, reason)


def _are_same(one: Counts, other: Counts) -> bool:
    """True if two images (row, column) are equal, or one is the other in whole counts."""
    parts = (one[:1], other[:1]), (one, other)  # the first rows of nearly all different images differ
    if one.dtype == other.dtype or not any(np.issubdtype(each.dtype, np.integer) for each in (one, other)):
        return all(np.array_equal(*part) for part in parts)
    return all(np.abs(np.subtract(*part, dtype=np.float64)).max() < 1 for part in parts)
