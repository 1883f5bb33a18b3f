"""Trigger of a GenICam camera."""

from typing import Final

from drivers.errors import Unsupported
from drivers.genicam.connection import GenicamConnection

INTERNAL: Final = "internal"
_OF_FRAMES: Final = ("FrameStart", "FrameBurstStart", "AcquisitionStart", "ExposureStart")  # the first offered is used


def sources(line: GenicamConnection) -> tuple[str, ...]:
    """Return what can start an exposure."""
    return (INTERNAL, *(source for source in line.choices("TriggerSource") if source != "Software"))


def trigger(line: GenicamConnection) -> str:
    """Return what starts an exposure now."""
    return line.text("TriggerSource") if line.optional_text("TriggerMode") == "On" else INTERNAL


def set_trigger(line: GenicamConnection, source: str) -> None:
    """Switch off all triggers, and on the one of frames unless they start by themselves.

    Aravis has such a function, too, but that fails if `TriggerSelector` is read-only, as on older Blackfly and Flea3.
    """
    selectors = line.choices("TriggerSelector") if line.is_writable("TriggerSelector") else ()
    for selector in selectors:
        line.set_text("TriggerSelector", selector)
        _switch(line, "Off")
    if not selectors:
        _switch(line, "Off")
    if source == INTERNAL:
        return
    if selectors:
        if not (fitting := [selector for selector in _OF_FRAMES if selector in selectors]):
            raise Unsupported(f"the camera has no trigger for frames, only for {', '.join(selectors)}")
        line.set_text("TriggerSelector", fitting[0])
    line.set_text("TriggerSource", source)  # some lock it once the trigger is on
    if "RisingEdge" in line.choices("TriggerActivation"):
        line.set_text("TriggerActivation", "RisingEdge")
    _switch(line, "On")


def _switch(line: GenicamConnection, mode: str) -> None:
    if line.optional_text("TriggerMode") not in {None, mode}:
        line.set_text("TriggerMode", mode)
