"""Which light to try next, when some have been tried: bisection as long as nothing was seen, then proportion.

`light` is exposure times current, A s. A frame that is neither black nor saturated says within a few percent which
light is the right one, over some three orders of magnitude. One that is saturated says only that it was too much, a
black one that it was too little by more than what the noise hides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from app.measurement.routines.brightness import Brightness

MOST_FRAMES = 6
SATURATED = 0.95  # of full scale; above it the pixels may be full before the converter is
_SEEN = 5.0  # noises above what noise alone makes of the brightest pixels
_BRIGHTEST_NOISE = 4.0  # noises that the brightest of a dark cell's pixels lies above the background
_CLEAR = 50.0  # noises; above it that hardly matters, and what looks like noise may be the image
_BRIGHT = 0.25  # of full scale; a level above it is light, and
_MOST_BACKGROUND = 0.05  # of full scale is what a camera has without; more lies as light between the subimages
_FAINT = 3.0  # times what can just be seen: enough to go by
_USUAL_SPAN = 1000.0  # of light between just seen and the goal, as long as no frame has shown the noise
_USUAL_NOISE = 0.8  # counts, of a camera with few bits, likewise
_TO_REFINE = 2  # frames, from one that shows a little
_LITTLE = 10.0  # times the least that exposure alone allows
_MISJUDGED = 1.5  # times, usually, the goal was missed by what a faint frame had let expect
_FAR = 3.0  # times the light that was seen; less is no leap in the dark


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame that was tried."""

    light: float  # A s
    brightness: Brightness
    is_saturated: bool


@dataclass(frozen=True, slots=True)
class Reach:
    """What light there can be, A s."""

    lowest: float
    lowest_by_exposure: float  # at the current that was found: what is tried before the current is lowered
    highest: float


def next_light(shots: list[Shot], goal: float, full_scale: float, reach: Reach) -> float:
    """Light with which the level is expected to be `goal` counts, or from which more can be learnt.

    It may lie out of reach: that is how much would be needed; 0 where any is too much, infinity where none was seen.
    """
    dim = [shot for shot in shots if not shot.is_saturated]
    too_much = min((shot.light for shot in shots if shot.is_saturated), default=math.inf)
    background = min((shot.brightness.background for shot in dim), default=0.0)
    signals = [_signal(shot.brightness, background, full_scale) for shot in dim]
    seen = [(shot, signal) for shot, signal in zip(dim, signals, strict=True) if signal > _SEEN * shot.brightness.noise]
    enough = too_much * goal / (SATURATED * full_scale)  # or more than that
    # What a frame hardly shows and one with more light does not, was noise.
    seen = [
        (shot, signal)
        for shot, signal in seen
        if signal > _CLEAR * shot.brightness.noise
        or all(other > signal for brighter, other in zip(dim, signals, strict=True) if brighter.light > shot.light)
    ]
    if not seen:
        return _where_to_look(shots, goal - background, enough, reach)
    best, signal = min(seen, key=lambda each: abs(each[0].brightness.level - goal))
    wanted = goal - (best.brightness.level - signal)
    if wanted <= 0:
        return 0.0
    light = best.light * wanted / signal
    if light < _FAR * best.light:
        return light if light < too_much else math.sqrt(best.light * too_much)
    light /= 1 + 2 * best.brightness.noise / signal  # rather too little than saturated
    return light if light < enough else max(math.sqrt(best.light * too_much), enough / _MISJUDGED)


def _signal(seen: Brightness, background: float, full_scale: float) -> float:
    """Counts by which the light raised the level."""
    if seen.level > _BRIGHT * full_scale:
        return seen.level - min(background, _MOST_BACKGROUND * full_scale)
    signal = seen.level - background
    return signal if signal > _CLEAR * seen.noise else signal - _BRIGHTEST_NOISE * seen.noise


def _where_to_look(shots: list[Shot], wanted: float, highest: float, reach: Reach) -> float:
    """Light that halves what is left, when all frames were black or saturated; infinity when nothing is left above.

    A frame shows any light down to that which is `span` times too weak, so that so many spans are left, counted from
    the `highest`. The shorter exposure is tried before the lower current, unless little is left of it after two
    saturated frames, or there are too few frames for one after the other.
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
