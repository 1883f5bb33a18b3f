"""The source code: exceptions from checks of style or types say why, and private modules belong to their room."""

from __future__ import annotations

import ast
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


@pytest.mark.parametrize("package", ["app", "drivers", "reconstruction", "simulated_devices"])
def test_modules_with_an_underscore_are_imported_in_their_room_only(package: str) -> None:
    found, elsewhere = 0, list[str]()
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom):
                module = f"{node.module}."
                names = [module, *(f"{module}{each.name}." for each in node.names)]
                rooms = {name[: name.index("._")] for name in names if "._" in name and "__" not in name}
                found += len(rooms)
                here = ".".join(path.relative_to(ROOT).parent.parts)
                elsewhere += [f"{path}: {module}" for room in rooms if room != here]
    assert found or package == "app", "no private module is recognised"
    assert not elsewhere
