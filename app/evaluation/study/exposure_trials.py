"""Trials of auto-exposure: any start, cameras of any depth and range, any light.

`simulated_devices.exposure_bench` stands in for the bench and takes no time. The right exposures cover the camera's
whole range with both ends, where the routine must change the light instead.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.bench.config import Bench
from app.evaluation.studies import CaseResult
from app.evaluation.study_kinds import TrialStudy, trial
from app.measurement.auto_exposure import FILL, MOST_FRAMES, TOLERANCE, auto_expose
from app.measurement.routines import RoutineError
from app.progress import Progress
from drivers.interface import Range
from reconstruction.arrays import Floats
from simulated_devices.exposure_bench import PITCH_PX, Scene, exposure_bench, spots, squares
from simulated_devices.settings import exposure_range_s

_STARTS, _RIGHT = 9, 7  # log-spaced first and right exposures
_CURRENTS_A = (0.0, 0.35, 1.0)  # at the start; the highest is 1 A
_USUAL_A = 0.35
_IMAGES: dict[str, Floats] = {"squares": squares(), "broad": squares(13.0), "haze": squares(8.0, 0.2), "spots": spots()}
_LIMITS = {"frames": MOST_FRAMES, "fill beside 70 % (%)": 100 * TOLERANCE, "light left on": 0.0}


@dataclass(frozen=True, slots=True)
class _Camera:
    name: str
    exposures_s: Range
    detector: dict[str, Any]  # settings of the scene


_SIXTEEN = {"bits": 16, "offset_counts": 500.0, "read_noise_counts": 6.4, "counts_per_electron": 1 / 5.8}
_TWELVE = {"bits": 12, "offset_counts": 100.0, "read_noise_counts": 2.0, "counts_per_electron": 0.2}
_EIGHT = {"bits": 8, "offset_counts": 4.0, "read_noise_counts": 0.8, "counts_per_electron": 0.02}
_CUT_OFF = {**_EIGHT, "offset_counts": 0.0}  # half of the noise lies below 0
_WIDEST = Range(1e-5, 7200.0)
_CAMERAS = (
    _Camera("C9100, EM, speed 3", exposure_range_s("em", 3), _SIXTEEN),
    _Camera("C9100, EM, speed 2", exposure_range_s("em", 2), _SIXTEEN),
    _Camera("C9100, normal", exposure_range_s("normal", 1), _SIXTEEN),
    _Camera("16 bits", _WIDEST, _SIXTEEN),
    _Camera("12 bits", _WIDEST, _TWELVE),
    _Camera("8 bits", _WIDEST, _EIGHT),
    _Camera("8 bits, no offset", _WIDEST, _CUT_OFF),
)


def _measure(_bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    cases = list(itertools.product(_CAMERAS, _CURRENTS_A))
    for done, (camera, current_a) in enumerate(cases):
        progress(f"{camera.name}, {current_a:g} A", done / len(cases))
        allowed = camera.exposures_s
        rights_s, starts_s = (np.geomspace(allowed.minimum, allowed.maximum, count) for count in (_RIGHT, _STARTS))
        for image, right_s, start_s, seed in itertools.product(_IMAGES, rights_s, starts_s, seeds):
            first_s = min(max(float(start_s), allowed.minimum), allowed.maximum)  # geomspace rounds
            yield _trial(camera, current_a, image, float(right_s), first_s, seed)


def _trial(camera: _Camera, current_a: float, image: str, right_s: float, first_s: float, seed: int) -> CaseResult:
    full_scale = 2 ** camera.detector["bits"] - 1
    scene = Scene(
        counts_per_a_s=(FILL * full_scale - camera.detector["offset_counts"]) / (_USUAL_A * right_s),
        exposure_range_s=camera.exposures_s,
        image=_IMAGES[image],
        seed=seed,
        **camera.detector,
    )
    devices, instrument, lamp = exposure_bench(scene, exposure_s=first_s, current_a=current_a)
    problem, fill, frames = "", math.nan, math.nan
    try:
        fill = auto_expose(devices, PITCH_PX, progress=lambda *_: None, should_stop=lambda: False).fill
        frames = len(instrument.exposed_s)
    except RoutineError as error:
        problem = str(error)
    values = (frames, 100 * abs(fill - FILL), float(lamp.is_on))
    return trial(
        case=f"{camera.name}, {current_a:g} A",
        name=f"{image}, {right_s:.3g} s wanted, from {first_s:.3g} s, seed {seed}",
        measured=dict(zip(_LIMITS, values, strict=True)),
        limits=_LIMITS,
        problem=problem,
    )


EXPOSURE = TrialStudy(name="exposure", title="Auto-exposure from any start", measure=_measure)
