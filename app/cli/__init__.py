"""The command line `svwfs`: arguments in, exit status out."""

import errno
import os
import sys
from contextlib import suppress
from typing import NoReturn

from app.errors import InputError, Interrupted, RunError, ended_by
from drivers.errors import DeviceError


def main() -> None:
    """Run the command line; exit with 2 for unusable input, 1 for a failure, 130 for Ctrl-C."""
    os.environ["PYTHONSAFEPATH"] = "1"  # no child process imports modules from the working folder
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded: they wait busily for one another
    with ended_by(_interrupt):  # typer would exit silently on a KeyboardInterrupt
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):  # names of files need not be text
                stream.reconfigure(errors="backslashreplace")
        try:
            _run()
        except InputError as error:
            _exit(error, 2)
        except Interrupted as error:
            _exit(error, 130)
        except MemoryError as error:
            _exit(RunError(f"there is not enough memory: {error or 'use fewer lenslets, views or pixels'}"), 1)
        except (RunError, DeviceError) as error:
            _exit(error, 1)
        except OSError as error:
            if isinstance(error.filename, str):  # its name cannot be used
                _exit(InputError(f"{error.filename}: cannot be used: {error.strerror or error}"), 2)
            # Its reader has seen enough; Windows says EINVAL.
            if isinstance(error, BrokenPipeError) or (sys.platform == "win32" and error.errno == errno.EINVAL):
                _drop_output()
                raise SystemExit(1) from error
            _exit(RunError(f"the output cannot be printed: {error.strerror or error}"), 1)


def _interrupt(_number: int, _frame: object) -> None:
    raise Interrupted("interrupted")


def _run() -> None:
    from app.cli.application import cli  # takes a while, in which Ctrl-C may come

    try:
        cli()
    except SystemExit:
        if sys.stdout is not None:
            sys.stdout.flush()  # a full disk or a closed pipe may only show now
        raise


def _drop_output() -> None:
    """Drop text that cannot be printed: Python would try again at its end, and tell in its own words."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _exit(error: BaseException, status: int) -> NoReturn:
    from app.commands.terminal import hint, printable

    with suppress(OSError):  # a full disk: the exit status remains
        if sys.stderr is not None:
            sys.stderr.write(f"svwfs: {printable(str(error))}{hint(str(error), sys.stderr)}\n")
    _drop_output()
    raise SystemExit(status) from error
