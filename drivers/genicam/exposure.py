"""Exposure time of a GenICam camera."""

from typing import Final

from drivers.errors import Unsupported
from drivers.genicam.connection import GenicamConnection
from drivers.range import Range

_IN_MICROSECONDS: Final = ("ExposureTime", "ExposureTimeAbs")


class ExposureTime:
    """Exposure time through Aravis, which knows the models, or through an integer feature, which it refuses."""

    def __init__(self, line: GenicamConnection) -> None:
        self._line = line
        self._integer = ""
        if line.attempt(lambda: line.bounds("arv_camera_get_exposure_time_bounds")) is None:
            self._integer = next(filter(line.has, _IN_MICROSECONDS), "")
            if not self._integer:
                raise Unsupported(f"the camera offers no exposure time: neither {' nor '.join(_IN_MICROSECONDS)}")

    def range_s(self) -> Range:
        """Return the allowed exposures."""
        if self._integer:
            shortest_us, longest_us, _ = map(float, self._line.integer_bounds(self._integer))
        else:
            shortest_us, longest_us = self._line.bounds("arv_camera_get_exposure_time_bounds")
        return Range(shortest_us / 1e6, longest_us / 1e6)

    def read_s(self) -> float:
        """Return the exposure in force."""
        if self._integer:
            return self._line.integer(self._integer) / 1e6
        return float(self._line.call("arv_camera_get_exposure_time")) / 1e6

    def set_s(self, exposure_s: float) -> None:
        """Change the exposure."""
        allowed = self.range_s()
        exposure_us = min(max(round(exposure_s * 1e6, 3), allowed.minimum * 1e6), allowed.maximum * 1e6)
        if self._integer:
            self._line.set_text(self._integer, str(round(exposure_us)))
        else:
            self._line.call("arv_camera_set_exposure_time", exposure_us)
