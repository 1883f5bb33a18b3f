"""Whether a simulated device can be spoken to."""

from __future__ import annotations

from drivers.interface import Disconnected, WrongState


class Connection:
    """Open, until it is closed or somebody pulls the plug."""

    def __init__(self, what: str) -> None:
        self._what = what
        self.is_closed = False
        self._is_unplugged = False

    def check(self) -> None:
        """Raise `WrongState` after closing, `Disconnected` after the plug was pulled."""
        if self.is_closed:
            raise WrongState(f"the {self._what} is closed")
        if self._is_unplugged:
            raise Disconnected(f"the {self._what} does not answer; is it plugged in and switched on?")

    def unplug(self) -> None:
        """Pull the plug."""
        self._is_unplugged = True
