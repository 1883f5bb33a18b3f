"""Discovery of the connected GenICam cameras."""

from ipaddress import ip_address

from drivers.device import DiscoveredDevice
from drivers.errors import BadValue, Disconnected
from drivers.genicam.connection import PatientCalls
from drivers.genicam.library import Aravis, load_aravis

_DISCOVERY_S = 2.0  # cameras in the network have one second to answer


def discover() -> tuple[DiscoveredDevice, ...]:
    """Return the cameras that answer within about a second; raise `Unsupported` if the library is missing."""
    aravis = load_aravis()
    _update_list(aravis)
    cameras = []
    for i in range(aravis.call("arv_get_n_devices")):
        details = (aravis.call(f"arv_get_device_{detail}", i) for detail in ("vendor", "model", "serial_nbr"))
        description = " ".join(filter(None, details))
        settings = {"device": aravis.call("arv_get_device_id", i)}
        cameras.append(DiscoveredDevice(kind="camera", driver="genicam", description=description, settings=settings))
    return tuple(cameras)


def choose(wanted: str) -> str:
    """Return Aravis's identifier of the camera with this name, serial number or address; "" takes the only one."""
    if _is_address(wanted):  # perhaps in another network, beyond the reach of a discovery
        return wanted
    aravis = load_aravis()
    known = _identifiers(aravis) if wanted else {}  # from earlier discoveries: reopening need not wait for another
    if wanted in known:
        return known[wanted]
    _update_list(aravis)
    known = _identifiers(aravis)
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


def _update_list(aravis: Aravis) -> None:
    calls = PatientCalls("genicam discovery")
    try:
        calls.make(lambda: aravis.call("arv_update_device_list"), _DISCOVERY_S)
    finally:
        calls.end()


def _identifiers(aravis: Aravis) -> dict[str, str]:
    """Identifiers of the listed cameras, by identifier and by serial number."""
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
