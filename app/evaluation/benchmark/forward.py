"""The forward model beside HCIPy's micro-lens array and Fresnel propagator: seconds for the image of one object point.

Both get the same phase in closed form and the same object points; ours pays all that it does once an image for these
few points, and covers the camera's pixels with squares of light, where HCIPy has as many samples as there are pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.evaluation.benchmark.cases import Case
from reconstruction.geometry import centered_steps
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.source import SourcePoints

POINTS = 8
_BEND_RAD_PER_M2 = 3e5


def our_forward_model(case: Case, points: int = POINTS) -> Callable[[], NDArray[Any]]:
    """Prepare the image of `points` x `points` object points by our model."""
    rows, columns = case.reference.shape
    model = ForwardModel(case.sensor, case.lattice, case.field, rows=rows, columns=columns)
    x_m, y_m = model.sample_x_m[None, :], model.sample_y_m[:, None]
    bend = (_BEND_RAD_PER_M2 * (x_m**2 + y_m**2)).astype(np.float32)
    position_m = _positions_m(case, points)
    source = SourcePoints(position_m=position_m, area_m2=np.ones(len(position_m)))
    return lambda: model.irradiance(source, lambda _x, _y: bend)


def hcipy_point(case: Case) -> Callable[[], NDArray[Any]]:
    """Prepare the image of one object point by HCIPy; raise ImportError where it is not installed."""
    hcipy = import_module("hcipy")
    sensor, (rows, columns) = case.sensor, case.reference.shape
    width_m, height_m = (2 * half_m for half_m in sensor.pupil_half_width_m)
    grid = hcipy.make_pupil_grid([columns, rows], [width_m, height_m])
    lenslets = hcipy.CartesianGrid(hcipy.SeparatedCoords((sensor.pupil_x_m, sensor.pupil_y_m)))
    array = hcipy.MicroLensArray(grid, lenslets, sensor.lenslet_focal_length_m)
    propagator = hcipy.FresnelPropagator(grid, sensor.lenslet_focal_length_m)
    x_m, y_m = _positions_m(case, 2)[-1]
    tilt = sensor.wavenumber_rad_per_m / case.field.collimator_focal_length_m * (grid.x * x_m + grid.y * y_m)
    phase = _BEND_RAD_PER_M2 * (grid.x**2 + grid.y**2) + tilt

    def image() -> NDArray[Any]:
        light = hcipy.Wavefront(hcipy.Field(np.exp(1j * phase), grid), sensor.wavelength_m)
        return np.asarray(propagator(array(light)).power)

    return image


def _positions_m(case: Case, points: int) -> NDArray[np.float64]:
    """Object points on a square, (point, xy)."""
    along_m = centered_steps(points) / points * 2 * case.field.half_width_m
    return np.stack(np.meshgrid(along_m, along_m), axis=-1).reshape(-1, 2)
