"""Discovery of connected devices.

Each driver offers `discover() -> tuple[DiscoveredDevice, ...]`. It changes nothing, switches nothing on, and raises
`Unsupported`, naming what is missing, if it cannot search.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoveredDevice:
    """A connected device and the bench settings that select it."""

    kind: Literal["camera", "light"]
    driver: str  # name in a bench
    description: str  # maker, model and serial number, as far as known without opening it
    settings: Mapping[str, str | int] = field(default_factory=dict)  # keys of the bench's section
    is_certain: bool = True  # False for a serial port that could belong to another device
    missing: str = ""  # what prevents its use, such as a permission or a cable

    @property
    def name(self) -> str:
        """Argument for `svwfs devices --check`."""
        return ":".join([self.driver, *map(str, self.settings.values())])
