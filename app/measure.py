"""The instrument without a screen: dark, reference, sample in, so many frames, results; what `svwfs measure` does."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path

import xarray as xr

from app.acquisition import Acquisition, Measurement
from app.config import Bench
from app.devices import open_devices
from app.errors import RunError
from app.files import write_image
from app.results import result_dataset, stack_frames, write_results
from app.start_up import start_up

Report = Callable[[str, float], None]  # what is being done, and how much of it: 0 ... 1

_POLL_S = 0.05
AVERAGED_FRAMES = 20


@dataclass(slots=True)
class Collected:
    """The results so far, in the order of the frames."""

    wanted: int
    bench: Bench
    datasets: list[xr.Dataset] = field(default_factory=list)
    frame_index: list[int] = field(default_factory=list)
    time_s: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    lost: int = 0
    complete: threading.Event = field(default_factory=threading.Event)

    def __call__(self, measurement: Measurement) -> None:
        """Take one more result from the worker."""
        if self.complete.is_set():
            return
        self.lost = measurement.counts.lost
        if measurement.wavefront is None:
            self.problems.append(measurement.problem)
        else:
            self.datasets.append(result_dataset(measurement.wavefront, self.bench))
            self.frame_index.append(measurement.frame.index)
            self.time_s.append(measurement.frame.camera_time_s)
        if len(self.datasets) + len(self.problems) >= self.wanted:
            self.complete.set()
