"""The source code of product and tests: every exception from a check of style or types says why."""

from __future__ import annotations

import re

import pytest
from support.paths import ROOT

_EXCEPTION = re.compile(r"# (?:noqa|type: ignore)\b.*")
_WITH_REASON = re.compile(r"# (?:noqa: [A-Z0-9, ]+ - |type: ignore\[[a-z, -]+\] # (?!noqa))\w")


@pytest.mark.parametrize("room", ["app", "drivers", "reconstruction", "simulated_devices", "tests"])
def test_every_exception_has_a_reason(room: str) -> None:
    found = {
        f"{path.relative_to(ROOT)}:{number}": exception[0]
        for path in sorted((ROOT / room).rglob("*.py"))
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if (exception := _EXCEPTION.search(line))
    }
    assert found, "no exception is recognised"
    assert not {place: text for place, text in found.items() if not _WITH_REASON.match(text)}
