"""Messages to other programs: topic, JSON header, and arrays as bytes."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.measurement.measurement import Measurement
from reconstruction.geometry import Sensor
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront

FORMAT = 1  # increased when subscribers must change

_VIEW = ("view_row", "view_column")
_LENSLET = ("lenslet_row", "lenslet_column")


Labelled = tuple[str, tuple[str, ...], str, NDArray[Any]]  # name, dimensions and units as in NetCDF results, values


def message(topic: str, sequence: int, measurement: Measurement, bench: Bench) -> list[bytes]:
    """Return the parts of one measurement's message; empty if the method has no such arrays.

    `sequence` counts all measurements offered for publication. A frame without a wavefront has no arrays, but a
    `problem`.
    """
    wavefront = measurement.wavefront
    arrays = [] if wavefront is None else TOPICS[topic](wavefront, bench.sensor)
    if wavefront is not None and not arrays:
        return []
    parts = [np.ascontiguousarray(values, values.dtype.newbyteorder("<")) for *_, values in arrays]
    layout = [
        {"name": name, "dtype": part.dtype.str, "shape": part.shape, "dimensions": dimensions, "units": units}
        for (name, dimensions, units, _), part in zip(arrays, parts, strict=True)
    ]
    header = {
        "format": FORMAT,
        "sequence": sequence,
        **_frame_facts(measurement),
        "arrays": layout,
        **_facts(measurement, bench),
    }
    return [topic.encode(), json.dumps(header, allow_nan=False).encode(), *(part.tobytes() for part in parts)]


def _frame_facts(measurement: Measurement) -> dict[str, Any]:
    frame, refinement = measurement.frame, measurement.assumed.refinement
    unix_s = time.time() - time.perf_counter()  # calendar time at which perf_counter is zero
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
    }


def _facts(measurement: Measurement, bench: Bench) -> dict[str, Any]:
    """Header entries on calibration and sample, which give axes, units and wavefronts their meaning."""
    calibration, sample, layers = measurement.calibration, measurement.assumed.sample, None
    if calibration is not None:
        bench = calibration.bench
    sensor, focal_length_m = bench.sensor, bench.field.collimator_focal_length_m
    if sample is not None:  # else layers have not been searched for
        layers = [
            {"distance_m": -ratio * focal_length_m, "distance_sigma_m": sigma * focal_length_m}
            for ratio, sigma in zip(sample.ratios, sample.sigma.tolist(), strict=True)
        ]
    pupil_x_m = sensor.pupil_x_m if sensor.arrangement == "square" else sensor.lenslet_centers_m[..., 0]
    return {
        "sensor": asdict(sensor),
        "lattice": None if calibration is None else asdict(calibration.lattice),
        "field": asdict(bench.field),
        "reconstruction": asdict(bench.reconstruction),
        "layers": layers,
        "view_x_m": bench.field.view_x_m.tolist(),
        "view_y_m": bench.field.view_y_m.tolist(),
        "pupil_x_m": pupil_x_m.tolist(),
        "pupil_y_m": sensor.pupil_y_m.tolist(),
    }


def _coefficients(wavefront: Wavefront, _: Sensor) -> list[Labelled]:
    if not isinstance(wavefront.solution, ModalSolution):
        return []
    modes = ("pupil_mode", "field_mode")
    return [
        ("coefficients", modes, "rad", wavefront.solution.coefficients),
        ("coefficients_sigma", modes, "rad", wavefront.solution.coefficients_sigma),
    ]


def _slopes(wavefront: Wavefront, sensor: Sensor) -> list[Labelled]:
    displacement, per_px = wavefront.displacement, sensor.slope_per_px
    vectors = (*_LENSLET, "field_mode", "xy")
    return [
        ("slopes", vectors, "rad/m", displacement.coefficients * per_px),
        ("slopes_sigma", vectors, "rad/m", np.sqrt(displacement.variance) * per_px),
        ("valid", _LENSLET, "1", displacement.valid.astype(np.uint8)),
    ]


def _views(wavefront: Wavefront, _: Sensor) -> list[Labelled]:
    return [
        ("wavefront", (*_VIEW, *_LENSLET), "rad", wavefront.views),
        ("wavefront_sigma", (*_VIEW, *_LENSLET), "rad", wavefront.sigma()),
    ]


TOPICS: dict[str, Callable[[Wavefront, Sensor], list[Labelled]]] = {
    "coefficients": _coefficients,
    "slopes": _slopes,
    "views": _views,
}
