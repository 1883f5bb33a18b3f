"""Measurement: one frame with its result, and what was assumed for it."""

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from app.measurement.calibration import Calibration
from drivers.interface import Frame
from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.geometry import Field
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.quality.verdict import Quality
from reconstruction.wavefront import Wavefront

SKIPPED = "skipped: the computer was too slow"  # stored in recordings
_COUNTS = {1: "one layer", 2: "two layers", 3: "a sample with depth between"}

RefinementStage = Literal["off", "preparing", "applied", "moved", "worse", "failed"]


@dataclass(frozen=True, slots=True)
class RefinementState:
    """Correction of one frame."""

    stage: RefinementStage = "off"
    age_s: float = math.nan  # from the bias's frame to this one
    moved_rad: float = math.nan  # change of the wavefront since the bias's frame, mean RMS over the views
    problem: str = ""  # reason of a failure
    bias: Floats | None = field(default=None, compare=False, repr=False)  # as applied, px; see `Reconstructor.solve`


class Assumptions(NamedTuple):
    """Sample assumed for one frame, and its correction."""

    sample: AssumedSample | None = FREE  # None: not found yet, so that any wavefront was allowed
    refinement: RefinementState = RefinementState()
    is_other: bool = False  # whether the frame contradicts the layers found last, which are searched again


@dataclass(frozen=True, slots=True)
class FrameTotals:
    """Numbers of frames since the loop began."""

    acquired: int = 0
    reconstructed: int = 0  # fewer if the computer is slower than the camera
    lost: int = 0  # overwritten in the camera before they were read


@dataclass(frozen=True, slots=True)
class Gap:
    """Time in which the camera stood between two frames, and why."""

    seconds: float
    cause: str


@dataclass(frozen=True, slots=True)
class LightState:
    """The light while a frame was taken."""

    is_on: bool
    current_a: float


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """One frame, its result, and everything needed to reproduce it."""

    frame: Frame
    wavefront: Wavefront | None
    problem: str  # why there is no wavefront; empty if there is one
    counts: FrameTotals = FrameTotals()
    exposure_end_s: float = math.nan  # end of the exposure on this computer's clock, time.perf_counter()
    latency_s: float = math.nan  # from then to this result
    calibration: Calibration | None = None  # shared by all frames that used it
    registered: Displacement | None = None  # as registered; the wavefront's displacement has the bias subtracted
    assumed: Assumptions = Assumptions()  # of the sample, with the bias that was applied, if any
    quality: Quality = Quality()
    lost: int = 0  # frames that the camera lost just before this one
    light: LightState | None = None  # as last polled
    gap: Gap | None = None  # just before the frame
    file: str = ""  # name of the file that the frame was read from; empty: the camera
    index: int = -1  # of the frame in the recording that it was read from; -1: none

    @property
    def is_skipped(self) -> bool:
        """True if the frame was not reconstructed because a newer one was there."""
        return self.problem == SKIPPED


def sample_sentence(sample: AssumedSample, field: Field) -> str:
    """Say what was assumed, as "one layer 195 +- 1 mm in front of the lenslets"."""
    neglected = ", and no propagation of light (the paper's simulation)" if field.neglect_propagation else ""
    if not sample.ratios:
        return f"any wavefront{neglected}"
    places = [
        _place(-ratio * field.collimator_focal_length_m, sigma * field.collimator_focal_length_m)
        for ratio, sigma in zip(sample.ratios, sample.sigma.tolist(), strict=True)
    ]
    ends = places[:: max(len(places) - 1, 1)]
    return f"{_COUNTS[len(places)]} {' and '.join(ends)}{neglected}"


def _place(distance_m: float, sigma_m: float) -> str:
    side = "in front of" if distance_m >= 0 else "behind"
    decimals = 0 if sigma_m <= 0 else max(0, -math.floor(math.log10(sigma_m * 1e3)))
    error = f" +- {sigma_m * 1e3:.{decimals}f}" if sigma_m > 0 else ""
    return f"{abs(distance_m) * 1e3:.{decimals}f}{error} mm {side} the lenslets"
