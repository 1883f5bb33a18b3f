"""What moves the sample and the mask."""

from __future__ import annotations

from abc import abstractmethod

from drivers.device import Device, Property
from drivers.errors import BadValue


class Stage(Device):
    """What moves the sample in and out of the beam and changes the mask in front of the light."""

    def __init__(self) -> None:
        super().__init__("stage")

    def properties(self) -> dict[str, Property]:
        """How it stands."""
        return {"name": self.name, "mask": self.mask, "is_sample_in": self.is_sample_in}

    @property
    def masks(self) -> tuple[str, ...]:
        """The masks that can be put in, for example ("square", "stars")."""
        with self._talking():
            return self._read_masks()

    @property
    def mask(self) -> str:
        """The mask that is in."""
        with self._talking():
            return self._read_mask()

    def set_mask(self, mask: str) -> None:
        """Put another mask in."""
        masks = self.masks
        if mask not in masks:
            raise BadValue(f"there is no mask {mask!r}; there are {', '.join(masks)}")
        with self._talking():
            self._set_mask(mask)

    @property
    def is_sample_in(self) -> bool:
        """Whether the sample is in the beam."""
        with self._talking():
            return self._is_sample_in()

    def set_sample_in(self, sample_in: bool) -> None:
        """Move the sample into or out of the beam."""
        with self._talking():
            self._set_sample_in(sample_in=sample_in)

    def note_sample(self, sample_in: bool) -> None:
        """Take note that the sample is to be, or by hand was, moved; where there is a motor, it moves it."""
        self.set_sample_in(sample_in)

    @abstractmethod
    def _read_masks(self) -> tuple[str, ...]: ...

    @abstractmethod
    def _read_mask(self) -> str: ...

    @abstractmethod
    def _set_mask(self, mask: str) -> None: ...

    @abstractmethod
    def _is_sample_in(self) -> bool: ...

    @abstractmethod
    def _set_sample_in(self, *, sample_in: bool) -> None: ...


class OneMaskStage(Stage):
    """A stage with one mask, which stays in."""

    def __init__(self, mask: str) -> None:
        super().__init__()
        self._mask = mask

    def _read_masks(self) -> tuple[str, ...]:
        return (self._mask,)

    def _read_mask(self) -> str:
        return self._mask

    def _set_mask(self, mask: str) -> None:
        """There is no other."""
