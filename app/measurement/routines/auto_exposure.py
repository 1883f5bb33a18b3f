"""The exposure at which the brightest lenslets fill so much of the camera's scale, found in a few frames.

The exposure time is moved, over all that the camera allows in its present mode, and where that is not enough the
light's current. Electron multiplication and amplifier stay as they are: they change the noise, which is a choice of
whoever measures. The sample stays where it is: what is in the beam is what is exposed for. What fills is the level as
the camera counts it, background included, for it is that which saturates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from app.measurement.routines.as_found import as_found
from app.measurement.routines.brightness import brightness
from app.measurement.routines.exposure_search import MOST_FRAMES, SATURATED, Reach, Shot, next_light
from app.measurement.routines.frames import Progress, RoutineError, ShouldStop, next_frame
from drivers.interface import BadValue, Devices, Range

FILL = 0.70  # of full scale
TOLERANCE = 0.05  # likewise

_FIRST_S = 10.0  # the first frame is not exposed for longer: it would say no more
_LEAST_CURRENT = 1e-3  # of the highest; below it a light is dark or unsteady
_BEGINNING_CURRENT = 0.5  # likewise; where none flows
_EXACT = 0.02  # a rounded exposure may be wrong by that much before the current makes up for it
_LONGER = 1.5  # times; more than a step, and the current makes up for it
_LEAST_CONTRAST = 0.2  # of the level; with less it is not the lamp's light that fills
_HOPELESS = 2.0  # times beyond reach: no need to try


@dataclass(frozen=True, slots=True)
class AutoExposure:
    """What was found; exposure and current are in force."""

    exposure_s: float
    current_a: float
    fill: float  # of full scale, in the last frame
    frames: int  # that were needed


def auto_expose(
    devices: Devices, cell_px: float, *, fill: float = FILL, progress: Progress, should_stop: ShouldStop
) -> AutoExposure:
    """Find the exposure, and if need be the current, at which the brightest lenslets fill `fill` of full scale.

    `cell_px` is the pitch of the lenslets on the camera. The light is on meanwhile, and then as it was found.
    `RoutineError` says what to do where the goal cannot be reached; then everything is as it was found.
    """
    if not 2 * TOLERANCE <= fill <= SATURATED - 2 * TOLERANCE:
        raise BadValue(f"fill = {fill:g} is outside {2 * TOLERANCE:g} ... {SATURATED - 2 * TOLERANCE:g}")
    with as_found(devices) as found:
        camera = devices.camera
        camera.stop()
        full_scale = camera.capabilities.full_scale
        bench = _Handles(devices, found.current_a)
        shots: list[Shot] = []
        taken = bench.set(bench.first(found.exposure_s))
        devices.light.set_on(True)
        while True:
            camera.start()
            frame = next_frame(camera, should_stop)
            camera.stop()
            seen = brightness(frame.pixels, cell_px)
            is_reached = abs(seen.level / full_scale - fill) <= TOLERANCE
            shots.append(Shot(taken, seen, seen.level >= SATURATED * full_scale))
            progress(frame, 1.0 if is_reached else len(shots) / MOST_FRAMES)
            if is_reached:
                if seen.level - seen.background < _LEAST_CONTRAST * seen.level:
                    raise RoutineError(
                        "light falls on the camera, but shows no subimages: is the room dark, the lamp on?"
                    )
                found.exposure_s, found.current_a = camera.exposure_s, devices.light.current_a
                return AutoExposure(found.exposure_s, found.current_a, seen.level / full_scale, len(shots))
            light = bench.possible(next_light(shots, fill * full_scale, full_scale, bench.reach), shots)
            if len(shots) == MOST_FRAMES:
                raise RoutineError(
                    f"after {MOST_FRAMES} frames the brightest lenslets fill {seen.level / full_scale:.0%} of the"
                    " camera's scale: they do not follow exposure and current; is the light steady, the beam still?"
                )
            taken = bench.set(light)


class _Handles:
    """Exposure and current as one: the light in A s."""

    def __init__(self, devices: Devices, found_current_a: float) -> None:
        self._devices = devices
        self._exposures_s: Range = devices.camera.capabilities.exposure_range_s
        allowed = devices.light.current_range_a
        if not allowed.maximum > 0:
            raise RoutineError("the light may have no current at all: raise its limit, or look at its head")
        least_a = max(allowed.minimum, _LEAST_CURRENT * allowed.maximum)
        self._currents_a = Range(least_a, max(least_a, allowed.maximum))
        is_of_use = found_current_a >= least_a
        self._current_a = found_current_a if is_of_use else _BEGINNING_CURRENT * allowed.maximum
        self.reach = Reach(
            lowest=self._exposures_s.minimum * least_a,
            lowest_by_exposure=self._exposures_s.minimum * self._current_a,
            highest=self._exposures_s.maximum * allowed.maximum,
        )

    def first(self, found_exposure_s: float) -> float:
        """Return the light to begin with: as it was found, but for what would take too long or not shine at all."""
        return self._current_a * min(found_exposure_s, _FIRST_S)

    def possible(self, light: float, shots: list[Shot]) -> float:
        """Return the light, or the last that is in reach; `RoutineError` where that cannot help."""
        reach = self.reach
        nearest = min(max(light, reach.lowest), reach.highest)
        is_tried = any(abs(shot.light / nearest - 1) < _EXACT for shot in shots)
        if light < reach.lowest / _HOPELESS or (light <= reach.lowest and is_tried):
            raise RoutineError(
                f"too bright even at the shortest exposure, {self._exposures_s.minimum:g} s, and the least current,"
                f" {self._currents_a.minimum:g} A: put a filter before the camera, or lower the gain"
            )
        limits = f"the longest exposure, {self._exposures_s.maximum:g} s, and the highest current,"
        limits += f" {self._currents_a.maximum:g} A"
        if light == math.inf:
            raise RoutineError(
                f"no light is to be seen, and {limits} would not be enough: is the lamp plugged in, the way free?"
            )
        if light > reach.highest * _HOPELESS or (light >= reach.highest and is_tried):
            raise RoutineError(
                f"too little light: {limits} would have to be {light / reach.highest:.2g} times as much;"
                " raise the gain, choose a slower readout, which allows longer exposures, or open the mask"
            )
        return nearest

    def set(self, light: float) -> float:
        """Set the exposure for that light, and the current where it has to help; return the light in force."""
        camera, lamp = self._devices.camera, self._devices.light
        wanted_s, current_a = light / self._current_a, self._current_a
        exposure_s = camera.set_exposure(_within(self._exposures_s, wanted_s))
        if exposure_s * self._currents_a.maximum < light * (1 - _EXACT):  # by a step too short, and no current left
            exposure_s = camera.set_exposure(_within(self._exposures_s, _LONGER * wanted_s))
        if abs(exposure_s * current_a / light - 1) > _EXACT:
            current_a = _within(self._currents_a, light / exposure_s)
        return exposure_s * lamp.set_current(current_a)


def _within(allowed: Range, value: float) -> float:
    return min(max(value, allowed.minimum), allowed.maximum)
