"""Routine that measures the camera's nonlinearity by exposures of rising and falling length.

Equal exposures at different times tell light that drifts from a nonlinearity. The light's current stays: what an LED
gives at another current is not known, the exposure time is.
"""

import numpy as np

from app.measurement.auto_exposure import auto_expose
from app.measurement.averages import LEAST_EXPOSURE_FRAMES, Average, average
from app.measurement.routines import RoutineCallbacks, RoutineError, check_lit, restored
from drivers.interface import Devices
from drivers.light_source import ManualLight
from reconstruction.arrays import Image
from reconstruction.errors import ReconstructionError
from reconstruction.frame.linearity_fit import LEAST_SPAN, Exposures, MeasuredLinearity

_FILL = 0.8  # of full scale, of the longest exposure
_LEVELS = 8  # exposure times
_SPAN = 11.3  # longest over shortest exposure, if the camera allows it
_PASSES = 2  # up and down
_MARGIN = 1.2  # of the exposure that a lower current shall demand


def measure_linearity(devices: Devices, cell_px: float, frames: int, callbacks: RoutineCallbacks) -> MeasuredLinearity:
    """Measure the nonlinearity in the camera's mode from means of `frames` frames; `RoutineError` if impossible."""
    camera, light = devices.camera, devices.light
    if isinstance(light, ManualLight):
        raise RoutineError("a light that is switched by hand is not as steady as this needs: connect its driver")
    if frames < LEAST_EXPOSURE_FRAMES:
        raise RoutineError(f"at least {LEAST_EXPOSURE_FRAMES} frames of each exposure are needed, to know their noise")
    with restored(devices):
        devices.stage.set_sample_in(False)
        exposures_s = _exposure_times(devices, cell_px, callbacks)
        visits = (exposures_s + exposures_s[::-1]) * _PASSES
        shares = iter(np.linspace(0, 1, len(exposures_s) + 1 + len(visits) + 1))

        def averaged(exposure_s: float) -> Average:
            camera.stop()
            camera.set_exposure(exposure_s)
            return average(camera, frames, _at(next(shares), callbacks))

        light.set_on(False)
        darks = {exposure_s: averaged(exposure_s) for exposure_s in exposures_s}
        light.set_on(True)

        def signal(exposure_s: float) -> tuple[Image, Image]:
            """Counts above the dark and their variance, counts^2, (row, column)."""
            lit, dark = averaged(exposure_s), darks[exposure_s]
            check_lit(light)
            variance = (lit.variance + dark.variance) / np.float32(frames)
            return np.subtract(lit.mean, dark.mean), np.asarray(variance, np.float32)

        try:
            dark_level = float(np.median(darks[exposures_s[-1]].mean))
            brightest, _ = signal(exposures_s[-1])  # of other frames than those of the fit, whose noise would choose
            exposures = Exposures(brightest, camera.capabilities.full_scale - dark_level)
            for exposure_s in visits:
                exposures.add(*signal(exposure_s), exposure_s)
            return exposures.fit(amplifier=camera.amplifier, em_gain=camera.em_gain)
        except ReconstructionError as error:
            raise RoutineError(str(error)) from error


def _at(share: float, callbacks: RoutineCallbacks) -> RoutineCallbacks:
    """Callbacks of a part of the routine, during which the progress stays at `share`."""
    return RoutineCallbacks(lambda frame, _: callbacks.progress(frame, share), callbacks.should_stop)


def _exposure_times(devices: Devices, cell_px: float, callbacks: RoutineCallbacks) -> list[float]:
    """Set the current, and return the exposures, s, of which the longest nearly fills the camera's scale."""
    camera, light = devices.camera, devices.light
    longest_s = auto_expose(devices, cell_px, _at(0.0, callbacks), fill=_FILL).exposure_s
    allowed = camera.capabilities.exposure_range_s
    wanted_s = min(_SPAN * allowed.minimum, allowed.maximum)
    if longest_s < wanted_s:
        dimmed_a = max(light.current_a * longest_s / (_MARGIN * wanted_s), light.current_range_a.minimum)
        light.set_current(dimmed_a)
        longest_s = auto_expose(devices, cell_px, _at(0.0, callbacks), fill=_FILL).exposure_s
    shortest_s = max(allowed.minimum, longest_s / _SPAN)
    if longest_s < LEAST_SPAN * shortest_s:
        raise RoutineError(
            f"exposures of {shortest_s:.3g} to {longest_s:.3g} s do not span a factor of {LEAST_SPAN:g}:"
            " put a filter before the camera, or choose a faster readout"
        )
    camera.stop()
    return [camera.set_exposure(float(exposure_s)) for exposure_s in np.geomspace(shortest_s, longest_s, _LEVELS)]
