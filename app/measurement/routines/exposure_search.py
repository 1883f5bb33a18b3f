"""Search for the right light: bisection until a frame shows signal, then proportion.

`light` is exposure times current, A s. A frame that is neither black nor saturated gives the right light within a few
percent, over three orders of magnitude. A saturated frame gives an upper bound, a black one a lower bound from its
noise.
"""

import math
from dataclasses import dataclass

from app.measurement.routines.brightness import Brightness

MOST_FRAMES = 6
SATURATED = 0.95  # of full scale; above it pixels may saturate before the converter
_SEEN = 5.0  # noises; a signal above this is detected
_BRIGHTEST_NOISE = 4.0  # noises by which a dark cell's brightest pixel exceeds the background
_CLEAR = 50.0  # noises; above this the noise hardly matters, and apparent noise may be the image
_BRIGHT = 0.25  # of full scale; a level above this is light
_MOST_BACKGROUND = 0.05  # of full scale; a camera's background is less, more is light between the subimages
_FAINT = 3.0  # times the detection limit: enough for an estimate
_USUAL_SPAN = 1000.0  # ratio of the goal to the detection limit until a frame has shown the noise
_USUAL_NOISE = 0.8  # counts of a camera with few bits, until a frame has shown the noise
_TO_REFINE = 2  # frames needed after the first detection
_LITTLE = 10.0  # times the least light that exposure alone allows
_MISJUDGED = 1.5  # typical error factor of an estimate from a faint frame
_FAR = 3.0  # times the best light so far; smaller steps are safe extrapolations


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


def next_light(shots: list[Shot], goal: float, full_scale: float, reach: Reach) -> float:
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
    span, too_little = min(_USUAL_SPAN, wanted / (_SEEN * _USUAL_NOISE)), 0.0
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
