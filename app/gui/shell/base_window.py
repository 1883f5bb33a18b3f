"""Base of the main window: focus, times of painting, dropped files, screenshots, and caught errors."""

import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from functools import partial
from pathlib import Path
from types import TracebackType

from PyQt6.QtCore import QEvent, QMimeData, QStandardPaths, Qt
from PyQt6.QtGui import QDropEvent
from PyQt6.QtWidgets import QMainWindow

from app.gui.shell.messages import MessageStrip
from app.gui.widgets.copies import write_picture
from app.gui.widgets.file_work import FileWork
from app.gui.widgets.timers import REFRESH_MS
from app.measurement.measurement import Measurement
from app.timing import Timings


class BaseWindow(QMainWindow):
    """Takes the focus when it becomes active, and from a widget that is hidden or disabled.

    So every key is a shortcut until a field is clicked; Qt would give it to the first button or field in the Tab order.
    """

    def __init__(self) -> None:
        super().__init__()
        self.unpainted: tuple[Measurement, Timings, float] | None = None  # with the seconds of drawing so far
        self.messages = MessageStrip()
        self.rests_until_s = 0.0  # after a slow redraw
        self.known_errors: set[str] = set()  # that were shown since the alarm was dismissed, or a bench was opened
        self.messages.dismissed.connect(self.known_errors.clear)
        self._screenshots = FileWork(self, self.messages.warn)
        self.setAcceptDrops(True)

    def open_file(self, path: Path) -> None:
        """Open a file or folder that was dropped on the window."""
        raise NotImplementedError

    def event(self, event: QEvent | None) -> bool:
        """Take the focus when active, open what is dropped, and time the painting at UpdateRequest."""
        if event is not None and event.type() == QEvent.Type.WindowActivate:
            self.setFocus()
        if isinstance(event, QDropEvent) and (paths := _paths(event.mimeData())):  # also its subclasses: enter, move
            event.setDropAction(Qt.DropAction.CopyAction)  # after a move, the source may delete its file
            event.accept()
            for path in paths if event.type() == QEvent.Type.Drop else ():
                self.open_file(path)
            return True
        if event is None or event.type() != QEvent.Type.UpdateRequest or self.unpainted is None:
            return super().event(event)
        (measurement, timings, seconds), self.unpainted = self.unpainted, None
        start_s = time.perf_counter()
        is_handled = super().event(event)  # paints the whole window
        end_s = time.perf_counter()
        took_s = seconds + end_s - start_s
        self.rests_until_s = end_s + took_s - REFRESH_MS / 1e3  # commands go on, and the instrument needs the processor
        timings.note("draw", took_s)
        timings.note("to_screen", end_s - measurement.exposure_end_s)
        return is_handled

    def save_screenshot(self) -> None:
        """Save a picture of the window in the user's picture folder."""
        folder = Path(QStandardPaths.writableLocation(QStandardPaths.StandardLocation.PicturesLocation) or ".")
        path = folder / f"svwfs-{datetime.now().astimezone():%Y%m%d-%H%M%S}.png"
        write = partial(write_picture, path, self.grab().toImage())
        self._screenshots.run(write, lambda _: self.messages.inform(f"saved {path}"), writes=str(path))

    @contextmanager
    def reported_errors(self) -> Iterator[None]:
        """Show errors of timers and slots, after which Qt would abort with the light on, and print each once."""
        before, known, alarm = sys.excepthook, self.known_errors, self.messages.alarm
        # Each thread that is made meanwhile keeps `report`, which must not keep the window.

        def report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
            if isinstance(error, Exception):
                at = traceback.extract_tb(trace)[-1]
                sentence = (
                    f"the display failed ({type(error).__name__}: {error}; {Path(at.filename).name}:{at.lineno}), so"
                    " that what you see may be old: open the bench again, and report this line of the log (Ctrl+L)"
                )
                if sentence in known:
                    return
                known.add(sentence)
                alarm(sentence)
            before(kind, error, trace)

        sys.excepthook = report
        try:
            yield
        finally:
            sys.excepthook = before

    def focusNextPrevChild(self, next: bool) -> bool:  # noqa: A002, N802 - Qt's names
        """Move the focus as Tab does, unless its widget has just been hidden or disabled."""
        focused = self.focusWidget()
        if focused is not None and not (focused.isVisible() and focused.isEnabled()):
            self.setFocus()
            return True
        return super().focusNextPrevChild(next)


def _paths(data: QMimeData | None) -> list[Path]:
    return [] if data is None else [Path(url.toLocalFile()) for url in data.urls() if url.isLocalFile()]
