"""The light that a person switches."""

from dataclasses import dataclass
from typing import Literal

from drivers.device import Range, switched
from drivers.errors import WrongState
from drivers.light_source import LightSource


@dataclass(frozen=True, slots=True, kw_only=True)
class ManualLightSettings:
    """A light that a person switches."""

    driver: Literal["manual"] = "manual"


class ManualLight(LightSource):
    """Knows what a person has said; before that, and after closing, the light counts as on.

    It has no current: the only allowed one is 0. Closing sends nothing, as there is nothing to send it to.
    """

    def __init__(self, _settings: ManualLightSettings = ManualLightSettings()) -> None:
        super().__init__()
        self._name = "manual light"
        self._is_noted_on = True

    def note_light(self, on: bool) -> None:
        """Record that a person has switched the light."""
        with self._access():
            self._is_noted_on = self._is_noted_lit = switched(on)

    def set_on(self, on: bool) -> None:
        """Raise `WrongState` unless a person has noted that it is so."""
        with self._access():
            if switched(on) != self._is_noted_on:
                raise WrongState(f"the light is manual: switch it {'on' if on else 'off'} by hand, then confirm (L)")

    def _read_range(self) -> Range:
        return Range(0.0, 0.0)

    def _read_current(self) -> float:
        return 0.0

    def _set_current(self, current_a: float) -> float:
        return current_a

    def _is_lit(self) -> bool:
        return self._is_noted_on

    def _switch(self, *, on: bool) -> None:
        """Nothing to do: only a person can."""

    def _close(self) -> None:
        """Nothing to do."""
