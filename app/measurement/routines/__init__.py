"""What is done with the devices step by step: averages of frames, the right exposure, a look at the background.

Nothing here knows threads or windows; whoever calls owns the devices. Each routine leaves camera, light and stage as
it found them, also when it is cancelled or gives up; after a fault of a device the light goes off.
"""

from __future__ import annotations

from app.measurement.routines.auto_exposure import AutoExposure, auto_expose
from app.measurement.routines.averages import Average, average, take_dark, take_reference
from app.measurement.routines.background import BackgroundCheck, check_background
from app.measurement.routines.circumstances import Circumstances
from app.measurement.routines.frames import WAIT_SLICE_S, Cancelled, Progress, RoutineError, ShouldStop, next_frame

__all__ = [
    "WAIT_SLICE_S",
    "AutoExposure",
    "Average",
    "BackgroundCheck",
    "Cancelled",
    "Circumstances",
    "Progress",
    "RoutineError",
    "ShouldStop",
    "auto_expose",
    "average",
    "check_background",
    "next_frame",
    "take_dark",
    "take_reference",
]
