"""Serial stand-in on a pseudo-terminal, which programs take for a serial port."""

import os
import select
import threading
import time
from collections import deque
from typing import Self

from support.posix import tty
from support.stand_ins.serial import LineDevice

_SLICE_S = 0.005


class PtyServer:
    """Thread that serves the device at `port` until it is closed or unplugged, which removes the port."""

    def __init__(self, device: LineDevice) -> None:
        self._device = device
        self._master, self._slave = os.openpty()  # while the slave is open, clients may come and go
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.idle_s = 0.0  # time spent waiting for commands; stops while this thread is stalled
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

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self) -> None:
        pending: deque[tuple[float, bytes]] = deque()
        try:
            while not self._is_ending.is_set() and not self._device.is_unplugged:
                if select.select([self._master], [], [], _SLICE_S)[0]:
                    for delay_s, answer in self._device.receive(os.read(self._master, 4096)):
                        earliest = pending[-1][0] if pending else 0.0
                        pending.append((max(earliest, time.monotonic() + delay_s), answer))
                else:
                    self.idle_s += _SLICE_S
                while pending and pending[0][0] <= time.monotonic():
                    os.write(self._master, pending.popleft()[1])
        finally:
            os.close(self._slave)
            os.close(self._master)
