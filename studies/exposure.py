"""Auto-exposure from any start, on `studies.exposure_bench`, which takes no time.

The right exposures cover the camera's whole range with both ends, where the routine must change the light instead.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.measurement.auto_exposure import FILL, MOST_FRAMES, TOLERANCE, auto_expose
from app.measurement.routines import NO_CALLBACKS, RoutineError
from drivers.interface import Range
from reconstruction.arrays import Floats
from simulated_devices.settings import exposure_range_s
from studies.exposure_bench import PITCH_PX, LampScene, exposure_bench, spots, squares
from studies.tables import Asked, Made, Row, steps, trial, trials

STARTS, RIGHT = 9, 7  # log-spaced first and right exposures
CURRENTS_A = (0.0, 0.35, 1.0)  # at the start; the highest is 1 A
_USUAL_A = 0.35
IMAGES: dict[str, Floats] = {
    "squares": squares(),
    "broad": squares(width_px=13.0),
    "haze": squares(background=0.2),
    "spots": spots(),
}
LIMITS = {"frames": MOST_FRAMES, "fill next to 70 % (%)": 100 * TOLERANCE, "light left on": 0.0}


@dataclass(frozen=True, slots=True)
class TriedCamera:
    """A camera's range of exposures, and the detector of its scene."""

    name: str
    exposures_s: Range
    detector: dict[str, Any]  # settings of the scene


_SIXTEEN = {"bits": 16, "offset_counts": 500.0, "read_noise_counts": 6.4, "counts_per_electron": 1 / 5.8}
_TWELVE = {"bits": 12, "offset_counts": 100.0, "read_noise_counts": 2.0, "counts_per_electron": 0.2}
EIGHT = {"bits": 8, "offset_counts": 4.0, "read_noise_counts": 0.8, "counts_per_electron": 0.02}
_CUT_OFF = {**EIGHT, "offset_counts": 0.0}  # half of the noise lies below 0
_WIDEST = Range(1e-5, 7200.0)
CAMERAS = (
    TriedCamera("C9100, EM, speed 3", exposure_range_s("em", 3), _SIXTEEN),
    TriedCamera("C9100, EM, speed 2", exposure_range_s("em", 2), _SIXTEEN),
    TriedCamera("C9100, normal", exposure_range_s("normal", 1), _SIXTEEN),
    TriedCamera("16 bits", _WIDEST, _SIXTEEN),
    TriedCamera("12 bits", _WIDEST, _TWELVE),
    TriedCamera("8 bits", _WIDEST, EIGHT),
    TriedCamera("8 bits, no offset", _WIDEST, _CUT_OFF),
)


def exposure(asked: Asked, cameras: Sequence[TriedCamera] = CAMERAS, images: Mapping[str, Floats] = IMAGES) -> Made:
    """Frames that auto-exposure needs from any start to any right exposure, and how near it comes."""
    rows: list[Row] = []
    for tried, current_a in steps(list(itertools.product(cameras, CURRENTS_A)), "cameras"):
        allowed, full_scale = tried.exposures_s, 2 ** tried.detector["bits"] - 1
        rights_s, starts_s = (np.geomspace(allowed.minimum, allowed.maximum, count) for count in (RIGHT, STARTS))
        for image, right_s, start_s, seed in itertools.product(images, rights_s, starts_s, asked.seeds):
            scene = LampScene(
                counts_per_a_s=(FILL * full_scale - tried.detector["offset_counts"]) / (_USUAL_A * float(right_s)),
                exposure_range_s=allowed,
                image=images[image],
                seed=seed,
                **tried.detector,
            )
            first_s = allowed.nearest(float(start_s))  # geomspace rounds
            devices, instrument, lamp = exposure_bench(scene, exposure_s=first_s, current_a=current_a)
            problem, fill, frames = "", math.nan, math.nan
            try:
                fill = auto_expose(devices, PITCH_PX, NO_CALLBACKS).fill
                frames = len(instrument.exposed_s)
            except RoutineError as error:
                problem = f"{image}, {right_s:.3g} s wanted, from {first_s:.3g} s: {error}"
            values = (frames, 100 * abs(fill - FILL), float(lamp.is_on))
            measured = dict(zip(LIMITS, values, strict=True))
            rows.append(trial(f"{tried.name}, {current_a:g} A", measured, LIMITS, problem))
    return trials(rows, "Auto-exposure from any start")
