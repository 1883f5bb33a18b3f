"""What may happen between the program and a simulated device: a pulled plug, no answer, a setting that is refused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from drivers.interface import BadValue, Device, DeviceTimeout, Disconnected


class Plugged(Device):
    """Mixed into a simulated device, before what kind of a device it is."""

    _is_unplugged = False
    _refuses_next = False
    _fails_next = False

    def unplug(self) -> None:
        """Pull the plug, as a fault."""
        self._is_unplugged = True

    def refuse_next(self) -> None:
        """Let it refuse the next setting, as a fault."""
        self._refuses_next = True

    def fail_next(self) -> None:
        """Let its next answer never come, as a fault."""
        self._fails_next = True

    def _reach(self) -> None:
        """Raise `Disconnected` where the plug was pulled."""
        if self._is_unplugged:
            raise Disconnected(f"the {self._kind} does not answer; is it plugged in and switched on?")

    def _answer(self) -> None:
        """Raise `DeviceTimeout` if the next answer is not to come."""
        self._reach()
        if self._fails_next:
            self._fails_next = False
            raise DeviceTimeout(f"the {self._kind} did not answer in time")

    def _accept(self, what: str) -> None:
        """Raise `BadValue` if the next setting is to be refused."""
        self._answer()
        if self._refuses_next:
            self._refuses_next = False
            raise BadValue(f"the {self._kind} refused {what}")


class PluggedThroughout(Plugged):
    """The same, for a device that is spoken to by whatever is asked of it."""

    @contextmanager
    def _access(self) -> Iterator[None]:
        with super()._access():
            self._reach()
            yield
