"""What is being done, and how much of it: what long work tells whoever waits for it."""

from __future__ import annotations

from collections.abc import Callable

Report = Callable[[str, float], None]  # what is being done, and how much of it, 0 ... 1


def part(report: Report, index: int, count: int) -> Report:
    """Return the report of one part of several."""
    return between(report, index / count, (index + 1) / count)


def named(report: Report, name: str) -> Report:
    """Return the report of work that says first what it belongs to."""
    return lambda text, fraction: report(f"{name}: {text}", fraction)


def between(report: Report, first: float, last: float) -> Report:
    """Return the report of work that is the share from `first` to `last` of the whole."""
    return lambda text, fraction: report(text, first + (last - first) * fraction)
