"""Auto-exposure: finds exposure and current at which the brightest lenslets fill a part of full scale.

The exposure time is changed within the camera's current mode; only if that is not enough, the light's current. EM gain
and amplifier stay, because they change the noise, and so does the sample. The level includes the background, because
that is what saturates.

Bisection until a frame shows signal, then proportion. `light` is exposure times current, A s. A frame that is neither
black nor saturated gives the right light within a few percent, over three orders of magnitude. A saturated frame gives
an upper bound, a black one a lower bound from its noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from app.measurement.routines import RoutineCallbacks, RoutineError, check_lit, next_frame, restored
from drivers.interface import BadValue, Devices, Range
from drivers.light_source import ManualLight
from reconstruction.arrays import SIGMA_OF_MEDIAN

FILL = 0.70  # of full scale
TOLERANCE = 0.05  # of full scale

_FIRST_S = 10.0  # longest first exposure
_LEAST_CURRENT = 1e-3  # of the maximum; below it a light is dark or unsteady
_FIRST_CURRENT = 0.5  # of the maximum; used if the current is zero
_EXACT = 0.02  # relative rounding of the exposure that the current need not compensate
_LONGER = 1.5  # factor above one exposure step; the current compensates
_LEAST_CONTRAST = 0.2  # of the level; with less the light is not the lamp's
_HOPELESS = 2.0  # factor beyond reach at which trying is useless

MOST_FRAMES = 6
SATURATED = 0.95  # of full scale; above it pixels may saturate before the converter
_SEEN = 5.0  # noises; a signal above this is detected
_BRIGHTEST_NOISE = 4.0  # noises by which a dark cell's brightest pixel exceeds the background
_CLEAR = 50.0  # noises; above this the noise hardly matters, and apparent noise may be the image
_BRIGHT = 0.25  # of full scale; a level above this is light
_MOST_BACKGROUND = 0.05  # of full scale; a camera's background is less, more is light between the subimages
_FAINT = 3.0  # times the detection limit: enough for an estimate
_USUAL_SPAN = 1000.0  # ratio of the goal to the detection limit until a frame has shown the noise
_USUAL_NOISE_COUNTS = 0.8  # of a camera with few bits, until a frame has shown the noise
_TO_REFINE = 2  # frames needed after the first detection
_LITTLE = 10.0  # times the least light that exposure alone allows
_MISJUDGED = 1.5  # typical error factor of an estimate from a faint frame
_FAR = 3.0  # times the best light so far; smaller steps are safe extrapolations

_USUAL_PERCENT = 90.0  # percentile of the cells; the rest may contain hot pixels or cosmic rays
_TOP_PERCENT = 98.0  # percentile of the cells if so few are lit that the usual one is dark
_MOST_UNEVEN = 3.0  # ratio of top to usual cell above which the usual one is dark
_OUTSTANDING = 1.3  # times the usual cell; the middle of a beam as wide as the array stays below
_HOT = 3.0  # times the spread of its neighbours above all of them; neither a star's peak nor noise reaches it
_FROM_1_TO_10 = 1.0448  # standard deviations between the 1st and 10th percentile of a normal distribution
_FROM_10_TO_50 = 1.2816  # standard deviations; at least 10 % of the pixels lie between the subimages
_LEAST_NOISE_COUNTS = 0.3  # rounding
_HIDDEN_NOISE_COUNTS = 1.0  # that a frame whose dark pixels are clipped to 0 may hide
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.bool_)


@dataclass(frozen=True, slots=True)
class AutoExposure:
    """Exposure and current, as set, and how they were found."""

    exposure_s: float
    current_a: float
    fill: float  # of full scale, in the last frame
    frames: int  # test frames


def auto_expose(devices: Devices, cell_px: float, callbacks: RoutineCallbacks, *, fill: float = FILL) -> AutoExposure:
    """Set exposure, and current if needed, so that the brightest lenslets fill `fill` of full scale.

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
            frame = next_frame(camera, callbacks.should_stop)
            camera.stop()
            check_lit(devices.light)
            full_scale = camera.capabilities.full_scale  # some cameras show it only by their frames
            seen = brightness(frame.pixels, cell_px)
            is_reached = abs(seen.level / full_scale - fill) <= TOLERANCE
            shots.append(Shot(taken, seen, seen.level >= SATURATED * full_scale))
            callbacks.progress(frame, 1.0 if is_reached else len(shots) / MOST_FRAMES)
            if is_reached:
                if seen.level - seen.background < _LEAST_CONTRAST * seen.level:
                    why = "light falls on the camera, but shows no subimages: switch the lamp on, and cover the setup"
                    raise RoutineError(why)
                state.exposure_s, state.current_a = camera.exposure_s, devices.light.current_a
                return AutoExposure(state.exposure_s, state.current_a, seen.level / full_scale, len(shots))
            wanted = next_light(shots, fill * full_scale, full_scale=full_scale, reach=control.reach)
            light = control.possible(wanted, shots)
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
        exposure_s = camera.set_exposure(self._exposures_s.nearest(wanted_s))
        least = light * (1 - _EXACT)
        if exposure_s * self._currents_a.maximum < least:  # one exposure step too short at the maximum current
            exposure_s = camera.set_exposure(self._exposures_s.nearest(_LONGER * wanted_s))
        if self._is_fixed:
            return exposure_s
        if abs(exposure_s * current_a / light - 1) > _EXACT:
            current_a = self._currents_a.nearest(light / exposure_s)
        return exposure_s * lamp.set_current(current_a)


@dataclass(frozen=True, slots=True)
class Shot:
    """A test frame."""

    light: float  # A s
    brightness: Brightness
    is_saturated: bool


@dataclass(frozen=True, slots=True)
class Reach:
    """Range of possible light, A s."""

    lowest: float
    lowest_by_exposure: float  # at the initial current, tried before lowering the current
    highest: float


def next_light(shots: list[Shot], goal: float, *, full_scale: float, reach: Reach) -> float:
    """Return the light expected to give the level `goal` (counts), or one that tells more.

    It may exceed `reach`: so much would be needed; 0 if any light is too much, infinity if none was detected.
    """
    dim = [shot for shot in shots if not shot.is_saturated]
    too_much = min((shot.light for shot in shots if shot.is_saturated), default=math.inf)
    background = min((shot.brightness.background for shot in dim), default=0.0)
    signals = [_signal(shot.brightness, background, full_scale) for shot in dim]
    seen = [(shot, signal) for shot, signal in zip(dim, signals, strict=True) if signal > _SEEN * shot.brightness.noise]
    enough = too_much * goal / (SATURATED * full_scale)  # or more
    # A weak signal that a frame with more light does not show was noise.
    seen = [
        (shot, signal)
        for shot, signal in seen
        if signal > _CLEAR * shot.brightness.noise
        or all(other > signal for brighter, other in zip(dim, signals, strict=True) if brighter.light > shot.light)
    ]
    if not seen:
        return _next_in_the_dark(shots, goal - background, enough, reach)
    best, signal = min(seen, key=lambda each: abs(each[0].brightness.level - goal))
    wanted = goal - (best.brightness.level - signal)
    if wanted <= 0:
        return 0.0
    light = best.light * wanted / signal
    if light < _FAR * best.light:
        return light if light < too_much else math.sqrt(best.light * too_much)
    light /= 1 + 2 * best.brightness.noise / signal  # better too dark than saturated
    return light if light < enough else max(math.sqrt(best.light * too_much), enough / _MISJUDGED)


def _signal(seen: Brightness, background: float, full_scale: float) -> float:
    """Counts by which the light raised the level."""
    if seen.level > _BRIGHT * full_scale:
        return seen.level - min(background, _MOST_BACKGROUND * full_scale)
    signal = seen.level - background
    return signal if signal > _CLEAR * seen.noise else signal - _BRIGHTEST_NOISE * seen.noise


def _next_in_the_dark(shots: list[Shot], wanted: float, highest: float, reach: Reach) -> float:
    """Bisect while all frames were black or saturated; infinity if no more light is possible.

    A frame detects light down to 1 / `span` of the goal; the remaining range below `highest` is counted in spans.
    Shorter exposures are tried before lower currents, unless two saturated frames leave little of them, or too few
    frames remain for both.
    """
    span, too_little = min(_USUAL_SPAN, wanted / (_SEEN * _USUAL_NOISE_COUNTS)), 0.0
    black = [shot for shot in shots if not shot.is_saturated]
    for shot in black:
        span = max(wanted / (_SEEN * shot.brightness.noise), 2 * _FAINT)
        too_little = max(too_little, shot.light * span)
    if too_little >= reach.highest:
        return math.inf
    highest, lowest = min(highest, reach.highest), reach.lowest_by_exposure

    def spans_above(least: float) -> int:
        left = max(highest / max(least, too_little), 1.0)
        return max(1, math.ceil(math.log(left) / math.log(span / _FAINT) - 1e-9))

    is_nearly_at_its_end = len(shots) - len(black) > 1 and highest < _LITTLE * lowest
    is_urgent = math.log2(spans_above(reach.lowest)) + _TO_REFINE > MOST_FRAMES - len(shots) - 1
    if highest < lowest or is_nearly_at_its_end or is_urgent:
        lowest = reach.lowest
    spans = spans_above(lowest)
    aim = max(highest / (span / _FAINT) ** (spans - spans // 2), lowest)
    return max(aim, min(too_little, highest)) if len(black) < len(shots) else aim


@dataclass(frozen=True, slots=True)
class Brightness:
    """Brightness of one frame, in counts."""

    level: float  # brightest pixel of the brightest lenslets, with background: what saturates
    background: float
    noise: float  # of a dark pixel, standard deviation


def brightness(pixels: NDArray[np.integer[Any]], cell_px: float) -> Brightness:
    """Measure a frame (row, column), counts, with about one lenslet per square of `cell_px` pixels.

    Each cell contributes its brightest pixel, single hot ones excluded; outlying cells are excluded from the level.
    """
    light = pixels.astype(np.float32)
    darkest, dark, middle = (float(value) for value in np.percentile(light, (1, 10, 50)))
    of_steps = SIGMA_OF_MEDIAN * float(np.median(np.abs(np.diff(light, axis=1)))) / np.sqrt(2)
    noise = max(min(of_steps, (dark - darkest) / _FROM_1_TO_10), _LEAST_NOISE_COUNTS)  # both may include subimages
    if darkest <= 0:  # half of the noise is clipped
        noise = max(of_steps, _HIDDEN_NOISE_COUNTS)
    background = min(dark + _FROM_10_TO_50 * noise, middle)
    brightest = ndimage.maximum_filter(light, footprint=_NEIGHBOURS, mode="mirror")
    faintest = ndimage.minimum_filter(light, footprint=_NEIGHBOURS, mode="mirror")
    is_hot = light - brightest > _HOT * np.maximum(brightest - faintest, noise)
    cells = np.where(is_hot, brightest, light)
    for axis, length in enumerate(light.shape):
        count = max(1, int(length / cell_px))
        first_px = (np.arange(count) * (length / count)).astype(np.intp)  # of every cell
        cells = np.maximum.reduceat(cells, first_px, axis=axis)
    above = cells - background
    usual, top = np.percentile(above, (_USUAL_PERCENT, _TOP_PERCENT), method="lower")
    usual = max(usual if usual > top / _MOST_UNEVEN else top, 0.0)
    return Brightness(background + float(np.max(above[above <= _OUTSTANDING * usual])), background, noise)
