"""Messages about frames, for the clients of an instrument and for other programs.

The instrument's own clients get all that is cheap to know of a frame, and ask for the rest (`SHARED`, `DETAILS`).
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from app.acquisition.serialization import little_endian
from app.bench.config import Bench
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront

Labelled: TypeAlias = tuple[str, tuple[str, ...], str, NDArray[Any]]
"""Name, dimensions and units, as in NetCDF results, and values of an array."""

FORMAT = 1  # increased when subscribers must change

_VIEW = ("view_row", "view_column")
_LENSLET = ("lenslet_row", "lenslet_column")
_MODES = ("pupil_mode", "field_mode")
_VECTORS = (*_LENSLET, "field_mode", "xy")
OF_DISPLACEMENT = ("outcome", "residual_rms", "chi_square", "range_used", "absorbs")
OF_MODAL_SOLUTION = ("coefficients", "known", "freedom", "noise")
SHARED: dict[str, Callable[[Any], Any]] = {
    "calibration": lambda made: made.calibration,
    "field_modes": lambda made: made.registered and made.registered.modes,
    "pupil_modes": lambda made: getattr(made.wavefront and made.wavefront.solution, "modes", None),
    "parameters": lambda made: getattr(made.wavefront and made.wavefront.solution, "parameters", None),
}
"""Large parts of a measurement that many have in common: a client asks for each of them once."""

DETAILS: dict[str, Callable[[Any], Any]] = {
    "sigma": lambda made: made.wavefront.sigma(),
    "covariance": lambda made: made.wavefront.displacement.covariance,
    "transmission": lambda made: made.wavefront.displacement.transmission,
    "root_covariance": lambda made: made.wavefront.solution.root_covariance,
    "fitted": lambda made: made.wavefront.solution.fitted(),
}
"""Parts that a client asks for if it needs them: to compute or to send them costs milliseconds."""


class OwnFrame(NamedTuple):
    """A measurement for the instrument's clients, which ask for its other parts."""

    lean: Measurement  # without wavefront, displacements and calibration
    is_shown_only: bool  # a routine's frame
    shared: dict[str, int]  # of each shared part that it has, the count of the first record with the same
    arrays: dict[str, Any]  # of displacements and wavefront, if it has them


def own_frame(measurement: Measurement, shared: dict[str, int], *, is_shown_only: bool) -> OwnFrame:
    """Return what clients of the instrument get of a measurement at once."""
    lean = replace(measurement, wavefront=None, registered=None, calibration=None)
    wavefront, registered, arrays = measurement.wavefront, measurement.registered, dict[str, Any]()
    if wavefront is not None and registered is not None:
        solution = wavefront.solution
        arrays = {name: getattr(registered, name) for name in OF_DISPLACEMENT}
        arrays |= {"wavefront": wavefront.views, "displacement": registered.coefficients}
        if isinstance(solution, ModalSolution):
            arrays |= {name: getattr(solution, name) for name in OF_MODAL_SOLUTION}
        else:
            arrays["weights"] = solution.weights
    return OwnFrame(lean, is_shown_only, shared, arrays)


def topic_message(topic: str, sequence: int, measurement: Measurement, bench: Bench, facts: str) -> list[bytes]:
    """Return the parts of a message for other programs; empty if the method has no such arrays.

    `sequence` counts all measurements offered for publication; `facts` are `calibration_facts`. A frame without a
    wavefront has no arrays, but a `problem`.
    """
    labelled = [] if measurement.wavefront is None else TOPICS[topic](measurement.wavefront)
    if measurement.wavefront is not None and not labelled:
        return []
    arrays = [little_endian(values) for _, _, _, values in labelled]
    layout = [
        {"name": name, "dimensions": dimensions, "units": units, "dtype": each.dtype.str, "shape": each.shape}
        for (name, dimensions, units, _), each in zip(labelled, arrays, strict=True)
    ]
    header = {"format": FORMAT, "sequence": sequence, **_frame_facts(measurement, bench), "arrays": layout}
    text = json.dumps(header, separators=(",", ":"), allow_nan=False)
    return [topic.encode(), f"{text[:-1]},{facts[1:]}".encode(), *(each.tobytes() for each in arrays)]


def _frame_facts(measurement: Measurement, bench: Bench) -> dict[str, Any]:
    frame, (sample, refinement, _) = measurement.frame, measurement.assumed
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
