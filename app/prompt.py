"""What only a person at the bench can do, asked for on the terminal."""

from __future__ import annotations

import sys

from app.errors import InputError


def ask(request: str) -> None:
    """Have it done, and wait for Enter; an `InputError` where nobody can answer."""
    if not sys.stdin.isatty():
        raise InputError(f"nobody is there to {request}: this bench is worked by hand, so run it in a terminal")
    sys.stderr.write(f"{request}, then press Enter\n")
    if not sys.stdin.readline():
        raise InputError(f"nobody said that it was done: {request}")
