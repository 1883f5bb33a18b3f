"""The stage of the simulated bench: mask and sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.interface import BadValue, Stage
from simulated_devices.connection import Connection

if TYPE_CHECKING:
    from simulated_devices.bench import SimulatedBench


class SimulatedStage(Stage):
    """Moves at once; a mask that was never in before takes the time to render its first image."""

    def __init__(self, bench: SimulatedBench) -> None:
        self._bench = bench
        self._connection = Connection("stage")

    @property
    def masks(self) -> tuple[str, ...]:
        """The masks that can be put in."""
        self._connection.check()
        return self._bench.simulation.source.masks

    @property
    def mask(self) -> str:
        """The mask that is in."""
        self._connection.check()
        return self._bench.condition.mask

    def set_mask(self, mask: str) -> None:
        """Put another mask in."""
        if mask not in self.masks:
            raise BadValue(f"there is no mask {mask!r}; there are {', '.join(self.masks)}")
        self._bench.change(mask=mask)

    @property
    def is_sample_in(self) -> bool:
        """Whether the sample is in the beam."""
        self._connection.check()
        return self._bench.condition.is_sample_in

    def set_sample_in(self, sample_in: bool) -> None:
        """Move the sample into or out of the beam."""
        self._connection.check()
        self._bench.change(is_sample_in=sample_in)

    def close(self) -> None:
        """Let go; closing twice is allowed."""
        self._connection.is_closed = True
