"""The stage of the simulated bench: mask and sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.interface import Stage
from simulated_devices.connection import PluggedThroughout

if TYPE_CHECKING:
    from simulated_devices.bench import SimulatedBench


class SimulatedStage(PluggedThroughout, Stage):
    """Moves at once; a mask that was never in before takes the time to render its first image."""

    def __init__(self, bench: SimulatedBench) -> None:
        super().__init__()
        self._bench = bench

    @property
    def name(self) -> str:
        """What it is."""
        return "Simulated stage"

    def _read_masks(self) -> tuple[str, ...]:
        return self._bench.simulation.source.masks

    def _read_mask(self) -> str:
        return self._bench.condition.mask

    def _set_mask(self, mask: str) -> None:
        self._accept("the mask")
        self._bench.change(mask=mask)

    def _is_sample_in(self) -> bool:
        return self._bench.condition.is_sample_in

    def _set_sample_in(self, *, sample_in: bool) -> None:
        self._accept("to move the sample")
        self._bench.change(is_sample_in=sample_in)

    def _close(self) -> None:
        """Stay as it is."""
