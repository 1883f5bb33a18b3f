"""What of a recording is damaged, frame by frame, and what is whole."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from app.errors import InputError
from app.recording.line_places import LinePlaces
from app.recording.reader import Recording

_RANGES = 20  # that are named; of more it is told how many they are


@dataclass(frozen=True, slots=True)
class Examined:
    """What a look at every frame has found."""

    reconstructed: int
    lost: int  # by the camera, in gaps
    gaps: int
    whole: Sequence[int]  # frames whose line and pixels can be read
    damage: tuple[str, ...]  # a sentence for each kind; empty when all is whole


def examine(recording: Recording, lines: LinePlaces, frames: int, progress: Callable[[float], None]) -> Examined:
    """Look at line, pixels and results of so many frames, and at the calibrations and biases that they name."""
    without_line, without_pixels, without_results, whole = [], [], [], []
    calibrations: set[int | None] = set()
    biases: set[int | None] = set()
    reconstructed = lost = gaps = 0
    for index in range(frames):
        line, has_pixels = lines.line(index), recording.is_whole(index)
        if line is None:
            without_line.append(index)
        else:
            reconstructed, lost, gaps = reconstructed + (not line.problem), lost + line.lost, gaps + (line.lost > 0)
            calibrations.add(line.calibration)
            biases.add(line.bias)
            if has_pixels and not recording.has_results(line):
                without_results.append(index)
        if not has_pixels:
            without_pixels.append(index)
        elif line is not None:
            whole.append(index)
        progress((index + 1) / frames)
    of_frames = (
        (without_line, "there is no line that can be read"),
        (without_pixels, "the pixels are missing, or some of them"),
        (without_results, "what was found live is missing; svwfs replay finds it again"),
    )
    damage = [f"{frames_in_words(which)}: {what}" for which, what in of_frames if which]
    damage += [*_faults(recording.calibration, calibrations), *_faults(recording.bias, biases)]
    return Examined(reconstructed, lost, gaps, whole, tuple(damage))


def frames_in_words(frames: Sequence[int]) -> str:
    """Name some frames, in their order: "frames 0 to 2 and 4"."""
    ranges = ranges_of(frames)
    named = [f"{some[0]}" if len(some) == 1 else f"{some[0]} to {some[-1]}" for some in ranges[:_RANGES]]
    if len(ranges) > _RANGES:
        named.append(f"{sum(map(len, ranges[_RANGES:]))} more")
    text = " and ".join([", ".join(named[:-1]), named[-1]] if len(named) > 1 else named)
    return f"frame{'s' * (len(frames) != 1)} {text or 'none'}"


def ranges_of(frames: Sequence[int]) -> list[range]:
    """Frames in their order, those that follow one another together."""
    ranges: list[range] = []
    for index in frames:
        if ranges and ranges[-1].stop == index:
            ranges[-1] = range(ranges[-1].start, index + 1)
        else:
            ranges.append(range(index, index + 1))
    return ranges


def _faults(read: Callable[[int], object], numbers: Iterable[int | None]) -> Iterator[str]:
    """Why some of these cannot be read."""
    for number in sorted(number for number in numbers if number is not None):
        try:
            read(number)
        except InputError as error:
            yield str(error)
