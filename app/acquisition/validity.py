"""Validity of a dark or a reference for the current frames."""

import re
from dataclasses import replace
from datetime import datetime
from typing import Literal

from app.measurement.averages import Average
from app.measurement.routines import Circumstances
from app.progress import counted

Validity = Literal["missing", "doubtful", "good"]
_TIME = re.compile(r"^\d+ frames? at (\d\d:\d\d):\d\d: ")


def as_averaged(now: Circumstances, average: Average) -> Circumstances:
    """Circumstances of an average; what it does not store is assumed unchanged."""
    return replace(now, exposure_s=average.exposure_s, em_gain=average.em_gain, amplifier=average.amplifier)


def fits(taken: Circumstances | None, now: Circumstances) -> bool:
    """True if an average covers the same pixels as the current frames."""
    return taken is not None and taken.shows_same_pixels(now)


def doubt(what: str, taken: Circumstances | None, now: Circumstances, *, is_lit: bool) -> str:
    """Return why a dark or reference does not fit the current frames; empty if it does."""
    if taken is None:
        return "no dark yet: the background is a guess" if what == "dark" else f"no {what} yet: take one"
    changed = taken.differs(now, is_lit=is_lit)
    return f"the {what} was taken {changed}: take it again" if changed else ""


def about(average: Average, taken: Circumstances) -> str:
    """Time and settings of an average, for people."""
    return (
        f"{counted(average.frames)} at {datetime.now().astimezone():%H:%M:%S}:"
        f" exposure {taken.exposure_s * 1e3:.4g} ms, amplifier {taken.amplifier},"
        f" gain {taken.em_gain:.4g}, mask {taken.mask}"
    )


def taken_at(note: str) -> str:
    """Return hours and minutes from a note that begins as `about`; empty if there is no average or it was recorded."""
    found = _TIME.search(note)
    return found[1] if found else ""


def note(how: str, why: str) -> str:
    """Return how an average was taken and, on a second line, why it is doubtful."""
    return f"{how}\n{why}" if why else how


def validity(average: Average | None, why: str) -> Validity:
    """Return the validity of an average that is doubtful for this reason."""
    if average is None:
        return "missing"
    return "doubtful" if why else "good"
