"""Binning and region of a GenICam camera."""

import math
from typing import Final

from drivers.camera import Region
from drivers.errors import BadValue, Unsupported
from drivers.genicam.connection import GenicamConnection
from drivers.genicam.features import trailing_number

_LARGEST_BINNING: Final = 64
_AXES: Final = ("BinningVertical", "BinningHorizontal")  # in this order: on some, the horizontal one only follows


class Geometry:
    """Binning and region, through features that may be missing, locked, or enumerations.

    Regions are in pixels of the sensor, region features in binned pixels.
    """

    def __init__(self, line: GenicamConnection) -> None:
        self._line = line
        axes = [axis for axis in _AXES if line.has(axis)]
        is_complete = len(axes) == len(_AXES)
        self._free = [axis for axis in axes if is_complete and line.is_writable(axis) and self._values(axis)]
        self.has_offsets = line.has("OffsetX") and line.has("OffsetY")

    def binning(self) -> int:
        """Return the binning in force."""
        down, across = (self._axis_binning(axis) for axis in _AXES)
        if down != across:
            raise Unsupported(f"the camera bins {down} rows and {across} columns: square pixels are needed")
        return down

    def binnings(self) -> tuple[int, ...]:
        """Return the binnings available on both axes; an axis that cannot be set follows the other one."""
        if not self._free:
            return (self.binning(),)
        common = set.intersection(*(set(self._values(axis)) for axis in self._free))
        return tuple(sorted(common)) or (self.binning(),)

    def set_binning(self, binning: int) -> None:
        """Change the binning of both axes; the camera may change its region."""
        for axis in self._free:
            self._line.set_text(axis, self._values(axis)[binning])
        if (taken := self.binning()) != binning:
            raise Unsupported(f"the camera set a binning of {taken} instead of {binning}")

    def sensor(self) -> Region:
        """Return the largest region that can be read out with the present binning."""
        binning = self.binning()
        sides = (("Height", "HeightMax", "SensorHeight"), ("Width", "WidthMax", "SensorWidth"))
        rows, columns = (self._length(*side, binning) for side in sides)
        return Region(0, 0, rows, columns)

    def region_step_px(self) -> int:
        """Return the common step of all sides of a region."""
        return math.lcm(*(self._step(side) for side in ("OffsetX", "OffsetY", "Width", "Height"))) * self.binning()

    def region(self) -> Region:
        """Return the region in force."""
        binning = self.binning()
        left, top, columns, rows = (number * binning for number in self._line.region())
        return Region(top, left, rows, columns)

    def set_region(self, region: Region) -> None:
        """Change the region."""
        binning = self.binning()
        rows, columns = region.rows // binning, region.columns // binning
        fewest_rows, fewest_columns = (self._line.integer_bounds(side)[0] for side in ("Height", "Width"))
        if rows < fewest_rows or columns < fewest_columns:
            raise BadValue(
                f"the camera reads out at least {fewest_rows * binning} rows and {fewest_columns * binning} columns"
            )
        self._line.call("arv_camera_set_region", region.left // binning, region.top // binning, columns, rows)

    def nearest(self, region: Region) -> Region:
        """Return the largest region in whole steps within this one."""
        binning = self.binning()
        top, left, rows, columns = (self._step(side) * binning for side in ("OffsetY", "OffsetX", "Height", "Width"))
        return Region(
            region.top - region.top % top,
            region.left - region.left % left,
            max(rows, region.rows - region.rows % rows),
            max(columns, region.columns - region.columns % columns),
        )

    def _axis_binning(self, axis: str) -> int:
        return trailing_number(self._line.optional_text(axis) or "") or 1

    def _values(self, axis: str) -> dict[int, str]:
        """Binnings of an axis with their text: numbers, or choices such as X2."""
        choices = self._line.attempt(lambda: self._line.choices(axis))
        if choices is not None:
            return {number: choice for choice in choices if (number := trailing_number(choice))}
        low, high, step = self._line.integer_bounds(axis)
        return {number: str(number) for number in range(max(low, 1), min(high, _LARGEST_BINNING) + 1, step)}

    def _length(self, side: str, longest: str, sensor: str, binning: int) -> int:
        """Longest side in whole steps; 2064 pixels in steps of 16 give 2048 with a binning of 2."""
        line = self._line
        binned, whole = line.attempt(lambda: line.integer(longest)), line.attempt(lambda: line.integer(sensor))
        most = min(length for length in (binned and binned * binning, whole, math.inf) if length)
        if most == math.inf:  # the limit of the side itself may shrink with the offset
            most = line.integer_bounds(side)[1] * binning
        step = self._step(side) * binning
        return int(most - most % step)

    def _step(self, side: str) -> int:
        if side.startswith("Offset") and not self.has_offsets:
            return 1
        return self._line.integer_bounds(side)[2]
