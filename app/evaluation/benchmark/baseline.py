"""The ratios that were once reached, and whether they still are.

`baseline.json` holds ratios alone, which hardly depend on the computer: the peer's time over ours, side by side.
Where they have become better for good, copy "ratios" from what `svwfs benchmark --json` wrote.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

_BASELINE = Path(__file__).with_name("baseline.json")
_WORSE = 0.2


def load_baseline() -> dict[str, float]:
    """The ratios that are committed."""
    ratios: dict[str, float] = json.loads(_BASELINE.read_text())["ratios"]
    return ratios


def worsened(ratios: Mapping[str, float], baseline: Mapping[str, float]) -> list[str]:
    """Say which ratios have become worse by more than 20 %, or are not there to be compared."""
    said = []
    for name, before in baseline.items():
        now = ratios.get(name)
        if now is None:
            said.append(f"{name}: was {before:.3g}, could not be measured now")
        elif now < (1 - _WORSE) * before:
            said.append(f"{name}: {now:.3g} times faster, was {before:.3g}")
    return said
