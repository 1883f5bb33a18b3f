"""Which GenICam cameras are connected."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.errors import BadValue, Disconnected
from drivers.genicam_calls import PatientCalls
from drivers.genicam_library import Aravis, load_aravis

_SEARCH_S = 2.0  # cameras in the network have one second to answer


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A GenICam camera that answered."""

    device: str  # by which it is opened
    vendor: str
    model: str
    serial_number: str
    address: str  # in the network; of a USB camera, what Aravis calls it
    protocol: str  # "GigEVision" or "USB3Vision"

    @property
    def name(self) -> str:
        """Maker, model and serial number."""
        return " ".join(word for word in (self.vendor, self.model, self.serial_number) if word)

    @property
    def names(self) -> set[str]:
        """All by which it may be asked for."""
        return {self.device, self.serial_number, self.address}


def find() -> tuple[FoundCamera, ...]:
    """Return the cameras that answer within about a second; raise `Unsupported` where the library is missing."""
    aravis = load_aravis()
    calls = PatientCalls("genicam search")
    try:
        calls.make(lambda: aravis.call("arv_update_device_list"), _SEARCH_S)
        return _listed(aravis)
    finally:
        calls.end()


def choose(wanted: str) -> FoundCamera:
    """Return the camera of this name, serial number or address; "" asks for the only one."""
    known = _listed(load_aravis()) if wanted else ()  # from searches until now: opening anew need not wait
    chosen = [camera for camera in known if wanted in camera.names]
    if len(chosen) == 1:
        return chosen[0]
    found = find()
    chosen = [camera for camera in found if not wanted or wanted in camera.names]
    if len(chosen) == 1:
        return chosen[0]
    names = ", ".join(camera.device for camera in found)
    if chosen:
        raise BadValue(f"there are {len(chosen)} GenICam cameras; say which one: {names}")
    raise Disconnected(
        f"there is no GenICam camera {wanted}".rstrip() + (f"; there are {names}" if names else ": none answers")
    )


def _listed(aravis: Aravis) -> tuple[FoundCamera, ...]:
    details = ("id", "vendor", "model", "serial_nbr", "address", "protocol")
    return tuple(
        FoundCamera(*(aravis.call(f"arv_get_device_{detail}", i) or "" for detail in details))
        for i in range(aravis.call("arv_get_n_devices"))
    )
