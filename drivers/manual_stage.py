"""A stage without a motor: a person moves the sample and says so."""

from __future__ import annotations

from drivers.errors import WrongState
from drivers.stage import OneMaskStage


class ManualStage(OneMaskStage):
    """Knows where the sample is because it was told, and refuses what only a person can do."""

    def __init__(self, mask: str) -> None:
        """`mask` is the one that is in; the sample is out until somebody says otherwise."""
        super().__init__(mask)
        self._is_in = False

    @property
    def name(self) -> str:
        """What it is."""
        return "a person's hands"

    def note_sample(self, sample_in: bool) -> None:
        """Take note that a person has moved the sample."""
        with self._talking():
            self._is_in = sample_in

    def _is_sample_in(self) -> bool:
        return self._is_in

    def _set_sample_in(self, *, sample_in: bool) -> None:
        if sample_in != self._is_in:
            request = "put the sample into the beam" if sample_in else "take the sample out of the beam"
            raise WrongState(f"{request}, and then say so: nothing here can move it")

    def _close(self) -> None:
        """Let it stand."""
