"""Messages about frames: one JSON header, and arrays; for the clients of an instrument and for other programs.

The instrument's own clients get all that is cheap to know of a frame, and ask for the rest (`DETAILS`).
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from app.acquisition.serialization import Labelled, Message
from app.bench.config import Bench
from app.errors import RunError
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront

FORMAT = 1  # increased when subscribers must change

_VIEW = ("view_row", "view_column")
_LENSLET = ("lenslet_row", "lenslet_column")
_MODES = ("pupil_mode", "field_mode")
_VECTORS = (*_LENSLET, "field_mode", "xy")
SHARED = 16  # objects kept for clients; four belong to a calibration


@dataclass(frozen=True, slots=True)
class NewFrame:
    """The count of the newest record, in the ring of a name."""

    ring: str
    count: int


class SharedObjects:
    """Numbers the large objects that many frames share: a client asks for each once."""

    def __init__(self) -> None:
        self._objects, self._last = dict[int, Any](), 0

    def number(self, shared: object) -> int | None:
        """Return the number of an object; None for None."""
        known = next((number for number, each in self._objects.items() if each is shared), None)
        if shared is None or known is not None:
            return known
        self._last += 1
        self._objects[self._last] = shared
        self._objects.pop(self._last - SHARED, None)
        return self._last

    def get(self, number: int) -> Any:
        """Return the object of a number; `RunError` if it is too old."""
        if number not in self._objects:
            raise RunError(f"object {number} is no longer known")
        return self._objects[number]


class OwnFacts(NamedTuple):
    """What a client of the instrument needs of a frame besides the arrays."""

    measurement: Measurement  # without what is in arrays and shared objects
    is_shown_only: bool  # a routine's frame
    calibration: int | None  # number of the shared object, as the rest
    field_modes: int | None = None  # None without a wavefront
    pupil_modes: int | None = None  # None of a zonal wavefront
    parameters: int | None = None  # of the lenslets' warps, (K, 2Q)


OF_LENSLETS = ("outcome", "residual_rms", "chi_square", "range_used")
DETAILS: dict[str, Callable[[Any], Any]] = {
    "sigma": lambda wavefront: wavefront.sigma(),
    "covariance": lambda wavefront: wavefront.displacement.covariance,
    "transmission": lambda wavefront: wavefront.displacement.transmission,
    "root_covariance": lambda wavefront: wavefront.solution.root_covariance,
    "fitted": lambda wavefront: wavefront.solution.fitted(),
}
"""What a client asks for if it needs it: to compute or to send it costs milliseconds."""


def own_message(measurement: Measurement, shared: SharedObjects, *, is_shown_only: bool) -> Message:
    """Return the message for clients of the instrument: arrays of all topics, and the pixels."""
    lean = replace(measurement, wavefront=None, registered=None, calibration=None)
    facts = OwnFacts(lean, is_shown_only, shared.number(measurement.calibration))
    wavefront, registered, labelled = measurement.wavefront, measurement.registered, list[Labelled]()
    if wavefront is not None and registered is not None:
        solution, facts = wavefront.solution, facts._replace(field_modes=shared.number(registered.modes))
        labelled = [
            ("wavefront", (*_VIEW, *_LENSLET), "rad", wavefront.views),
            ("displacement", _VECTORS, "px", registered.coefficients),
            *((name, _LENSLET, "1", getattr(registered, name)) for name in OF_LENSLETS),
        ]
        if isinstance(solution, ModalSolution):
            pupil_modes, parameters = map(shared.number, (solution.modes, solution.parameters))
            facts = facts._replace(pupil_modes=pupil_modes, parameters=parameters)
            labelled.append(("coefficients", _MODES, "rad", solution.coefficients))
            labelled.append(("known", _LENSLET, "1", solution.known))
            labelled.append(("freedom_and_noise", ("of_fit",), "1", np.array([solution.freedom, solution.noise])))
        elif solution.weights is not None:
            labelled.append(("weights", _LENSLET, "1", solution.weights))
    return Message({"format": FORMAT, "value": facts}, labelled)


def topic_message(topic: str, sequence: int, measurement: Measurement, bench: Bench, facts: str) -> list[bytes]:
    """Return the parts of a message for other programs; empty if the method has no such arrays.

    `sequence` counts all measurements offered for publication; `facts` are `calibration_facts`. A frame without a
    wavefront has no arrays, but a `problem`.
    """
    labelled = [] if measurement.wavefront is None else TOPICS[topic](measurement.wavefront)
    if measurement.wavefront is not None and not labelled:
        return []
    header = {"format": FORMAT, "sequence": sequence, **_frame_facts(measurement, bench)}
    return [topic.encode(), *Message(header, labelled, facts).parts]


def _frame_facts(measurement: Measurement, bench: Bench) -> dict[str, Any]:
    frame, (sample, refinement) = measurement.frame, measurement.assumed
    unix_s = time.time() - time.perf_counter()  # calendar time at which perf_counter is zero
    per_ratio_m, layers = bench.field.collimator_focal_length_m, None
    if sample is not None:  # else layers have not been searched for
        layers = [
            {"distance_m": -ratio * per_ratio_m, "distance_sigma_m": sigma * per_ratio_m}
            for ratio, sigma in zip(sample.ratios, sample.sigma.tolist(), strict=True)
        ]
    return {
        "frame": frame.index,
        "camera_time_s": frame.camera_time_s,
        "host_time_s": frame.host_time_s,
        "exposure_end_unix_s": unix_s + measurement.exposure_end_s,
        "latency_s": measurement.latency_s,
        "exposure_s": frame.exposure_s,
        "em_gain": frame.em_gain,
        "lost": measurement.counts.lost,
        "refinement": refinement.stage,
        "bias_age_s": None if math.isnan(refinement.age_s) else refinement.age_s,
        "problem": measurement.problem,
        "quality": [fault.name.lower() for fault in measurement.quality.faults if fault.name],
        "quality_reason": measurement.quality.sentence,
        "layers": layers,
    }


def calibration_facts(calibration: Calibration | None, bench: Bench) -> str:
    """Return header entries as JSON that give axes, units and wavefronts their meaning; made once per calibration."""
    bench = bench if calibration is None else calibration.bench
    sensor = bench.sensor
    pupil_x_m = sensor.pupil_x_m if sensor.arrangement == "square" else sensor.lenslet_centers_m[..., 0]
    facts = {
        "sensor": asdict(sensor),
        "lattice": None if calibration is None else asdict(calibration.lattice),
        "field": asdict(bench.field),
        "reconstruction": asdict(bench.reconstruction),
        "view_x_m": bench.field.view_x_m.tolist(),
        "view_y_m": bench.field.view_y_m.tolist(),
        "pupil_x_m": pupil_x_m.tolist(),
        "pupil_y_m": sensor.pupil_y_m.tolist(),
    }
    return json.dumps(facts, allow_nan=False)


def _coefficients(wavefront: Wavefront) -> list[Labelled]:
    if not isinstance(solution := wavefront.solution, ModalSolution):
        return []
    return [
        ("coefficients", _MODES, "rad", solution.coefficients),
        ("coefficients_sigma", _MODES, "rad", solution.coefficients_sigma),
    ]


def _slopes(wavefront: Wavefront) -> list[Labelled]:
    displacement, per_px = wavefront.displacement, wavefront.sensor.slope_per_px
    return [
        ("slopes", _VECTORS, "rad/m", displacement.coefficients * per_px),
        ("slopes_sigma", _VECTORS, "rad/m", np.sqrt(displacement.variance) * per_px),
        ("valid", _LENSLET, "1", displacement.valid.astype(np.uint8)),
    ]


def _views(wavefront: Wavefront) -> list[Labelled]:
    return [
        ("wavefront", (*_VIEW, *_LENSLET), "rad", wavefront.views),
        ("wavefront_sigma", (*_VIEW, *_LENSLET), "rad", wavefront.sigma()),
    ]


TOPICS: dict[str, Callable[[Wavefront], list[Labelled]]] = {
    "coefficients": _coefficients,
    "slopes": _slopes,
    "views": _views,
}
