"""Run the command line in the process of the tests."""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import pytest
import typer.main

from app.cli import main

_commands = cache(typer.main.get_command)  # a process makes them once; so do all runs together


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    """Run the command with these arguments and return its exit status."""
    monkeypatch.setattr(typer.main, "get_command", _commands)
    monkeypatch.setenv("PYTHONSAFEPATH", "")  # the command sets it, which the tests undo
    monkeypatch.setattr(sys, "argv", ["svwfs", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        main()
    return int(leaving.value.code or 0)
