"""How a command ends: with which status, and one line on standard error.

Input that cannot be used ends with status 2, a failure while running with status 1, Ctrl-C with 130.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from app.errors import InputError, Interrupted, RunError
from app.signals import ended_by


def run_and_leave(command: Callable[[], object]) -> None:
    """Run it and leave with its exit status."""
    with ended_by(_interrupt):  # no KeyboardInterrupt, which the library of the command line would turn into silence
        try:
            command()
        except InputError as error:
            _leave(error, 2)
        except RunError as error:
            _leave(error, 1)
        except Interrupted as error:
            _leave(error, 130)
        except OSError as error:  # standard output is full or gone
            _leave(error, 1)


def _interrupt(_number: int, _frame: object) -> None:
    raise Interrupted("interrupted")


def _leave(error: BaseException, status: int) -> None:
    sys.stderr.write(f"svwfs: {error}\n")
    raise SystemExit(status) from error
