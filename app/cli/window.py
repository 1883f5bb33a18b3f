"""The command `svwfs-window`: `svwfs live` without a terminal, as a desktop starts it."""

import io
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout
from typing import TextIO

from app.cli import main
from app.commands.display import use_display
from app.errors import SHOWN, Interrupted


class _Copied(io.StringIO):
    """Keeps a text and passes it on to a stream, if there is one."""

    def __init__(self, stream: TextIO | None) -> None:
        super().__init__()
        self._stream = stream

    def write(self, text: str) -> int:
        if self._stream is not None:
            self._stream.write(text)
        return super().write(text)


def main_window() -> None:
    """Run `svwfs live` without a terminal: a dialog shows the error message."""
    sys.argv[1:1] = ["live"]
    status: str | int | None = 0
    cause: BaseException | None = None
    # Windows starts the program without any stream
    with redirect_stderr(_Copied(sys.stderr)) as errors, redirect_stdout(sys.stdout or _Copied(None)):
        try:
            main()
        except SystemExit as leaving:
            status, cause = leaving.code, leaving.__cause__
        except Exception as error:  # noqa: BLE001 - the traceback of a fault would be lost
            traceback.print_exc()
            status, cause = 1, error
    lines = errors.getvalue().strip().splitlines()
    is_told = isinstance(cause, Interrupted) or SHOWN in getattr(cause, "__notes__", ())
    if status and lines and not is_told and use_display():
        from app.gui.widgets.theme import show_ending

        show_ending(lines[-1].removeprefix("svwfs: "), "\n".join(lines[:-1]))
    raise SystemExit(status)
