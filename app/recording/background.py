"""A recording that is written beside the live view: a bounded queue, and a thread that empties it onto the disk.

Whoever takes frames only puts them into the queue. When the disk cannot follow, is full or fails, the recording ends
with all that was acknowledged, says why, and the live view goes on.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from app.errors import InputError, RunError
from app.recording.record import Record
from app.recording.run_writer import RunWriter
from app.run_facts import timing_facts
from app.timing import Timings

_QUEUED_FRAMES, _QUEUED_BYTES = 512, 512e6  # at most
_SYNC_S = 1.0

Stage = Literal["recording", "finishing", "finished", "ended early"]


@dataclass(frozen=True, slots=True)
class RecordingState:
    """How a recording stands at one moment."""

    folder: Path
    stage: Stage
    frames: int  # written and acknowledged
    waiting: int  # in the queue
    seconds: float  # since it began, until it was to end
    free_minutes: float  # of recording at this rate on the disk; infinite before there is a rate
    problem: str  # why it has ended early; empty when it has not


class BackgroundRecording:
    """One recording, from the moment it begins until it is finished."""

    def __init__(
        self,
        folder: Path,
        facts: Mapping[str, Any],
        timings: Timings,
        *,
        records: Sequence[Record] = (),
        frames: int | None = None,
    ) -> None:
        """Begin with `records` from before; it ends by itself after `frames` in all, if that is given."""
        self._folder, self._facts, self._timings = folder, facts, timings
        self._waiting = deque(records)
        self._waiting_bytes = sum(record.nbytes for record in records)
        self._acquired = len(records)
        self._left = frames
        self._changed = threading.Condition()
        self._is_open = True  # for more frames
        self._problem = ""
        self._is_finished = False
        self._frames = 0
        self._free_minutes = float("inf")
        self._began_s = time.perf_counter()
        self._ended_s: float | None = None
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def take(self, record: Record) -> None:
        """Have one more frame written; at once, whatever the disk does."""
        with self._changed:
            if not self._is_open:
                return
            self._acquired += 1
            if len(self._waiting) >= _QUEUED_FRAMES or self._waiting_bytes > _QUEUED_BYTES:
                self._end(f"the disk cannot follow: {len(self._waiting)} frames are waiting for it")
                return
            self._waiting.append(record)
            self._waiting_bytes += record.nbytes
            if self._left is not None:
                self._left -= 1
                if self._left == 0:
                    self._end("")
            self._changed.notify()

    def stop(self, problem: str = "") -> None:
        """Take no more frames, and finish when those that wait are written; `problem` is why, if it is early."""
        with self._changed:
            self._end(problem)

    def join(self, timeout_s: float | None = None) -> None:
        """Wait until it is finished."""
        self._thread.join(timeout_s)

    @property
    def state(self) -> RecordingState:
        """How it stands."""
        stage: Stage = "recording" if self._is_open else "finishing"
        if self._is_finished:
            stage = "ended early" if self._problem else "finished"
        end_s = self._ended_s or time.perf_counter()
        return RecordingState(
            self._folder,
            stage,
            self._frames,
            len(self._waiting),
            end_s - self._began_s,
            self._free_minutes,
            self._problem,
        )

    def _end(self, problem: str) -> None:
        if self._is_open:
            self._is_open, self._problem, self._ended_s = False, problem, time.perf_counter()
        self._changed.notify()

    def _work(self) -> None:
        try:
            writer = RunWriter(self._folder, self._facts)
            try:
                self._write(writer)
            finally:
                writer.close()
        except (OSError, InputError, RunError) as error:
            self._fail(self._said(error))
        except Exception as error:
            self._fail(f"{type(error).__name__}: {error}")
            raise
        finally:
            self._is_finished = True

    def _write(self, writer: RunWriter) -> None:
        try:
            with ThreadPoolExecutor(1, "recorder-sync") as syncing:
                synced, synced_s = syncing.submit(writer.sync), time.perf_counter()
                for record in self._records():
                    with self._timings.of("record"):
                        writer.write(record)
                    self._frames = writer.frames
                    if synced.done() and time.perf_counter() > synced_s + _SYNC_S:
                        synced = self._sync(writer, synced, syncing)
                        synced_s = time.perf_counter()
                synced.result()
        except (OSError, InputError, RunError) as error:
            self._fail(self._said(error))
        writer.finish(self._problem, acquired=self._acquired, facts={"timings": timing_facts(self._timings)})

    def _records(self) -> Iterator[Record]:
        """The frames, as they come."""
        while True:
            with self._changed:
                while not self._waiting:
                    if not self._is_open:
                        return
                    self._changed.wait()
                record = self._waiting.popleft()
                self._waiting_bytes -= record.nbytes
            yield record

    def _sync(self, writer: RunWriter, before: Future[None], syncing: ThreadPoolExecutor) -> Future[None]:
        """Begin the next sync, so that no frame has to wait for it; a failure of the one before ends the recording."""
        before.result()
        seconds = time.perf_counter() - self._began_s
        free = shutil.disk_usage(self._folder).free
        self._free_minutes = free / (writer.bytes / seconds) / 60 if writer.bytes else float("inf")
        return syncing.submit(writer.sync)

    def _fail(self, problem: str) -> None:
        """End it early: what waits cannot be written."""
        with self._changed:
            self._is_open, self._problem = False, self._problem or problem
            self._ended_s = self._ended_s or time.perf_counter()
            self._waiting.clear()
            self._waiting_bytes = 0

    def _said(self, error: Exception) -> str:
        """A fault in words."""
        if isinstance(error, OSError):
            return f"{error.filename or self._folder}: cannot be written: {error.strerror or error}"
        return str(error)
