"""Measurement: one frame and its result, as shown, recorded and published."""

from dataclasses import dataclass

from app.measurement.calibration import Calibration
from app.measurement.live_solver import Assumptions
from drivers.interface import Frame
from reconstruction.displacement import Displacement
from reconstruction.quality.verdict import Quality
from reconstruction.wavefront import Wavefront

SKIPPED = "passed over: the computer was behind, and a newer frame was there"  # stored in recordings


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """Result for one frame, and everything needed to reproduce it."""

    wavefront: Wavefront | None
    problem: str  # why there is no wavefront; empty if there is one
    calibration: Calibration | None = None
    start: Displacement | None = None  # initial guess of the registration: the previous frame's displacement
    registered: Displacement | None = None  # as registered; the wavefront's displacement has the bias subtracted
    assumed: Assumptions = Assumptions()
    quality: Quality = Quality()


@dataclass(frozen=True, slots=True)
class FrameTotals:
    """Numbers of frames since the loop began."""

    acquired: int = 0
    reconstructed: int = 0  # fewer if the computer is slower than the camera
    lost: int = 0  # overwritten in the camera before they were read


@dataclass(frozen=True, slots=True)
class Gap:
    """Time in which the camera stood between two frames, because it was stopped, or a setting or routine needed it."""

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
    counts: FrameTotals
    exposure_end_s: float  # end of the exposure on this computer's clock, time.perf_counter()
    latency_s: float  # from then to this result
    assumed: Assumptions = Assumptions()  # of the sample, with the bias that was applied, if any
    calibration: Calibration | None = None  # shared by all frames that used it
    start: Displacement | None = None  # initial guess of the registration: the previous frame's displacement
    registered: Displacement | None = None  # as registered; the wavefront's displacement has the bias subtracted
    light: LightState | None = None  # as last polled
    quality: Quality = Quality()
    gap: Gap | None = None  # just before the frame
    file: str = ""  # name of the file that the frame was read from; empty: the camera
