"""Camera frame and sensor region."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import BadValue


@dataclass(frozen=True, slots=True)
class Region:
    """Part of the sensor that is read out, in unbinned pixels."""

    top: int
    left: int
    rows: int
    columns: int


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One exposure with its metadata."""

    pixels: NDArray[np.uint16]  # (row, column), counts; read-only, not shared
    index: int  # the camera's frame number since start, from 0; a gap is a lost frame
    camera_time_s: float  # end of the exposure on the camera's clock
    host_time_s: float  # time.perf_counter() after the frame arrived
    exposure_s: float
    em_gain: float  # 1 without electron multiplication


def check_region(region: Region, sensor: Region, step_px: int) -> None:
    """Raise `BadValue` unless the region is the whole sensor, or lies on it in whole steps."""
    if region == sensor:
        return
    numbers = (region.top, region.left, region.rows, region.columns)
    is_on_sensor = (
        region.top >= 0
        and region.left >= 0
        and region.rows > 0
        and region.columns > 0
        and region.top + region.rows <= sensor.rows
        and region.left + region.columns <= sensor.columns
    )
    if not is_on_sensor or any(number % step_px for number in numbers):
        raise BadValue(
            f"a region of {region.rows} x {region.columns} pixels at row {region.top}, column {region.left} does not"
            f" lie on the sensor of {sensor.rows} x {sensor.columns} in steps of {step_px}"
        )
