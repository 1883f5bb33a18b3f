"""Base of the storms: random sequences of commands and faults on a device.

The tests run a few fixed sequences per device; with SVWFS_SEQUENCES set, as in `make storms`, that many random ones.
"""

from __future__ import annotations

import os
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine

FEW = 30

MANY = int(os.environ.get("SVWFS_SEQUENCES", "0"))


def storm_settings(few: int = FEW, *, steps: int = 20) -> settings:
    """Settings for `few` sequences of at most `steps` steps, or for SVWFS_SEQUENCES."""
    return settings(
        max_examples=MANY or few,
        derandomize=not MANY,
        stateful_step_count=steps,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )


class Storm(RuleBasedStateMachine):
    """Base class; a subclass supplies the device and its faults."""

    device: Any = None

    def make(self) -> Any:
        """Return a stand-in device."""
        raise NotImplementedError

    def faults(self) -> st.SearchStrategy[Any]:
        """Strategy for the faults of the device."""
        raise NotImplementedError

    def happen(self, fault: Any) -> None:
        """Apply a fault."""
        raise NotImplementedError

    def recover(self) -> None:
        """Plug in again and clear all faults."""
        raise NotImplementedError
