"""Faults on the way to a simulated device: a pulled plug, a missing answer, a refused setting."""

from collections.abc import Iterator
from contextlib import contextmanager

from drivers.interface import BadValue, Device, DeviceTimeout, Disconnected


class Plugged(Device):
    """Mixin for a simulated device; stands before the kind of device among its bases."""

    _is_unplugged = False
    _refuses_next = False
    _fails_next = False

    def unplug(self) -> None:
        """Pull the plug."""
        self._is_unplugged = True

    def refuse_next(self) -> None:
        """Refuse the next setting."""
        self._refuses_next = True

    def fail_next(self) -> None:
        """Leave the next request without an answer."""
        self._fails_next = True

    def _reach(self) -> None:
        """Raise `Disconnected` if the plug was pulled."""
        if self._is_unplugged:
            raise Disconnected(f"the {self._kind} does not answer; is it plugged in and switched on?")

    def _answer(self) -> None:
        """Raise `DeviceTimeout` if this answer is to be missing."""
        self._reach()
        if self._fails_next:
            self._fails_next = False
            raise DeviceTimeout(f"the {self._kind} did not answer in time")

    def _accept(self, what: str) -> None:
        """Raise `BadValue` if this setting is to be refused."""
        self._answer()
        if self._refuses_next:
            self._refuses_next = False
            raise BadValue(f"the {self._kind} refused {what}")


class PluggedThroughout(Plugged):
    """The same for a device that every request must reach."""

    @contextmanager
    def _access(self) -> Iterator[None]:
        with super()._access():
            self._reach()
            yield
