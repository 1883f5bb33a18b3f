"""Checks that every device must pass, in the tests and in `svwfs devices --check`.

A check takes a device that is open and at rest, leaves it so, and raises `ContractBroken` if the device fails.
"""

from collections.abc import Callable, Mapping
from functools import partial

from drivers.device import Device, Property
from drivers.errors import DeviceError

Calls = Mapping[str, Callable[[], object]]  # by name


class ContractBroken(AssertionError):
    """A device failed a check; the message says how."""


def require(holds: bool, message: str) -> None:
    """Raise `ContractBroken` unless the condition holds."""
    if not holds:
        raise ContractBroken(message)


def require_raises(kind: type[DeviceError], what: str, call: Callable[..., object], *arguments: object) -> None:
    """Require that the call raises an error of this kind."""
    try:
        call(*arguments)
    except kind:
        return
    except DeviceError as error:
        raise ContractBroken(f"{what}: {type(error).__name__} ({error}) instead of {kind.__name__}") from error
    raise ContractBroken(f"{what}: no {kind.__name__} was raised")


def require_all_raise(kind: type[DeviceError], calls: Calls) -> None:
    """Require that each call raises an error of this kind."""
    for what, call in calls.items():
        require_raises(kind, what, call)


def calls(device: Device, queries: tuple[str, ...], commands: Mapping[str, tuple[object, ...]]) -> Calls:
    """Calls that read the queries and execute the commands with their arguments."""
    reading: Calls = {name: partial(getattr, device, name) for name in queries}
    return {**reading, **{name: partial(getattr(device, name), *given) for name, given in commands.items()}}


def check_properties(device: Device) -> None:
    """All properties are plain values, its name among them."""
    properties = device.properties()
    require(bool(device.name.strip()), "it has no name")
    require(properties.get("name") == device.name, "its name is not among its properties")
    for key, value in properties.items():
        require(isinstance(value, Property), f"property {key} = {value!r} is no plain value")


def describe(check: Callable[..., None]) -> str:
    """First sentence of the check's docstring."""
    return (check.__doc__ or check.__name__).split(".\n")[0].split("\n\n")[0].strip().rstrip(".")
