"""Recordings of the small simulated bench, made in one thread so that no frame is skipped on a busy computer."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Collection
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument
from app.bench.config import Bench, load_bench, write_bench
from app.recording.folder import PIXELS, STORE
from app.recording.frame_lines import checksum
from app.recording.reader import Recording
from app.recording.writer import Record, RecordingWriter
from reconstruction.runtime.threads import one_blas_thread
from support.patience import HANG_S
from support.records import frame_file


def _facts(bench: Bench, instrument: Instrument) -> dict[str, Any]:
    return {"command": "measure", "bench": write_bench(bench), "devices": instrument.properties()}


def record(
    toml: Path, folder: Path, *settings: str, frames: int = 12, before: int = 0, passed_over: Collection[int] = ()
) -> Recording:
    """Record some frames, after `before` unrecorded ones; if the bench refines, from the first refined frame on."""
    bench = load_bench(toml, settings)
    with (
        one_blas_thread(),
        open_devices(bench, lambda _: None) as devices,
        closing(Instrument(devices, bench)) as instrument,
        closing(RecordingWriter(folder, _facts(bench, instrument))) as writer,
    ):
        devices.light.set_on(True)
        instrument.take_dark(4)
        instrument.take_reference(4)
        devices.stage.set_sample_in(True)
        devices.camera.start()
        for _ in range(before):
            assert not instrument.measure(devices.camera.read(10)).problem
        deadline_s = time.monotonic() + HANG_S
        while writer.frames < frames:
            assert time.monotonic() < deadline_s
            frame = devices.camera.read(10)
            if writer.frames in passed_over:
                made = instrument.skip(frame)
            else:
                made = instrument.measure(frame)
                assert not made.problem
            sample, refinement, _ = made.assumed
            if sample is not None and (not bench.reconstruction.refine or refinement.stage == "applied"):
                writer.write(Record.of(made))
        writer.finish("", acquired=frames, facts={})
    return Recording(folder)


def edit_line(recording: Recording, index: int, **changes: Any) -> None:
    """Change the line of a frame."""
    path = recording.folder / "frames.jsonl"
    lines = path.read_text().splitlines()
    lines[index] = json.dumps({**json.loads(lines[index]), **changes})
    path.write_text("".join(line + "\n" for line in lines), newline="\n")


def replace_pixels(recording: Recording, index: int, pixels: NDArray[np.uint16]) -> None:
    """Change the pixels of a frame, as if these had been recorded."""
    replace_values(recording, index, PIXELS, pixels)
    path = recording.folder / "frames.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    lines[index] = re.sub('"crc32": "[0-9a-f]{8}"', f'"crc32": "{checksum(pixels)}"', lines[index])
    path.write_text("".join(lines), newline="\n")


def replace_values(recording: Recording, index: int, name: str, values: NDArray[Any]) -> None:
    """Change the recorded values of a frame in an array."""
    frames = zarr.open_group(recording.folder / STORE, mode="r+")[name]
    assert isinstance(frames, zarr.Array)
    frames[index] = values


def remove_coefficients(recording: Recording, index: int) -> None:
    """Remove the coefficients of a frame with the first calibration."""
    frame_file(recording.folder, index, "results/0/coefficients").unlink()
