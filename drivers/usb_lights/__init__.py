"""LED light sources on USB: their settings."""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le
from typing_extensions import Doc

from drivers.light_source import KEPT_CURRENT, OWNERS_LIMIT


@dataclass(frozen=True, slots=True, kw_only=True)
class DC2200Settings:
    """Selection and settings of a Thorlabs DC2200."""

    driver: Literal["thorlabs_dc2200"] = "thorlabs_dc2200"
    serial_number: Annotated[str, Doc("Serial number of the device; needed if there is more than one")] = ""
    terminal: Annotated[int, Ge(1), Le(2), Doc("Terminal: 1 with 12 pins, up to 10 A; 2 with 4 pins, up to 2 A")] = 1
    gate: Literal["internal", "ttl"] = "internal"
    current_a: Annotated[float, Ge(0), Le(10), KEPT_CURRENT] | None = None
    limit_a: Annotated[float, Gt(0), Le(10), OWNERS_LIMIT] | None = None
