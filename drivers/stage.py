"""What moves the sample and the mask."""

from __future__ import annotations

from abc import abstractmethod

from drivers.device import Device


class Stage(Device):
    """What moves the sample in and out of the beam and changes the mask in front of the light."""

    def __init__(self) -> None:
        super().__init__("stage")

    @property
    @abstractmethod
    def masks(self) -> tuple[str, ...]:
        """The masks that can be put in, for example ("square", "stars")."""

    @property
    @abstractmethod
    def mask(self) -> str:
        """The mask that is in."""

    @abstractmethod
    def set_mask(self, mask: str) -> None:
        """Put another mask in."""

    @property
    @abstractmethod
    def is_sample_in(self) -> bool:
        """Whether the sample is in the beam."""

    @abstractmethod
    def set_sample_in(self, sample_in: bool) -> None:
        """Move the sample into or out of the beam."""
