"""Commands and faults in any order, on any device: what all storms have in common.

In the tests each device sees a few sequences, always the same. `make storms` runs SVWFS_SEQUENCES of them, each time
others; it is the variable that decides, here and nowhere else.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, ClassVar

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant

from drivers.errors import BadValue, Unsupported, WrongState

FEW = 30
REFUSALS = (BadValue, Unsupported, WrongState)

MANY = int(os.environ.get("SVWFS_SEQUENCES", "0"))  # 0 where nobody asked


def storm_settings(few: int = FEW, *, steps: int = 20) -> settings:
    """So many sequences of at most so many steps, or as many as were asked for."""
    return settings(
        max_examples=MANY or few,
        derandomize=not MANY,
        stateful_step_count=steps,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )


@dataclass(slots=True)
class Tally:
    """What has been run so far, in this process."""

    sequences: int = 0
    steps: int = 0


class Storm(RuleBasedStateMachine):
    """A subclass says what the device is, and what can happen to it."""

    tally: ClassVar = Tally()
    device: Any = None

    def make(self) -> Any:
        """Return a stand-in."""
        raise NotImplementedError

    def faults(self) -> st.SearchStrategy[Any]:
        """What can happen."""
        raise NotImplementedError

    def happen(self, fault: Any) -> None:
        """Let it happen."""
        raise NotImplementedError

    def recover(self) -> None:
        """Plug in again, take all faults away."""
        raise NotImplementedError

    @invariant()
    def count_step(self) -> None:
        self.tally.steps += 1

    def teardown(self) -> None:
        self.tally.sequences += 1
