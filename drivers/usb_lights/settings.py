"""Bench settings of LED light sources on USB."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class DC2200Settings:
    """Selection and settings of a Thorlabs DC2200."""

    driver: Literal["thorlabs_dc2200"] = "thorlabs_dc2200"
    serial_number: str = ""  # needed if there is more than one
    terminal: int = 1  # 1 has 12 pins and up to 10 A, 2 has 4 pins and up to 2 A
    gate: Literal["internal", "ttl"] = "internal"
    current_a: float | None = None  # None keeps its value
    limit_a: float | None = None  # owner's limit, below that of the head

    def __post_init__(self) -> None:
        if self.terminal not in {1, 2}:
            raise ValueError("terminal must be 1 or 2")
        if self.gate not in {"internal", "ttl"}:
            raise ValueError('gate must be "internal" or "ttl"')
        if self.limit_a is not None and not 0 < self.limit_a <= 10:
            raise ValueError("limit_a must be positive, and at most 10")
