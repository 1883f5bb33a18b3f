"""The light and the stage of the simulated bench."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.interface import LightSource, Range, Stage

if TYPE_CHECKING:
    from simulated_devices.bench import SimulatedBench


class SimulatedLight(LightSource):
    """An LED whose light is proportional to its current."""

    def __init__(self, bench: SimulatedBench, *, limit_a: float | None = None) -> None:
        super().__init__(limit_a=limit_a, sleep=bench.clock.sleep)
        self._bench = bench
        self._begin()

    @property
    def name(self) -> str:
        """Name of the device."""
        return "Simulated LED"

    def _read_range(self) -> Range:
        return Range(0.0, self._bench.light_settings.maximum_current_a)

    def _read_current(self) -> float:
        return self._bench.condition.current_a

    def _set_current(self, current_a: float) -> float:
        self._bench.change(current_a=current_a)
        return current_a

    def _is_lit(self) -> bool:
        return self._bench.condition.is_light_on

    def _switch(self, *, on: bool) -> None:
        self._bench.change(is_light_on=on)

    def _close(self) -> None:
        """Change nothing."""


class SimulatedStage(Stage):
    """Moves at once; a mask that is put in for the first time takes the time to render its first image."""

    def __init__(self, bench: SimulatedBench) -> None:
        super().__init__()
        self._bench = bench

    @property
    def name(self) -> str:
        """Name of the device."""
        return "Simulated stage"

    def _read_masks(self) -> tuple[str, ...]:
        return self._bench.simulation.source.masks

    def _read_mask(self) -> str:
        return self._bench.condition.mask

    def _set_mask(self, mask: str) -> None:
        self._bench.change(mask=mask)

    def _is_sample_in(self) -> bool:
        return self._bench.condition.is_sample_in

    def _set_sample_in(self, *, sample_in: bool) -> None:
        self._bench.change(is_sample_in=sample_in)

    def _close(self) -> None:
        """Change nothing."""
