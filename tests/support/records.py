"""Recordings of noise for tests of writing and reading."""

from __future__ import annotations

import json
import math
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from app.bench.config import Bench
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.measurement.measurement import Assumptions, LightState, Measurement, RefinementState
from app.recording.recorder import BackgroundRecording, Recorder, RecordingState
from app.recording.writer import Record, RecordingWriter
from drivers.interface import Frame
from reconstruction.arrays import Floats
from support.optics import FIELD, SmallBench
from support.patience import HANG_S

SHAPE = (6, 10)
RANDOM = np.random.default_rng(7)
FACTS = {"command": "live", "bench": "", "devices": {"camera": {"name": "none"}}}


def make_frame(index: int, shape: tuple[int, int] = SHAPE) -> Frame:
    pixels = RANDOM.integers(0, 65536, shape).astype(np.uint16)
    return Frame(
        pixels=pixels,
        index=index,
        camera_time_s=100 + index / 70,
        host_time_s=200 + index / 70,
        exposure_s=0.0139,
        em_gain=8.0,
    )


def make_record(index: int, calibration: Calibration | None = None, **changes: Any) -> Record:
    """Return a record of noise, with results if it has a calibration."""
    has = calibration is not None
    refinement = RefinementState(age_s=changes.pop("bias_age_s", 0.0), bias=changes.pop("bias", None))
    of_arrays = {field.name for field in fields(Record)}
    measurement = Measurement(
        frame=make_frame(index),
        wavefront=None,
        problem="" if has else "no reference yet",
        calibration=calibration,
        assumed=Assumptions(None, refinement),
        light=LightState(is_on=True, current_a=0.35),
    )
    record = Record(
        replace(measurement, **{name: value for name, value in changes.items() if name not in of_arrays}),
        displacement=RANDOM.normal(size=(7, 9, 3, 2)) if has else None,
        coefficients=RANDOM.normal(size=(15, 3)) if has else None,
        rms_rad=0.5 if has else math.nan,
        valid=63 if has else None,
    )
    return replace(record, **{name: value for name, value in changes.items() if name in of_arrays})


def make_records(calibration: Calibration, count: int) -> list[Record]:
    return [make_record(index, calibration) for index in range(count)]


def write(folder: Path, records: list[Record], *, finish: bool = True) -> RecordingWriter:
    writer = RecordingWriter(folder, FACTS)
    for record in records:
        writer.write(record)
    if finish:
        writer.finish("", acquired=len(records), facts={})
    writer.close()
    return writer


def frame_file(folder: Path, index: int, array: str = "0") -> Path:
    """Return the file of one frame, after giving each frame of the array its own, as version 0.3 did."""
    path = folder / "frames.zarr" / array
    metadata = json.loads((path / "zarr.json").read_text())
    in_chunk, *shape = metadata["chunk_grid"]["configuration"]["chunk_shape"]
    separator = metadata["chunk_key_encoding"]["configuration"]["separator"]

    def file(number: int) -> Path:
        name: str = separator.join(("c", str(number), *("0" for _ in shape)))
        return path / name

    if in_chunk > 1:
        size = math.prod(shape) * np.dtype(metadata["data_type"]).itemsize
        numbers = range(-(-metadata["shape"][0] // in_chunk))
        chunks = {number: file(number).read_bytes() for number in numbers if file(number).exists()}
        metadata["chunk_grid"]["configuration"]["chunk_shape"][0] = 1
        (path / "zarr.json").write_text(json.dumps(metadata))
        for number in chunks:
            file(number).unlink()
        for number, held in chunks.items():
            for place in range(min(len(held) // size, metadata["shape"][0] - number * in_chunk)):
                one = file(number * in_chunk + place)
                one.parent.mkdir(parents=True, exist_ok=True)
                one.write_bytes(held[place * size : (place + 1) * size])
    return file(index)


def wait(recording: BackgroundRecording | Recorder, stages: set[str]) -> RecordingState:
    deadline_s = time.monotonic() + HANG_S
    while (state := recording.state) is None or state.stage not in stages:
        assert time.monotonic() < deadline_s
        time.sleep(0.005)
    return state


def noisy_calibration(small_bench: SmallBench) -> Calibration:
    """Return a calibration with noise in its averages, so that every bit matters."""
    random = np.random.default_rng(1)

    def average(mean: Floats, frames: int) -> Average:
        noise = random.normal(0, 3, (2, *mean.shape))
        variance = 400 + mean + noise[1]
        return Average((mean + noise[0]).astype("f4"), variance.astype("f4"), frames, 0.02, 8.0, "em")

    bench = Bench(sensor=small_bench.sensor, field=FIELD)
    light = np.asarray(small_bench.reference * 3000 / small_bench.reference.max(), np.float64)
    dark = average(np.full(light.shape, 500.0), 9)
    return Calibration(
        bench=bench, dark=dark, reference=average(light + 500, 7), lattice=small_bench.lattice, full_scale=65535.0
    )
