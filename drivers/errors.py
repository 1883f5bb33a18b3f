"""The error family of all devices; each message is one sentence for the person at the bench."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self, TypeVar

T = TypeVar("T")


class DeviceError(Exception):
    """A device failed to do what was asked."""


class Disconnected(DeviceError):
    """The device is unplugged or switched off; it stays lost until it is opened again."""

    @classmethod
    def of(cls, what: str) -> Self:
        """Make the error of a device that a port no longer reaches."""
        return cls(f"{what} is gone; is it plugged in and switched on?")


class Busy(DeviceError):
    """Another program holds the device."""


class DeviceTimeout(DeviceError):
    """No answer or no frame came in time."""


class FrameLost(DeviceError):
    """A frame was damaged or lost on its way; the next one may be read."""


class WrongState(DeviceError):
    """The device cannot do this now, for example read a frame before it was started."""


class LightHeldOff(WrongState):
    """The light was switched off, or went off, after the command that needs it was made."""


class BadValue(DeviceError):
    """The value is outside the allowed ones, which the message names."""


class Unsupported(DeviceError):
    """The device, or its library, can never do this."""


REFUSALS = (BadValue, Unsupported, WrongState)  # nothing has changed, and the device is sound


def attempt(call: Callable[..., T], *arguments: Any) -> T | None:
    """Return the result of an optional call; None if it fails, but a loss of the device is raised."""
    try:
        return call(*arguments)
    except Disconnected:
        raise
    except DeviceError:
        return None


@contextmanager
def undone_if_refused(undo: Callable[[], None]) -> Iterator[None]:
    """Call `undo` after a failure of one of several steps; `DeviceError` if that is refused, too."""
    try:
        yield
    except Disconnected:
        raise
    except DeviceError as error:
        try:
            undo()
        except REFUSALS as refusal:
            raise DeviceError(f"only a part of the setting is in force, set it again: {refusal}") from error
        raise
