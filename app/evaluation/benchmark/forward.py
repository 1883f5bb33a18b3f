"""Our forward model beside HCIPy's: seconds for the image of one object point.

Both get the same phase in closed form and the same object points. Ours repeats its costs per image for these few points
and covers the camera's pixels with squares of light; HCIPy has one sample per pixel.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.evaluation.benchmark.stopwatch import medians_s, side_by_side
from app.evaluation.benchmark.timed_frames import TimedFrames
from reconstruction.geometry import centered_steps
from simulated_devices.optics.forward_model import ForwardModel, phase_only
from simulated_devices.optics.source import SourcePoints

_POINTS = 8  # along a side
_BEND_RAD_PER_M2 = 3e5


def forward_times(frames: TimedFrames, budget_s: float) -> tuple[dict[str, float], str]:
    """Return seconds per object point, and the problem of HCIPy if it cannot run."""
    calls, problem = {"ours": _ours(frames)}, ""
    try:
        hcipy = _hcipy(frames)
        hcipy()
        calls["hcipy"] = hcipy
    except Exception as error:  # noqa: BLE001 - any problem of a peer is reported
        problem = f"{type(error).__name__}: {error}"
    times_s = medians_s(side_by_side(calls, budget_s))
    found = {"ours_s_per_point": times_s["ours"] / _POINTS**2}
    if "hcipy" in times_s:
        found |= {"hcipy_s_per_point": times_s["hcipy"], "ratio": times_s["hcipy"] / found["ours_s_per_point"]}
    return found, problem


def _ours(frames: TimedFrames) -> Callable[[], NDArray[Any]]:
    """Prepare the image of a square of object points."""
    rows, columns = frames.reference.shape
    model = ForwardModel(frames.sensor, frames.lattice, frames.field, rows=rows, columns=columns)
    x_m, y_m = model.sample_x_m[None, :], model.sample_y_m[:, None]
    bend = (_BEND_RAD_PER_M2 * (x_m**2 + y_m**2)).astype(np.float32)
    position_m = _positions_m(frames, _POINTS)
    source = SourcePoints(position_m=position_m, area_m2=np.ones(len(position_m)))
    return lambda: model.irradiance(source, phase_only(lambda _x, _y: bend))


def _hcipy(frames: TimedFrames) -> Callable[[], NDArray[Any]]:
    """Prepare the image of one object point."""
    hcipy = import_module("hcipy")
    sensor, (rows, columns) = frames.sensor, frames.reference.shape
    width_m, height_m = (2 * half_m for half_m in sensor.pupil_half_width_m)
    grid = hcipy.make_pupil_grid([columns, rows], [width_m, height_m])
    lenslets = hcipy.CartesianGrid(hcipy.SeparatedCoords((sensor.pupil_x_m, sensor.pupil_y_m)))
    array = hcipy.MicroLensArray(grid, lenslets, sensor.lenslet_focal_length_m)
    propagator = hcipy.FresnelPropagator(grid, sensor.lenslet_focal_length_m)
    x_m, y_m = _positions_m(frames, 2)[-1]
    tilt = sensor.wavenumber_rad_per_m / frames.field.collimator_focal_length_m * (grid.x * x_m + grid.y * y_m)
    phase = _BEND_RAD_PER_M2 * (grid.x**2 + grid.y**2) + tilt

    def image() -> NDArray[Any]:
        light = hcipy.Wavefront(hcipy.Field(np.exp(1j * phase), grid), sensor.wavelength_m)
        return np.asarray(propagator(array(light)).power)

    return image


def _positions_m(frames: TimedFrames, points: int) -> NDArray[np.float64]:
    """Object points on a square, (point, xy)."""
    along_m = centered_steps(points) / points * 2 * frames.field.half_width_m
    return np.stack(np.meshgrid(along_m, along_m), axis=-1).reshape(-1, 2)
