"""The instrument without a window: dark, reference, sample in, so many frames, results; `svwfs measure`."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from app.acquisition import Acquisition, Measurement
from app.config import Bench
from app.devices import open_devices
from app.errors import Interrupted, RunError
from app.files import make_folder, write_image
from app.instrument import Instrument
from app.measurement import PASSED_OVER
from app.results import result_dataset, stack_frames, write_results
from app.run_record import write_run
from app.start_up import start_up
from drivers.interface import DeviceError
from reconstruction.wavefront import Wavefront

Report = Callable[[str, float], None]  # what is being done, and how much of it, 0 ... 1

_POLL_S = 0.05


@dataclass(slots=True)
class Collected:
    """The results of the first `wanted` frames."""

    bench: Bench
    wanted: int
    wavefronts: list[Wavefront] = field(default_factory=list)
    frame_index: list[int] = field(default_factory=list)
    time_s: list[float] = field(default_factory=list)
    bias_age_s: list[float] = field(default_factory=list)  # of the refinement; NaN where the frame is not refined
    problems: list[str] = field(default_factory=list)
    lost: int = 0
    complete: threading.Event = field(default_factory=threading.Event)

    @property
    def taken(self) -> int:
        """How many frames have come, reconstructed or not."""
        return len(self.wavefronts) + len(self.problems)

    def take(self, measurement: Measurement) -> None:
        """Take one more result from the worker, as long as more are wanted."""
        if self.complete.is_set() or measurement.refinement.stage == "preparing" or measurement.problem == PASSED_OVER:
            return
        self.lost = measurement.counts.lost
        if measurement.wavefront is None:
            self.problems.append(measurement.problem)
        else:
            self.wavefronts.append(measurement.wavefront)
            self.frame_index.append(measurement.frame.index)
            self.time_s.append(measurement.frame.camera_time_s)
            refinement = measurement.refinement
            self.bias_age_s.append(refinement.age_s if refinement.stage == "applied" else math.nan)
        if self.taken >= self.wanted:
            self.complete.set()


def measure(bench: Bench, frames: int, out: Path, report: Report) -> Collected:
    """Measure `frames` frames and write dark, reference and results into the folder `out`.

    Whatever ends it early, Ctrl-C among others, what has been measured is written first. A device that fails is a
    `RunError`, a bench that cannot be is an `InputError`.
    """
    make_folder(out)
    collected = Collected(bench, frames)
    acquisition = Acquisition(bench, open_devices, sinks=(collected.take,))
    acquisition.start()
    is_stopped = False
    try:
        _take_calibration(acquisition, out, report)
        while acquisition.is_alive and not collected.complete.wait(_POLL_S):
            report(f"measuring {frames} frames", collected.taken / frames)
    except Interrupted:
        is_stopped = True
    except DeviceError as error:
        raise _as_reported(acquisition.error or error) from error
    finally:
        acquisition.close()
        if collected.wavefronts:
            datasets = [result_dataset(wavefront, bench) for wavefront in collected.wavefronts]
            results = stack_frames(datasets, collected.frame_index, collected.time_s, collected.bias_age_s)
            names = {"dark": "dark.tif", "reference": "reference.tif"}
            write_results(out / "results.nc", results, bench=bench, inputs=names)
            write_run(out / "run.json", "measure", acquisition)
    if is_stopped:
        raise Interrupted(f"stopped: {len(collected.wavefronts)} of {frames} frames are in {out}")
    if acquisition.error is not None:
        raise _as_reported(acquisition.error) from acquisition.error
    if not collected.wavefronts:
        raise RunError(f"no frame could be reconstructed: {collected.problems[0]}")
    report(f"measuring {frames} frames", 1.0)
    return collected


def _as_reported(error: Exception) -> Exception:
    """A device's error as the failure that ends a command; any other as it is."""
    return RunError(str(error)) if isinstance(error, DeviceError) else error


def _take_calibration(acquisition: Acquisition, out: Path, report: Report) -> None:
    """Take dark and reference, write them, and go live."""
    for step in start_up(acquisition):
        while not step.done():
            report(acquisition.activity.text, acquisition.activity.progress)
            time.sleep(_POLL_S)
        step.result()
    acquisition.submit(lambda instrument: _write_calibration(instrument, out)).result()


def _write_calibration(instrument: Instrument, out: Path) -> None:
    for name, average in (("dark", instrument.dark), ("reference", instrument.reference)):
        if average is not None:
            write_image(out / f"{name}.tif", average.mean)
