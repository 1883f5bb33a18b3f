"""What a search for devices finds.

Every driver's module, or one beside it, offers `find() -> tuple[Found, ...]`: it opens nothing that would change
anything, switches nothing on, and raises `Unsupported` with what is missing where it cannot even look.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

DeviceKind = Literal["camera", "light"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """A device that is connected, and how a bench names it."""

    kind: DeviceKind
    driver: str  # as a bench names it
    description: str  # maker, model and serial number, as far as it tells without being opened
    settings: Mapping[str, str | int] = field(default_factory=dict)  # keys of the bench's section that lead to this one
    is_certain: bool = True  # a serial port does not say what hangs on it
    missing: str = ""  # what it takes to use it, when it is seen but cannot be opened as it is: a permission, a cable

    @property
    def name(self) -> str:
        """What `svwfs devices --check` calls it."""
        return ":".join([self.driver, *map(str, self.settings.values())])
