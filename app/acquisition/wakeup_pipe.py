"""An event that a thread can wait for together with ZeroMQ's sockets."""

import socket
from contextlib import suppress

_NOTIFICATIONS = 4096  # read at once


class WakeupPipe:
    """Wakes the thread that polls `fileno`; any thread may notify it, also after it was closed."""

    def __init__(self) -> None:
        self._sending, self._receiving = socket.socketpair()
        self._sending.setblocking(False)
        self._receiving.setblocking(False)

    def fileno(self) -> int:
        """The descriptor to poll."""
        return self._receiving.fileno()

    def notify(self) -> None:
        """Wake the thread."""
        with suppress(OSError):  # notified often enough, or closed
            self._sending.send(b"\0")

    def clear(self) -> None:
        """Forget the notifications so far."""
        with suppress(BlockingIOError):  # there are none
            self._receiving.recv(_NOTIFICATIONS)

    def close(self) -> None:
        """Close both ends."""
        self._sending.close()
        self._receiving.close()
