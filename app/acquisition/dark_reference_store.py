"""Darks or references retained for each sensor region and mask, and their validity."""

from dataclasses import dataclass, replace
from datetime import datetime
from typing import Literal

from app.measurement.averages import Average
from app.measurement.routines import AcquisitionSettings
from app.progress import counted
from drivers.interface import Region

Validity = Literal["missing", "doubtful", "good"]
_MOST = 8  # each as large as two frames of floats


@dataclass(frozen=True, slots=True)
class AverageState:
    """State of a dark or reference, as the window shows it."""

    how: str = ""  # time and settings; empty if there is none
    taken_at: str = ""  # hours and minutes; empty if it was recorded
    doubt: str = ""  # why it is doubtful

    @property
    def validity(self) -> Validity:
        """The validity in a word."""
        if not self.how:
            return "missing"
        return "doubtful" if self.doubt else "good"

    @property
    def note(self) -> str:
        """One line on how it was taken, and one on why it is doubtful."""
        return "\n".join(filter(None, (self.how or "none yet", self.doubt)))


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    average: Average
    settings_then: AcquisitionSettings
    state: AverageState  # without doubt


class DarkReferenceStore:
    """The average in use, and the newest of each region and binning, and if lit of each mask."""

    def __init__(self, what: str, *, is_lit: bool) -> None:
        """`what`, "dark" or "reference", is its name in messages."""
        self._what, self._is_lit = what, is_lit
        self._used: _Taken | None = None
        self._kept: dict[tuple[Region, int, str], _Taken] = {}

    @property
    def average(self) -> Average | None:
        """The average in use."""
        return None if self._used is None else self._used.average

    def keep(self, average: Average, now: AcquisitionSettings) -> None:
        """Use a new average."""
        time = datetime.now().astimezone()
        how = (
            f"{counted(average.frames)} at {time:%H:%M:%S}:"
            f" exposure {now.exposure_s * 1e3:.4g} ms, amplifier {now.amplifier},"
            f" gain {now.em_gain:.4g}, mask {now.mask}"
        )
        self._use(_Taken(average, now, AverageState(how, f"{time:%H:%M}")), now)

    def use_recorded(self, average: Average | None, now: AcquisitionSettings) -> None:
        """Use an average of a recording, or none; circumstances that it lacks are assumed unchanged."""
        if average is None:
            self._use(None, now)
        else:
            exposure_s, em_gain, amplifier = average.exposure_s, average.em_gain, average.amplifier
            then = replace(now, exposure_s=exposure_s, em_gain=em_gain, amplifier=amplifier)
            self._use(_Taken(average, then, AverageState("as recorded")), now)

    def choose(self, now: AcquisitionSettings) -> Average | None:
        """Use the average of the current region and mask, if there is one; return the one in use if it fits."""
        self._used = self._kept.get(self._key(now), self._used)
        return self.fitting(now)

    def fitting(self, now: AcquisitionSettings) -> Average | None:
        """Return the average in use if it shows the same pixels as the current frames."""
        fits = self._used is not None and self._used.settings_then.shows_same_pixels(now)
        return self.average if fits else None

    def doubt(self, now: AcquisitionSettings) -> str:
        """Return why the average does not fit the current frames; empty if it does."""
        if self._used is None:
            advice = "take the sample out and take one" if self._is_lit else "background estimated: take one (D)"
            return f"no {self._what} yet: {advice}"
        changed = self._used.settings_then.difference(now, is_lit=self._is_lit)
        return f"the {self._what} was taken {changed}: take it again" if changed else ""

    def state(self, doubt: str) -> AverageState:
        """Return the state of the average in use; `doubt` is why it is doubtful, or empty."""
        return replace(AverageState() if self._used is None else self._used.state, doubt=doubt)

    def _use(self, taken: _Taken | None, now: AcquisitionSettings) -> None:
        """Use it, and keep it in place of an older one of the same region and mask."""
        key = self._key(now)
        kept = {other: one for other, one in self._kept.items() if other != key}
        if taken is not None:
            kept[key] = taken
        self._used, self._kept = taken, dict(list(kept.items())[-_MOST:])  # a copy of the store keeps the former

    def _key(self, settings_then: AcquisitionSettings) -> tuple[Region, int, str]:
        return settings_then.region, settings_then.binning, settings_then.mask if self._is_lit else ""
