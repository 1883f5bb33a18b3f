"""Run the command line in the process of the tests."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from app.cli import main


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    """Run the command with these arguments and return its exit status."""
    monkeypatch.setattr(sys, "argv", ["svwfs", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        main()
    return int(leaving.value.code or 0)
