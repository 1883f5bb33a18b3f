"""Recorder of live frames: keeps the last seconds, and writes recordings in the background.

Frames go through a bounded queue to a thread that writes them. If the disk is full, too slow or fails, the recording
ends with what was written and says why; the live view continues.
"""

import math
import shutil
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from app.errors import InputError, RunError
from app.files import nearest_existing
from app.measurement.measurement import Gap, Measurement
from app.recording.folder import check_free, new_folder
from app.recording.writer import Record, RecordingWriter
from app.run_facts import timing_facts
from app.timing import Timings
from drivers.interface import WrongState

RECENT_S = 10.0
_RECENT_BYTES = 1e9
_QUEUED_FRAMES, _QUEUED_BYTES = 512, 512e6
_SYNC_S = 1.0

RecordingStage = Literal["recording", "finishing", "finished", "ended early"]


@dataclass(frozen=True, slots=True)
class RecordingLimit:
    """Limits that end a recording: its number of frames, or the time after its first; None: no limit."""

    frames: int | None = None
    seconds: float | None = None


NO_LIMIT = RecordingLimit()


@dataclass(frozen=True, slots=True)
class RecordingState:
    """Progress of a recording."""

    folder: Path
    stage: RecordingStage
    frames: int  # written
    waiting: int  # in the queue
    seconds: float  # duration of the recording so far
    problem: str  # why it ended early; empty if it did not
    gaps: tuple[Gap, ...] = ()  # in which the camera stood

    @property
    def is_over(self) -> bool:
        """True once all its files are written, also if it ended early."""
        return self.stage in {"finished", "ended early"}


class BackgroundRecording:
    """One recording and the thread that writes it, started at once.

    `records` are written first; what frames `like` an earlier one need is there before them. `limit` counts the frames
    after the records, and can be replaced at any time.
    """

    def __init__(
        self,
        folder: Path,
        facts: Mapping[str, Any],
        timings: Timings,
        *,
        records: Sequence[Record] = (),
        like: Record | None = None,
        limit: RecordingLimit = NO_LIMIT,
    ) -> None:
        self._folder, self._facts, self._timings, self._like = folder, facts, timings, like
        self._waiting = deque(records)
        self._waiting_bytes = sum(record.nbytes for record in records)
        self._acquired = len(records)
        self.limit = limit
        self._taken = 0
        self._first_s: float | None = None  # arrival of the first frame that was taken
        self._changed = threading.Condition()
        self._is_open, self._is_finished, self._problem = True, False, ""  # open for more frames
        self._frames, self._gaps = 0, tuple[Gap, ...]()
        self._began_s = time.perf_counter()
        self._ended_s: float | None = None
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def take(self, record: Record) -> None:
        """Queue a frame; never waits for the disk."""
        with self._changed:
            if not self._is_open:
                return
            self._first_s = record.made.frame.host_time_s if self._first_s is None else self._first_s
            if self._is_beyond_limit(record):
                self._end("")
                return
            self._acquired += 1
            if len(self._waiting) >= _QUEUED_FRAMES or self._waiting_bytes > _QUEUED_BYTES:
                self._end(f"the disk cannot follow: {len(self._waiting)} frames are waiting for it")
                return
            self._waiting.append(record)
            self._waiting_bytes += record.nbytes
            self._taken += 1
            if self.limit.frames is not None and self._taken >= self.limit.frames:
                self._end("")
            self._changed.notify()

    def stop(self, problem: str = "") -> None:
        """End the recording once the queue is written; `problem` says why, if early."""
        with self._changed:
            self._end(problem)

    def join(self, timeout_s: float | None = None) -> None:
        """Wait until it is finished."""
        self._thread.join(timeout_s)

    @property
    def state(self) -> RecordingState:
        """Present state."""
        stage: RecordingStage = "recording" if self._is_open else "finishing"
        if self._is_finished:
            stage = "ended early" if self._problem else "finished"
        seconds = (self._ended_s or time.perf_counter()) - self._began_s
        return RecordingState(
            folder=self._folder,
            stage=stage,
            frames=self._frames,
            waiting=len(self._waiting),
            seconds=seconds,
            problem=self._problem,
            gaps=self._gaps,
        )

    def _is_beyond_limit(self, record: Record) -> bool:
        """Return whether a frame comes too late; the limit may have been lowered below what was taken."""
        frames, seconds = self.limit.frames, self.limit.seconds
        is_late = seconds is not None and record.made.frame.host_time_s - (self._first_s or 0.0) > seconds
        return is_late or (frames is not None and self._taken >= frames)

    def _end(self, problem: str) -> None:
        if self._is_open:
            self._is_open, self._problem, self._ended_s = False, problem, time.perf_counter()
        self._changed.notify()

    def _work(self) -> None:
        try:
            with closing(RecordingWriter(self._folder, self._facts)) as writer:
                self._write(writer)
        except (OSError, InputError, RunError) as error:
            self._fail(self._in_words(error))
        except Exception as error:
            self._fail(f"{type(error).__name__}: {error}")
            raise
        finally:
            self._is_finished = True

    def _write(self, writer: RecordingWriter) -> None:
        try:
            if self._like is not None:
                writer.prepare(self._like)
            with ThreadPoolExecutor(1, "recorder-sync") as syncing:
                synced, synced_s = syncing.submit(writer.sync), time.perf_counter()
                for record in self._records():
                    with self._timings.of("record"):
                        writer.write(record)
                    self._frames, self._gaps = writer.frames, tuple(writer.gaps)
                    if synced.done() and time.perf_counter() > synced_s + _SYNC_S:
                        synced.result()  # raises its error
                        synced, synced_s = syncing.submit(writer.sync), time.perf_counter()
                synced.result()
        except (OSError, InputError, RunError) as error:
            self._fail(self._in_words(error))
        writer.finish(self._problem, acquired=self._acquired, facts={"timings": timing_facts(self._timings.summary())})

    def _records(self) -> Iterator[Record]:
        while True:
            with self._changed:
                while not self._waiting:
                    if not self._is_open:
                        return
                    self._changed.wait()
                record = self._waiting.popleft()
                self._waiting_bytes -= record.nbytes
            yield record

    def _fail(self, problem: str) -> None:
        """End the recording early and drop the queue."""
        with self._changed:
            self._is_open, self._problem = False, self._problem or problem
            self._ended_s = self._ended_s or time.perf_counter()
            self._waiting.clear()
            self._waiting_bytes = 0

    def _in_words(self, error: Exception) -> str:
        if isinstance(error, OSError):
            return f"{error.filename or self._folder}: cannot be written: {error.strerror or error}"
        return str(error)


class Recorder:
    """Recorder of one acquisition, whose worker thread passes every measurement to `take`."""

    def __init__(self, timings: Timings) -> None:
        self._timings = timings
        self._recent: deque[Record] = deque()
        self._recent_bytes = 0
        self._recording: BackgroundRecording | None = None
        self._kept: BackgroundRecording | None = None
        self._changing = threading.Lock()

    def take(self, measurement: Measurement) -> None:
        """Keep a measurement and record it if a recording is on; never waits for the disk."""
        record = Record.of(measurement)
        with self._changing:
            self._recent.append(record)
            self._recent_bytes += record.nbytes
            oldest_s = record.made.frame.host_time_s - RECENT_S
            while self._recent[0].made.frame.host_time_s < oldest_s or self._recent_bytes > _RECENT_BYTES:
                self._recent_bytes -= self._recent.popleft().nbytes
            if self._recording is not None:
                self._recording.take(record)

    def start(
        self, folder: Path, facts: Mapping[str, Any], *, limit: RecordingLimit = NO_LIMIT, may_rename: bool = False
    ) -> None:
        """Record from the next measurement on, until `stop` or a `limit`.

        `facts` of bench and devices go into `run.json`. With `may_rename` a number is appended to a name that is taken;
        `state` has the folder. `InputError` if the folder holds a recording, or a recording is on.
        """
        if limit.frames is not None and limit.frames < 1:
            raise InputError(f"{limit.frames} frames cannot be recorded: at least 1 is needed")
        if not may_rename:
            check_free(folder)
        with self._changing:
            if self._recording is not None and not self._recording.state.is_over:
                raise InputError(f"{self._recording.state.folder}: is still being recorded")
            folder = new_folder(folder) if may_rename else folder
            like = self._recent[-1] if self._recent else None
            self._timings.forget_longest()
            self._recording = BackgroundRecording(folder, facts, self._timings, like=like, limit=limit)

    def limit(self, limit: RecordingLimit) -> None:
        """Replace the limit of the recording, if one is on."""
        if self._recording is not None:
            self._recording.limit = limit

    def stop(self, problem: str = "") -> None:
        """End the recording, if one is on; it is finished soon after."""
        if self._recording is not None:
            self._recording.stop(problem)

    def keep_recent(self, folder: Path, facts: Mapping[str, Any], *, may_rename: bool = False) -> None:
        """Write the last seconds as a recording of their own; parameters as of `start`."""
        if not may_rename:
            check_free(folder)
        with self._changing:
            if self._kept is not None and not self._kept.state.is_over:
                raise InputError(f"{self._kept.state.folder}: is still being written")
            if not self._recent:
                raise InputError("there is no frame yet that could be saved")
            folder = new_folder(folder) if may_rename else folder
            self._kept = BackgroundRecording(folder, facts, Timings(), records=tuple(self._recent))
            self._kept.stop()

    def forget_recent(self) -> None:
        """Drop the last seconds, because the next frames will be of another kind."""
        with self._changing:
            self._recent.clear()
            self._recent_bytes = 0

    def close(self, problem: str) -> None:
        """End and finish all recordings; `problem` says why, if early."""
        self.stop(problem)
        for recording in (self._recording, self._kept):
            if recording is not None:
                recording.join()

    @property
    def state(self) -> RecordingState | None:
        """State of the present or last recording; None before the first."""
        return None if self._recording is None else self._recording.state

    @property
    def kept_state(self) -> RecordingState | None:
        """State of the last `keep_recent`; None before the first."""
        return None if self._kept is None else self._kept.state

    def require_none(self, why: str) -> None:
        """Raise `WrongState` with this reason during a recording."""
        if (state := self.state) is not None and state.stage == "recording":
            raise WrongState(why)

    def free_minutes(self, folder: Path) -> float:
        """Time until a folder's disk is full at this rate, or infinite; slow on a network disk, `OSError` on faults."""
        with self._changing:
            arrivals_s = [record.made.frame.host_time_s for record in self._recent]
            nbytes = self._recent_bytes
        spanned_s = arrivals_s[-1] - arrivals_s[0] if arrivals_s else 0.0
        if spanned_s <= 0:
            return math.inf
        return shutil.disk_usage(nearest_existing(folder)).free / (nbytes / spanned_s) / 60
