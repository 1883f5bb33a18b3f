"""Where in `frames.jsonl` each frame's line stands; after damage not always where it belongs.

A block of the disk that is lost takes the ends of lines with it, and all lines after it come too early.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from app.recording.frame_line import FrameLine

LOST = b"{}\n"  # stands for a line that cannot be read, so that the others stand where they belong


@dataclass(frozen=True, slots=True)
class LinePlaces:
    """The lines that can be read."""

    path: Path
    spans: Mapping[int, tuple[int, int]]  # of each frame's line: bytes, from and to
    lost: frozenset[int]  # where a `LOST` begins

    def line(self, index: int) -> FrameLine | None:
        """The line of a frame; None when it cannot be read."""
        if index not in self.spans:
            return None
        return FrameLine.from_json(_text(self.path, *self.spans[index]))

    def end_in_place(self, frames: int) -> int | None:
        """Where the first so many lines end, if each stands where it belongs; None if one does not."""
        end = 0
        for index in range(frames):
            begin, after = self.spans.get(index, (end, end + len(LOST)) if end in self.lost else (-1, -1))
            if begin != end:
                return None
            end = after
        return end

    def in_place(self, frames: int) -> Iterator[bytes]:
        """The first so many lines, each where it belongs."""
        with self.path.open("rb") as file:
            for index in range(frames):
                begin, end = self.spans.get(index, (0, 0))
                file.seek(begin)
                yield file.read(end - begin) or LOST


def find_lines(path: Path) -> LinePlaces:
    """Look for every line that can be read; of two unlike ones that claim to be of one frame, neither is believed."""
    spans: dict[int, tuple[int, int]] = {}
    lost, twice = set(), set()
    with path.open("rb") as file:
        end = 0
        for text in file:
            begin, end = end, end + len(text)
            if text == LOST:
                lost.add(begin)
            elif text.endswith(b"\n") and (index := _index_of(text)) is not None:
                first = spans.setdefault(index, (begin, end))
                if first != (begin, end) and _text(path, *first) != text:
                    twice.add(index)
    return LinePlaces(path, {index: span for index, span in spans.items() if index not in twice}, frozenset(lost))


def _text(path: Path, begin: int, end: int) -> bytes:
    with path.open("rb") as file:
        file.seek(begin)
        return file.read(end - begin)


def _index_of(text: bytes) -> int | None:
    try:
        return FrameLine.from_json(text).index
    except ValueError:
        return None
