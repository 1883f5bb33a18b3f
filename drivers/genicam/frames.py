"""Index and exposure of GenICam frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_LAST_SHORT_ID = 65535  # GigE Vision counts frames 1 ... 65535, then 1 again; some cameras count 0 ... 65535
_NEAR_WRAP = 1024  # frames that may be lost across a wrap; a number that falls back by less has begun again


@dataclass(slots=True)
class FrameCount:
    """Frame index since start, including lost frames, from the camera's frame numbers."""

    index: int = -1  # of the last frame
    _last_id: int = 0

    def advance(self, frame_id: int) -> int:
        """Return the index of the frame with this number; the first has index 0."""
        if self.index < 0:
            self.index = 0
        elif frame_id > self._last_id:
            self.index += frame_id - self._last_id
        else:  # only short numbers wrap around; others repeat or begin again
            step = (frame_id - self._last_id) % (_LAST_SHORT_ID + (frame_id == 0))
            self.index += step if self._last_id <= _LAST_SHORT_ID and 0 < step < _NEAR_WRAP else 1
        self._last_id = frame_id
        return self.index


@dataclass(slots=True)
class ExposureLog:
    """Exposure times of frames, if changed while the camera runs."""

    _changes: list[tuple[float, float]]  # (time of the change, exposure), both in s

    @classmethod
    def beginning_with(cls, exposure_s: float) -> ExposureLog:
        """Begin with this exposure."""
        return cls([(-np.inf, exposure_s)])

    def change(self, now_s: float, exposure_s: float) -> None:
        """Record the exposure of frames that begin from `now_s` on."""
        self._changes.append((now_s, exposure_s))

    def of_frame(self, sent_s: float) -> float:
        """Return the exposure of a frame sent then: the newest that could have ended before."""
        newest = max(i for i, (since_s, exposure_s) in enumerate(self._changes) if since_s + exposure_s <= sent_s)
        del self._changes[:newest]
        return self._changes[0][1]
