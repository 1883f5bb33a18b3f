"""What `svwfs devices` says on the terminal."""

from __future__ import annotations

import sys
from collections.abc import Mapping

import tomli_w
from rich.console import Console

from app.bench.config import Bench, CameraSettings, LightSettings
from app.commands.device_check import Verdict, check_device, settings_of
from app.commands.device_search import SEARCHES, Outcome, look
from app.commands.prompt import ask
from app.errors import InputError, RunError
from drivers.device import Property
from drivers.discovery import DiscoveredDevice


def print_devices() -> None:
    """Look for everything that is supported, and say what was found and what is missing."""
    console = Console(soft_wrap=True, highlight=False)
    for search in SEARCHES:
        _print_outcome(console, look(search))


def check_and_print(name: str, bench: Bench | None = None) -> None:
    """Run the contract on the device of that name, and print a report; `RunError` where it does not keep it.

    With a bench, the name is "camera" or "light", and the device is opened as the bench says.
    """
    settings = settings_of(_found(name)) if bench is None else _named(bench, name)
    console = Console(soft_wrap=True, highlight=False)
    verdicts: list[Verdict] = []
    for verdict in check_device(settings, _warn, lambda *told: _print_device(console, *told)):
        verdicts.append(verdict)
        console.print(f"  {'FAILED' if verdict.problem else 'ok':7}{verdict.sentence}", markup=False)
        if verdict.problem:
            console.print(f"         {verdict.problem}", markup=False)
    failed = sum(bool(verdict.problem) for verdict in verdicts)
    if failed:
        raise RunError(f"{name} fails {failed} of {len(verdicts)} checks")
    console.print(f"{name} passes all {len(verdicts)} checks", markup=False)


def _print_outcome(console: Console, outcome: Outcome) -> None:
    console.print(f"[bold]{outcome.search.what}[/bold]")
    if outcome.missing:
        console.print(f"  not looked for: {outcome.missing}", markup=False)
    elif not outcome.found:
        console.print("  none found")
    for found in outcome.found:
        doubt = "" if found.is_certain else "perhaps a "
        console.print(f"  {found.name}   {doubt}{found.description}", markup=False)
        if found.missing:
            console.print(f"    cannot be used yet: {found.missing}", markup=False)
        section = tomli_w.dumps({found.kind: {"driver": found.driver, **found.settings}})
        for line in section.splitlines():
            console.print(f"      {line}", markup=False)


def _print_device(console: Console, name: str, properties: Mapping[str, Property]) -> None:
    console.print(name, style="bold", markup=False)
    for key, value in properties.items():
        console.print(f"  {key} = {value}", markup=False)


def _warn(sentence: str) -> None:
    """Tell it before the light shines, and wait for a person where there is one."""
    if sys.stdin.isatty():
        ask(f"{sentence}: see that nobody looks into it")
    else:
        sys.stderr.write(f"{sentence}\n")


def _named(bench: Bench, name: str) -> CameraSettings | LightSettings:
    if name == "camera":
        return bench.camera
    if name == "light":
        return bench.light
    raise InputError(f"{name}: with --bench, --check takes camera or light")


def _found(name: str) -> DiscoveredDevice:
    """Look for the device of that name."""
    outcomes = [look(search) for search in SEARCHES if search.driver == name.split(":", 1)[0]]
    if not outcomes:
        known = ", ".join(search.driver for search in SEARCHES)
        raise InputError(f"{name}: not a device's name as `svwfs devices` shows it; it begins with one of {known}")
    for outcome in outcomes:
        for found in outcome.found:
            if found.name == name:
                return found
    missing = "; ".join(outcome.missing for outcome in outcomes if outcome.missing)
    raise RunError(f"{name} is not connected" + (f": {missing}" if missing else "; `svwfs devices` shows what is"))
