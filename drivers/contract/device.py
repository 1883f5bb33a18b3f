"""What a device promises, as checks that can be run on any of them.

The tests run them on every device, simulated or real over its stand-in; `svwfs devices --check` on the one that is
connected. A check takes a device that is open and at rest, and leaves it so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from drivers.device import Device, Property
from drivers.errors import DeviceError

Calls = Mapping[str, Callable[[], object]]  # by what they are called


class ContractBroken(AssertionError):
    """A device does not do what it promised; the text says what."""


def require(holds: bool, sentence: str) -> None:
    """Raise `ContractBroken` with that sentence unless it holds."""
    if not holds:
        raise ContractBroken(sentence)


def require_raises(kind: type[DeviceError], what: str, call: Callable[..., object], *arguments: object) -> None:
    """Require that the call ends with an error of that kind."""
    try:
        call(*arguments)
    except kind:
        return
    except DeviceError as error:
        raise ContractBroken(f"{what}: {type(error).__name__} ({error}) instead of {kind.__name__}") from error
    raise ContractBroken(f"{what}: no {kind.__name__} was raised")


def require_all_raise(kind: type[DeviceError], calls: Calls) -> None:
    """Require that each of the calls ends with an error of that kind."""
    for what, call in calls.items():
        require_raises(kind, what, call)


def check_properties(device: Device) -> None:
    """All it tells of itself can be written down: plain values by their names, its own name among them."""
    told = device.properties()
    require(bool(device.name.strip()), "it has no name")
    require(told.get("name") == device.name, "its name is not among its properties")
    for key, value in told.items():
        require(isinstance(value, Property), f"property {key} = {value!r} is no plain value")


def describe(check: Callable[..., None]) -> str:
    """First sentence of what the check says of itself."""
    return (check.__doc__ or check.__name__).split(".\n")[0].split("\n\n")[0].strip().rstrip(".")
