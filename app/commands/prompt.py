"""Requests on the terminal for what only a person at the bench can do."""

import sys

from app.errors import InputError

LIGHT_BY_HAND = "the light is manual: make sure that it is off"


def remind(sentence: str) -> None:
    """Print what a person must not forget."""
    sys.stderr.write(f"{sentence}\n")


def ask(request: str) -> None:
    """Print a request and wait for Enter; `InputError` if no terminal is attached."""
    if not sys.stdin.isatty():
        raise InputError(f"this bench has no motors: run the command in a terminal, to be asked to {request}")
    sys.stderr.write(f"{request}, then press Enter\n")
    if not sys.stdin.readline():
        raise InputError(f"the terminal was closed before this was done: {request}")
