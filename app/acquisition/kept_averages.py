"""Darks or references that the instrument keeps: one for each sensor region, and for references each mask."""

from dataclasses import dataclass

from app.acquisition.validity import Validity, about, as_averaged, doubt, fits, note, validity
from app.measurement.averages import Average
from app.measurement.routines import Circumstances
from drivers.interface import Region

_MOST = 8  # each as large as two frames of floats


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    average: Average
    circumstances: Circumstances
    how: str  # time and settings, for people


class KeptAverages:
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

    def keep(self, average: Average, now: Circumstances) -> None:
        """Use a new average, and keep it in place of an older one of the same region and mask."""
        self._used = _Taken(average, now, about(average, now))
        key = self._key(now)
        self._kept.pop(key, None)
        self._kept[key] = self._used
        if len(self._kept) > _MOST:
            del self._kept[next(iter(self._kept))]

    def use_recorded(self, average: Average | None, now: Circumstances) -> None:
        """Use an average of a recording, or none."""
        self._used = None if average is None else _Taken(average, as_averaged(now, average), "as recorded")

    def choose(self, now: Circumstances) -> None:
        """Use the average that was taken of the current region and with the current mask, if there is one."""
        self._used = self._kept.get(self._key(now), self._used)

    def fitting(self, now: Circumstances) -> Average | None:
        """Return the average in use if it shows the same pixels as the current frames."""
        return self._used.average if self._used is not None and fits(self._used.circumstances, now) else None

    def doubt(self, now: Circumstances) -> str:
        """Return why the average does not fit the current frames; empty if it does."""
        taken = None if self._used is None else self._used.circumstances
        return doubt(self._what, taken, now, is_lit=self._is_lit)

    def validity(self, why: str) -> Validity:
        """Return the validity, doubtful for this reason."""
        return validity(self.average, why)

    def note(self, why: str) -> str:
        """Return how the average was taken and, on a second line, why it is doubtful."""
        return note("none yet" if self._used is None else self._used.how, why)

    def _key(self, circumstances: Circumstances) -> tuple[Region, int, str]:
        return circumstances.region, circumstances.binning, circumstances.mask if self._is_lit else ""
