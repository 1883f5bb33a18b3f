"""Stages: they move the sample in and out of the beam and change the mask in front of the light."""

from abc import abstractmethod

from drivers.device import Device, Property, switched
from drivers.errors import BadValue, WrongState


class Stage(Device):
    """A holder of the sample and of the masks; by default of one fixed mask."""

    def __init__(self, mask: str = "") -> None:
        super().__init__("stage")
        self._mask = mask

    def properties(self) -> dict[str, Property]:
        """Mask and sample position."""
        return {"name": self.name, "mask": self.mask, "is_sample_in": self.is_sample_in}

    @property
    def masks(self) -> tuple[str, ...]:
        """The available masks, for example ("square", "stars")."""
        with self._access():
            return self._read_masks()

    @property
    def mask(self) -> str:
        """The mask in use."""
        with self._access():
            return self._read_mask()

    def set_mask(self, mask: str) -> None:
        """Change the mask."""
        masks = self.masks
        if mask not in masks:
            raise BadValue(f"there is no mask {mask!r}; there are {', '.join(masks)}")
        with self._access():
            self._set_mask(mask)

    @property
    def is_sample_in(self) -> bool:
        """True if the sample is in the beam."""
        with self._access():
            return self._is_sample_in()

    def set_sample_in(self, is_in: bool) -> None:
        """Move the sample into or out of the beam."""
        with self._access():
            self._set_sample_in(is_in=switched(is_in))

    def note_sample(self, is_in: bool) -> None:
        """Move the sample, or without a motor record that a person has moved it."""
        self.set_sample_in(is_in)

    def _read_masks(self) -> tuple[str, ...]:
        return (self._mask,)

    def _read_mask(self) -> str:
        return self._mask

    def _set_mask(self, mask: str) -> None: ...

    def _close(self) -> None:
        """Nothing to do, unless there is a motor."""

    @abstractmethod
    def _is_sample_in(self) -> bool: ...

    @abstractmethod
    def _set_sample_in(self, *, is_in: bool) -> None: ...


class ManualStage(Stage):
    """A stage without a motor: a person moves the sample, at first out of the beam, and confirms it."""

    def __init__(self, mask: str) -> None:
        super().__init__(mask)
        self._name = "manual stage"
        self._is_in = False

    def note_sample(self, is_in: bool) -> None:
        """Record that a person has moved the sample."""
        with self._access():
            self._is_in = switched(is_in)

    def _is_sample_in(self) -> bool:
        return self._is_in

    def _set_sample_in(self, *, is_in: bool) -> None:
        if is_in != self._is_in:
            request = "put the sample into the beam" if is_in else "take the sample out of the beam"
            raise WrongState(f"the stage is manual: {request}, then confirm (S)")
