"""What is being done, and how much of it: what long work tells whoever waits for it."""

from __future__ import annotations

from collections.abc import Callable

Report = Callable[[str, float], None]  # what is being done, and how much of it, 0 ... 1


def part(report: Report, index: int, count: int) -> Report:
    """Return the report of one part of several."""
    return lambda text, fraction: report(text, (index + fraction) / count)


def named(report: Report, name: str) -> Report:
    """Return the report of work that says first what it belongs to."""
    return lambda text, fraction: report(f"{name}: {text}", fraction)
