"""Micro-Manager's core: a camera loaded into it, and its bare errors as device errors."""

import os
import sys
from collections.abc import Mapping
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.camera import NO_MEMORY
from drivers.errors import BadValue, DeviceError, Disconnected, Unsupported

LABEL: Final = "camera"
_unreleased: list[Any] = []  # cores whose camera did not stop: destroying one can hang or abort the process
_CAMERA: Final = 2  # Micro-Manager's number of this type of device


def load_pymmcore() -> Any:
    """Return the module; raise `Unsupported` if it is not installed."""
    try:
        return import_module("pymmcore")
    except ImportError as error:
        raise Unsupported("Micro-Manager's cameras need pymmcore: install the extra svwfs[micro-manager]") from error


class LoadedCamera:
    """A camera in a core of its own."""

    def __init__(self, core: Any, *, adapter: str, device: str, folder: str) -> None:
        self._core = core
        if folder and sys.platform == "win32":  # where the adapter looks for its maker's libraries
            os.environ["PATH"] += os.pathsep + folder
        if folder:
            core.setDeviceAdapterSearchPaths([folder])
        try:
            core.loadDevice(LABEL, adapter, device)
        except RuntimeError as error:
            raise Unsupported(
                f"{error}: set camera.adapter_folder to a Micro-Manager whose device interface is"
                f" {core.getMMDeviceDeviceInterfaceVersion()}, and install the maker's driver"
            ) from error
        if int(core.getDeviceType(LABEL)) != _CAMERA:
            raise BadValue(f"camera.device = {device!r} of {adapter} is no camera")

    def initialize(self, properties: Mapping[str, str]) -> None:
        """Connect to the camera and set its properties in their order, those first that it needs before."""
        early = {name for name in self.property_names() if self._core.isPropertyPreInit(LABEL, name)}
        for name, value in properties.items():
            if name in early:
                self.set_property(name, value)
        try:
            self._core.initializeDevice(LABEL)
            self._core.setCameraDevice(LABEL)
        except RuntimeError as error:
            raise Disconnected(
                f"{error}: check the camera's power and cable, and that no other program holds it"
            ) from error
        for name, value in properties.items():
            if name not in self.property_names():
                raise BadValue(f"camera.properties: there is no {name}; there are {', '.join(self.property_names())}")
            if name not in early:
                self.set_property(name, value)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of the core.

        A refusal and a lost camera are the same bare error; a lost camera does not report its exposure, either.
        """
        try:
            return getattr(self._core, name)(*arguments)
        except MemoryError as error:
            raise DeviceError(NO_MEMORY) from error
        except RuntimeError as error:
            try:
                self._core.getExposure(LABEL)
            except RuntimeError:
                raise Disconnected(
                    f"the camera is gone ({error}): check its power and cable, then connect again"
                ) from error
            kind = BadValue if name.startswith("set") else DeviceError
            raise kind(f"the camera's adapter refused {name}: {error}") from error

    def property_names(self) -> tuple[str, ...]:
        """Names of the adapter's properties."""
        return tuple(self.call("getDevicePropertyNames", LABEL))

    def set_property(self, name: str, value: str) -> None:
        """Write a property; the error names the allowed values."""
        try:
            self.call("setProperty", LABEL, name, value)
        except BadValue as error:
            raise BadValue(f"{name} = {value}{self._allowed(name)}: {error}") from error

    def _allowed(self, name: str) -> str:
        limits = self.limits(name)
        values = self.call("getAllowedPropertyValues", LABEL, name)
        if limits is not None:
            return f", allowed are {limits[0]:g} ... {limits[1]:g}"
        return f", allowed are {', '.join(values)}" if values else ""

    def limits(self, name: str) -> tuple[float, float] | None:
        """Limits of a property, if it exists and has some."""
        if name not in self.property_names() or not self.call("hasPropertyLimits", LABEL, name):
            return None
        least, most = (self.call(f"getProperty{side}Limit", LABEL, name) for side in ("Lower", "Upper"))
        return float(least), float(most)

    def pop(self) -> tuple[NDArray[np.unsignedinteger], int, float] | None:
        """Take the oldest frame, if any: pixels (row, column), number, and time in s since the start."""
        return self._waiting("popNextImageMD")

    def newest(self) -> int | None:
        """Number of the newest frame in the buffer, if any."""
        newest = self._waiting("getLastImageMD")
        return None if newest is None else newest[1]

    def _waiting(self, function: str) -> tuple[NDArray[np.unsignedinteger], int, float] | None:
        if not self.call("getRemainingImageCount"):
            return None
        metadata = load_pymmcore().Metadata()
        try:
            pixels = self.call(function, metadata)
        except IndexError:  # the core has just emptied its full buffer
            return None
        return pixels, int(_tag(metadata, "ImageNumber")), 1e-3 * float(_tag(metadata, "ElapsedTime-ms"))

    def unload(self) -> None:
        """Release the camera, in any state."""
        for release in (lambda: self._core.stopSequenceAcquisition(LABEL), self._core.reset):
            try:
                release()
            except RuntimeError:
                _unreleased.append(self._core)


def _tag(metadata: Any, name: str) -> str:
    """Entry of a frame's record, which Micro-Manager's core makes."""
    if not metadata.HasTag(name):
        raise DeviceError(f"a frame came without {name}: use the pymmcore that svwfs[micro-manager] installs")
    return str(metadata.GetSingleTag(name).GetValue())
