"""A stand-in on a real serial port, as far as a program can tell: a pseudo-terminal, served by a thread."""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from collections import deque
from types import TracebackType
from typing import Self

from simulated_devices.wires.serial import LineDevice

_SLICE_S = 0.005


class PtyServer:
    """Serves the device at `port` until it is closed; where the device is unplugged, the port goes with it."""

    def __init__(self, device: LineDevice) -> None:
        self._device = device
        self._master, self._slave = os.openpty()  # while the slave is held, clients may come and go
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._is_ending = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="stand-in", daemon=True)
        os.write(self._master, device.greeting())
        self._thread.start()

    def unplug(self) -> None:
        """Pull the cable."""
        self._device.is_unplugged = True
        self._thread.join()

    def close(self) -> None:
        """End the thread and remove the port; closing twice is allowed."""
        self._is_ending.set()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _serve(self) -> None:
        coming: deque[tuple[float, bytes]] = deque()
        try:
            while not self._is_ending.is_set() and not self._device.is_unplugged:
                if select.select([self._master], [], [], _SLICE_S)[0]:
                    for delay_s, answer in self._device.receive(os.read(self._master, 4096)):
                        earliest = coming[-1][0] if coming else 0.0
                        coming.append((max(earliest, time.monotonic() + delay_s), answer))
                while coming and coming[0][0] <= time.monotonic():
                    os.write(self._master, coming.popleft()[1])
        finally:
            os.close(self._slave)
            os.close(self._master)
