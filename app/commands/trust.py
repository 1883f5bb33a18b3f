"""Confirmation on the terminal of program libraries that a bench names."""

import sys

from app.bench.config import Bench
from app.bench.trusted_libraries import unconfirmed
from app.errors import InputError


def confirm_libraries(bench: Bench, *, trust: bool) -> None:
    """Ask once for each library that a bench names whether it may be loaded; with `trust`, remember it without asking.

    A changed library is asked for again. `InputError` if it is refused, or no terminal is attached.
    """
    for library in unconfirmed(bench):
        setting = f"{library.key} = {library.named}"
        if not trust:
            if not sys.stdin.isatty():
                raise InputError(
                    f"{setting} would run code: add --trust-library once if you trust it, or start the command in a"
                    " terminal to be asked"
                )
            sys.stderr.write(f"the bench runs code: {setting}\nType yes if you trust it: ")
            if sys.stdin.readline().strip().lower() != "yes":
                raise InputError(f"{setting} is not trusted: change the bench")
        library.trust()
