"""One frame and what became of it: what the acquisition passes on to whoever shows, records or publishes."""

from __future__ import annotations

from dataclasses import dataclass

from app.measurement.calibration import Calibration
from app.measurement.live_refinement import RefinementState
from drivers.interface import Frame
from reconstruction.displacement import Displacement
from reconstruction.wavefront import Wavefront

PASSED_OVER = "passed over: the computer was behind, and a newer frame was there"


@dataclass(frozen=True, slots=True)
class Counts:
    """What has become of the frames since the loop began."""

    acquired: int = 0
    reconstructed: int = 0  # fewer, when the computer is slower than the camera: then only the newest are
    lost: int = 0  # overwritten in the camera before they were read


@dataclass(frozen=True, slots=True)
class LightState:
    """The light while a frame was taken."""

    is_on: bool
    current_a: float


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """One frame, what became of it, and what is needed to make the same of it again."""

    frame: Frame
    wavefront: Wavefront | None
    problem: str  # why there is no wavefront; empty when there is one
    counts: Counts
    exposure_end_s: float  # when it was exposed, by this computer's time.perf_counter()
    latency_s: float  # from then to this result
    refinement: RefinementState = RefinementState()  # with the bias that was applied, if any
    calibration: Calibration | None = None  # the same object as long as it is in force
    start: Displacement | None = None  # where the registration began: as the frame before was registered; None if cold
    registered: Displacement | None = None  # what it found; the wavefront's own is less the bias
    light: LightState | None = None  # as it was set last
