"""Publisher of the instrument's measurements: writes the newest into a ring in shared memory for the clients."""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Lock

from app.acquisition.remote.messages import NewFrame, RingRecord, SharedObjects
from app.acquisition.remote.ring import RingWriter
from app.acquisition.remote.serialization import Encoded
from app.measurement.measurement import Measurement

_SPARE = 1.5  # a slot's size over that of the first record which needs it


class FramePublisher:
    """Writes measurements into the ring, as often as the fastest client reads."""

    def __init__(self, ring_file: Path, shared_objects: SharedObjects, notify: Callable[[], object]) -> None:
        """`notify` is called after each record; `ring_file` names the ring where memory needs a name."""
        self.pause_s = math.inf  # of the client that reads most often
        self._ring_file, self._shared_objects, self._notify = ring_file, shared_objects, notify
        self._published = 0  # number of measurements
        self._unwritten: deque[tuple[int, Measurement, bool]] = deque(maxlen=1)  # number; whether it is shown only
        self._written_s = -math.inf
        self._ring: RingWriter | None = None
        self._older_rings: deque[RingWriter] = deque()
        self._writing = Lock()

    @property
    def newest(self) -> NewFrame:
        """The newest record."""
        return NewFrame("", 0) if (ring := self._ring) is None else NewFrame(ring.name, ring.count)

    def take(self, measurement: Measurement) -> None:
        """Publish a measurement; called by the worker."""
        self._publish(measurement, is_shown_only=False)

    def show(self, measurement: Measurement) -> None:
        """Publish a routine's frame, which clients only show; called by the worker."""
        self._publish(measurement, is_shown_only=True)

    def _publish(self, measurement: Measurement, *, is_shown_only: bool) -> None:
        """Write a measurement into the ring, unless a newer one follows at once."""
        if not measurement.is_skipped:
            self._published += 1
            self._unwritten.append((self._published, measurement, is_shown_only))
            self.write_if_due()

    def write_if_due(self) -> None:
        """Write twice as often as a client reads, so that it reads what is new: each frame takes milliseconds."""
        if time.monotonic() >= self._written_s + self.pause_s / 2:
            self.write()

    def write(self) -> None:
        """Write the newest measurement into the ring, if that has not been done."""
        with self._writing:
            try:
                number, measurement, is_shown_only = self._unwritten.pop()
            except IndexError:
                return
            lean = replace(measurement, wavefront=None)
            record = RingRecord(lean, is_shown_only)
            encoded = Encoded(record, self._shared_objects.number)
            if self._ring is None or not self._ring.has_room_for(encoded):
                if self._ring is not None:
                    self._older_rings.append(self._ring)  # the newest: a reader may be about to open it
                    while len(self._older_rings) > 1:
                        self._older_rings.popleft().close()
                self._ring = RingWriter(int(_SPARE * encoded.nbytes), self._ring_file, count=number - 1)
            self._ring.write(encoded, number)
            self._written_s = time.monotonic()
        self._notify()

    def close(self) -> None:
        """Give the memory back; readers that have it open keep what they have."""
        for ring in (*self._older_rings, *([self._ring] if self._ring else [])):
            ring.close()
