"""What several test files share."""

from __future__ import annotations

import pytest
from optics import SmallBench


@pytest.fixture(scope="session")
def small_bench() -> SmallBench:
    """A 7 x 9 lattice, off centre and turned, on a non-square camera."""
    return SmallBench()
