"""Which GenICam cameras are connected."""

from __future__ import annotations

from ipaddress import ip_address

from drivers.discovery import Found
from drivers.errors import BadValue, Disconnected
from drivers.genicam.calls import PatientCalls
from drivers.genicam.library import Aravis, load_aravis

_SEARCH_S = 2.0  # cameras in the network have one second to answer


def find() -> tuple[Found, ...]:
    """Return the cameras that answer within about a second; raise `Unsupported` where the library is missing."""
    aravis = load_aravis()
    _search(aravis)
    found = []
    for i in range(aravis.call("arv_get_n_devices")):
        details = (aravis.call(f"arv_get_device_{detail}", i) for detail in ("vendor", "model", "serial_nbr"))
        description = " ".join(filter(None, details))
        device = aravis.call("arv_get_device_id", i)
        found.append(Found(kind="camera", driver="genicam", description=description, settings={"device": device}))
    return tuple(found)


def choose(wanted: str) -> str:
    """Return by what Aravis opens the camera of this name, serial number or address; "" asks for the only one."""
    if _is_address(wanted):  # perhaps in another network, where a search does not reach
        return wanted
    aravis = load_aravis()
    known = _names(aravis) if wanted else {}  # from searches until now: opening anew need not wait for another
    if wanted in known:
        return known[wanted]
    _search(aravis)
    known = _names(aravis)
    devices = sorted(set(known.values()))
    if wanted in known:
        return known[wanted]
    if not wanted and len(devices) == 1:
        return devices[0]
    names = ", ".join(devices)
    if not wanted and devices:
        raise BadValue(f"there are {len(devices)} GenICam cameras; say which one is camera.device: {names}")
    raise Disconnected(
        f"there is no GenICam camera {wanted}".rstrip() + (f"; there are {names}" if names else ": none answers")
    )


def _search(aravis: Aravis) -> None:
    """Ask who is there."""
    calls = PatientCalls("genicam search")
    try:
        calls.make(lambda: aravis.call("arv_update_device_list"), _SEARCH_S)
    finally:
        calls.end()


def _names(aravis: Aravis) -> dict[str, str]:
    """By what each camera is opened, by that and by its serial number."""
    indices = range(aravis.call("arv_get_n_devices"))
    devices = [aravis.call("arv_get_device_id", i) for i in indices]
    serial_numbers = [aravis.call("arv_get_device_serial_nbr", i) for i in indices]
    return dict(zip(serial_numbers, devices, strict=True)) | {device: device for device in devices}


def _is_address(text: str) -> bool:
    try:
        ip_address(text)
    except ValueError:
        return False
    return True
