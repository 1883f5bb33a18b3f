"""Durations of the live-path benchmark, and the temporary folder of its recording."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from app.bench.config import Bench
from app.errors import InputError, ended_by
from app.progress import Progress
from app.recording.recorder import RECENT_S
from reconstruction.settings import FIELD_MODES

LEAST_S, MOST_S = 1.0, 3600.0
_WITHOUT_WINDOW_S = 20.0  # at most
_MEMORY_S = 50.0  # at the end of the run, at most
_MOST_FIELD_MODES = max(FIELD_MODES.values())
_BLOCKS_BYTES = 4 * 4096  # overhead of a frame's folder, files and line
_MORE_FRAMES = 50  # equivalent of dark, reference and files written once
_MARGIN = 1.1


@dataclass(frozen=True, slots=True, kw_only=True)
class LivePlan:
    """A simulated bench, measured for some seconds after the warm-up."""

    bench: Bench
    seconds: float
    record_in: Path | None  # folder of the temporary recording; None for none
    with_panels: bool = False  # coefficients, history and histogram are open beside the window
    warm_up_s: float = RECENT_S + 2.0  # until the memory is full of recent frames

    def __post_init__(self) -> None:
        if not LEAST_S <= self.seconds <= MOST_S:
            raise InputError(f"--live {self.seconds:g}: must be {LEAST_S:g} ... {MOST_S:g} seconds")
        if not self.bench.is_simulated:
            raise InputError(f"--live runs the simulated camera; this bench has {self.bench.camera.driver}")

    @property
    def without_window_s(self) -> float:
        """Duration of the run without window and recording."""
        return min(_WITHOUT_WINDOW_S, self.seconds / 3)

    @property
    def memory_s(self) -> float:
        """Duration at the end over which the memory must not grow."""
        return min(_MEMORY_S, self.seconds * 5 / 6)

    @property
    def recording_bytes(self) -> float:
        """Estimated maximum size of the recording."""
        camera, sensor = self.bench.camera_model, self.bench.sensor
        pixels = camera.rows * camera.columns * 2
        displacements = sensor.lenslet_rows * sensor.lenslet_columns * _MOST_FIELD_MODES * 2 * 8
        frames = (self.warm_up_s + self.seconds) / camera.exposure_s + _MORE_FRAMES
        return frames * (pixels + displacements + _BLOCKS_BYTES) * _MARGIN


@contextmanager
def recording_folder(plan: LivePlan, progress: Progress) -> Iterator[Path | None]:
    """Give a new folder for the recording and remove it at the end; None without a recording.

    Raises
    ------
    InputError
        If the plan's folder is missing, not writable or too small.
    """
    where = plan.record_in
    if where is None:
        yield None
        return
    if not where.is_dir():
        raise InputError(f"{where}: no such folder")
    free, needed = shutil.disk_usage(where).free, plan.recording_bytes
    if free < needed:
        raise InputError(
            f"{where}: the recording takes up to {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free:"
            " name a folder on another disk with --record-in, or give --no-record"
        )
    try:
        folder = Path(tempfile.mkdtemp(prefix="svwfs-benchmark-", dir=where))
    except OSError as error:
        raise InputError(f"{where}: not writable: {error.strerror or error}") from error
    try:
        yield folder / "recording"
    finally:
        with ended_by(lambda *_: None):  # a second Ctrl-C must not interrupt the removal
            progress("removing the recording", 1.0)
            shutil.rmtree(folder)
