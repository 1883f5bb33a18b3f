"""Interval of allowed values."""

from dataclasses import dataclass

from drivers.errors import BadValue


@dataclass(frozen=True, slots=True)
class Range:
    """Closed interval of allowed values, in the unit of its setting."""

    minimum: float
    maximum: float

    def check(self, value: float, what: str) -> float:
        """Return `value` if it is in the interval, else raise `BadValue` naming `what` and the interval."""
        if not self.minimum <= value <= self.maximum:  # false for NaN, too
            raise BadValue(f"{what} = {value:g} is outside {self.minimum:g} ... {self.maximum:g}")
        return value
