"""Auto-exposure: exposure and current at which the brightest lenslets fill a given part of full scale.

The exposure time is changed within the camera's current mode; only if that is not enough, the light's current. EM gain
and amplifier stay, because they change the noise, and so does the sample. The level includes the background, because
that is what saturates.
"""

import math
from dataclasses import dataclass

from app.measurement.routines.brightness import brightness
from app.measurement.routines.device_state import restored
from app.measurement.routines.exposure_search import MOST_FRAMES, SATURATED, Reach, Shot, next_light
from app.measurement.routines.frames import FrameProgress, RoutineError, ShouldStop, next_frame
from drivers.interface import BadValue, Devices, Range
from drivers.light_source import ManualLight

FILL = 0.70  # of full scale
TOLERANCE = 0.05  # of full scale

_FIRST_S = 10.0  # longest first exposure
_LEAST_CURRENT = 1e-3  # of the maximum; below it a light is dark or unsteady
_FIRST_CURRENT = 0.5  # of the maximum; used if the current is zero
_EXACT = 0.02  # relative rounding of the exposure that the current need not compensate
_LONGER = 1.5  # factor above one exposure step; the current compensates
_LEAST_CONTRAST = 0.2  # of the level; with less the light is not the lamp's
_HOPELESS = 2.0  # factor beyond reach at which trying is useless


@dataclass(frozen=True, slots=True)
class AutoExposure:
    """Exposure and current, as set, and how they were found."""

    exposure_s: float
    current_a: float
    fill: float  # of full scale, in the last frame
    frames: int  # test frames


def auto_expose(
    devices: Devices, cell_px: float, *, fill: float = FILL, progress: FrameProgress, should_stop: ShouldStop
) -> AutoExposure:
    """Set the exposure, and if necessary the current, so that the brightest lenslets fill `fill` of full scale.

    `cell_px` is the lenslet pitch on the camera. The light is on during the search and then restored. A `RoutineError`
    says what to do if the goal cannot be reached; then everything is restored.
    """
    if not 2 * TOLERANCE <= fill <= SATURATED - 2 * TOLERANCE:
        raise BadValue(f"fill = {fill:g} is outside {2 * TOLERANCE:g} ... {SATURATED - 2 * TOLERANCE:g}")
    with restored(devices) as state:
        camera = devices.camera
        camera.stop()
        control = _LightControl(devices, state.current_a)
        shots: list[Shot] = []
        taken = control.set(control.first(state.exposure_s))
        devices.light.set_on(True)
        while True:
            camera.start()
            frame = next_frame(camera, should_stop)
            camera.stop()
            full_scale = camera.capabilities.full_scale  # some cameras show it only by their frames
            seen = brightness(frame.pixels, cell_px)
            is_reached = abs(seen.level / full_scale - fill) <= TOLERANCE
            shots.append(Shot(taken, seen, seen.level >= SATURATED * full_scale))
            progress(frame, 1.0 if is_reached else len(shots) / MOST_FRAMES)
            if is_reached:
                if seen.level - seen.background < _LEAST_CONTRAST * seen.level:
                    raise RoutineError(
                        "light falls on the camera, but shows no subimages: is the room dark, the lamp on?"
                    )
                state.exposure_s, state.current_a = camera.exposure_s, devices.light.current_a
                return AutoExposure(state.exposure_s, state.current_a, seen.level / full_scale, len(shots))
            light = control.possible(next_light(shots, fill * full_scale, full_scale, control.reach), shots)
            if len(shots) == MOST_FRAMES:
                raise RoutineError(
                    f"after {MOST_FRAMES} frames the brightest lenslets fill {seen.level / full_scale:.0%} of the"
                    " camera's scale: they do not follow exposure and current; is the light steady, the beam still?"
                )
            taken = control.set(light)


class _LightControl:
    """Exposure and current controlled together, as light in A s."""

    def __init__(self, devices: Devices, initial_current_a: float) -> None:
        self._devices = devices
        self._exposures_s: Range = devices.camera.capabilities.exposure_range_s
        allowed = devices.light.current_range_a
        self._is_fixed = isinstance(devices.light, ManualLight)
        if self._is_fixed:
            allowed, initial_current_a = Range(1.0, 1.0), 1.0  # without a current, the exposure alone is the light
        if not allowed.maximum > 0:
            raise RoutineError("the allowed current is zero: raise limit_a, or check the LED head")
        least_a = max(allowed.minimum, _LEAST_CURRENT * allowed.maximum)
        self._currents_a = Range(least_a, max(least_a, allowed.maximum))
        is_usable = initial_current_a >= least_a
        self._current_a = initial_current_a if is_usable else _FIRST_CURRENT * allowed.maximum
        self.reach = Reach(
            lowest=self._exposures_s.minimum * least_a,
            lowest_by_exposure=self._exposures_s.minimum * self._current_a,
            highest=self._exposures_s.maximum * allowed.maximum,
        )

    def first(self, initial_exposure_s: float) -> float:
        """Return the light of the first frame: the initial one, unless too slow or dark."""
        return self._current_a * min(initial_exposure_s, _FIRST_S)

    def possible(self, light: float, shots: list[Shot]) -> float:
        """Return the light, limited to the reach; `RoutineError` if that is useless."""
        reach = self.reach
        nearest = min(max(light, reach.lowest), reach.highest)
        is_tried = any(abs(shot.light / nearest - 1) < _EXACT for shot in shots)
        if light < reach.lowest / _HOPELESS or (light <= reach.lowest and is_tried):
            current = "" if self._is_fixed else f", and the least current, {self._currents_a.minimum:g} A"
            raise RoutineError(
                f"too bright even at the shortest exposure, {self._exposures_s.minimum:g} s{current}:"
                " put a filter before the camera, or lower the gain"
            )
        limits = f"the longest exposure, {self._exposures_s.maximum:g} s"
        limits += "" if self._is_fixed else f", and the highest current, {self._currents_a.maximum:g} A"
        if light == math.inf:
            raise RoutineError(f"no light detected, even at {limits}: check the lamp and the beam path")
        if light > reach.highest * _HOPELESS or (light >= reach.highest and is_tried):
            raise RoutineError(
                f"too little light: {limits} would have to be {light / reach.highest:.2g} times as much;"
                " raise the gain, choose a slower readout, which allows longer exposures, or open the mask"
            )
        return nearest

    def set(self, light: float) -> float:
        """Set the exposure for a light, and the current if necessary; return the light as set."""
        camera, lamp = self._devices.camera, self._devices.light
        wanted_s, current_a = light / self._current_a, self._current_a
        exposure_s = camera.set_exposure(_within(self._exposures_s, wanted_s))
        if exposure_s * self._currents_a.maximum < light * (
            1 - _EXACT
        ):  # one exposure step too short at the maximum current
            exposure_s = camera.set_exposure(_within(self._exposures_s, _LONGER * wanted_s))
        if self._is_fixed:
            return exposure_s
        if abs(exposure_s * current_a / light - 1) > _EXACT:
            current_a = _within(self._currents_a, light / exposure_s)
        return exposure_s * lamp.set_current(current_a)


def _within(allowed: Range, value: float) -> float:
    return min(max(value, allowed.minimum), allowed.maximum)
