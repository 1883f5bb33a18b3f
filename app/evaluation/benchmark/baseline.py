"""Committed speed ratios, and their regression check.

`baseline.json` holds the peers' times over ours, side by side, which hardly depend on the computer. After a lasting
improvement copy "ratios" from the file of `svwfs benchmark --json`.
"""

import json
from collections.abc import Mapping
from pathlib import Path

_BASELINE = Path(__file__).with_name("baseline.json")
_TOLERANCE = 0.2


def load_baseline() -> dict[str, float]:
    """Return the committed ratios."""
    ratios: dict[str, float] = json.loads(_BASELINE.read_text("utf-8"))["ratios"]
    return ratios


def worsened(ratios: Mapping[str, float], baseline: Mapping[str, float]) -> list[str]:
    """Return a sentence for each ratio that is missing or worse by more than 20 %."""
    problems = []
    for name, before in baseline.items():
        now = ratios.get(name)
        if now is None:
            problems.append(f"{name}: was {before:.3g}, could not be measured now")
        elif now < (1 - _TOLERANCE) * before:
            problems.append(f"{name}: {now:.3g} times faster, was {before:.3g}")
    return problems
