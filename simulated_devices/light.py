"""The light of the simulated bench."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.interface import LightSource, Range
from simulated_devices.connection import Connection

if TYPE_CHECKING:
    from simulated_devices.bench import SimulatedBench


class SimulatedLight(LightSource):
    """An LED whose light is proportional to its current."""

    def __init__(self, bench: SimulatedBench) -> None:
        self._bench = bench
        self._connection = Connection("light")
        bench.change(is_light_on=False)

    @property
    def name(self) -> str:
        """What it is."""
        return "Simulated LED"

    @property
    def current_range_a(self) -> Range:
        """The currents that the LED allows."""
        self._connection.check()
        return Range(0.0, self._bench.light_settings.maximum_current_a)

    @property
    def current_a(self) -> float:
        """The current that flows when the light is on."""
        self._connection.check()
        return self._bench.condition.current_a

    def set_current(self, current_a: float) -> float:
        """Change the current; return the one in force."""
        self._bench.change(current_a=self.current_range_a.check(current_a, "current_a"))
        return current_a

    @property
    def is_on(self) -> bool:
        """Whether the light is lit."""
        self._connection.check()
        return self._bench.condition.is_light_on

    def set_on(self, on: bool) -> None:
        """Switch the light."""
        self._connection.check()
        self._bench.change(is_light_on=on)

    def unplug(self) -> None:
        """Pull the plug, as a fault: the light goes out and every call raises `Disconnected`."""
        self._bench.change(is_light_on=False)
        self._connection.unplug()

    def close(self) -> None:
        """Switch off and let go; closing twice is allowed."""
        if not self._connection.is_closed:
            self._bench.change(is_light_on=False)
            self._connection.is_closed = True
