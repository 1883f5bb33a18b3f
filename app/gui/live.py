"""`svwfs live`: the application around the window."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

from PyQt6.QtCore import QMessageLogContext, QTimer, QtMsgType, qInstallMessageHandler
from PyQt6.QtWidgets import QApplication

from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition, Measurement
from app.errors import Interrupted, RunError
from app.gui.main_window import MainWindow
from app.gui.theme import apply_theme
from app.signals import ended_by

_GIVE_UP_S = 120.0  # how long an unattended run waits for its first wavefront


def run_live(
    make_acquisition: Callable[[], Acquisition],
    *,
    offscreen_s: float | None = None,
    screenshot: Path | None = None,
    on_finish: Callable[[Measurement], None] | None = None,
    until: Callable[[], bool] | None = None,
    begin: Callable[[Acquisition], tuple[Future[None], ...]] = start_up,
) -> int:
    """Show the window until it is closed, and return the exit status; each acquisition has to `begin` first.

    With `offscreen_s` it closes by itself, so long after its first wavefront: a picture of it is saved to
    `screenshot`, and the last measurement that has a wavefront is given to `on_finish`. With `until`, which is asked
    ten times a second, it closes when that is true. `RunError` is raised when that does not come about: no wavefront
    comes, the devices fail, somebody closes the window before; `InputError` when the bench cannot be; and what `until`
    raises. Ctrl-C and its like close the window as its user would; then `Interrupted` is raised.
    """
    qInstallMessageHandler(_pass_on)
    application = QApplication.instance()
    if not isinstance(application, QApplication):
        application = QApplication(sys.argv[:1])
    application.setApplicationName("svwfs")
    apply_theme(application)
    window = MainWindow(make_acquisition, begin=begin)
    if offscreen_s is not None:
        until = _UnattendedRun(window, offscreen_s, screenshot, on_finish).look
    watch = None if until is None else _Watch(window, until)
    signals: list[int] = []

    def end(number: int, _frame: object) -> None:
        signals.append(number)
        QTimer.singleShot(0, window.close)  # in the event loop, even when that has not begun

    with ended_by(end):  # the window's timer lets Python notice
        try:
            window.show()
            window.connect_devices()
            status = application.exec()
        finally:
            window.close()
    if window.is_stuck:
        raise RunError("a device does not answer: the light may still be on, switch it off by hand")
    if window.failure:  # of the closing, too, when there is no window left to tell it
        raise window.error
    if signals:
        raise Interrupted("interrupted: the light is off")
    if watch is not None:
        watch.check()
    return status


def _pass_on(_kind: QtMsgType, _context: QMessageLogContext, text: str | None) -> None:
    """Let Qt speak on standard error, but not of what an unseen window cannot do and need not."""
    if text and "propagateSizeHints" not in text:
        sys.stderr.write(f"{text}\n")


class _Watch:
    """Closes a window when what it was opened for is done, or cannot be."""

    def __init__(self, window: MainWindow, is_done: Callable[[], bool]) -> None:
        self._window, self._is_done = window, is_done
        self._error: Exception | None = RunError("the window was closed before the run had finished")
        self._timer = QTimer(window)
        self._timer.setInterval(100)
        self._timer.timeout.connect(self._look)
        self._timer.start()

    def check(self) -> None:
        """Raise why the run did not finish, unless it did."""
        if self._error is not None:
            raise self._error

    def _look(self) -> None:
        try:
            if self._window.failure:
                raise self._window.error  # noqa: TRY301 - there is one way out
            if not self._is_done():
                return
            self._error = None
        except Exception as error:  # noqa: BLE001 - none may meet Qt, which would abort the program
            self._error = error
        self._timer.stop()
        self._window.close()


class _UnattendedRun:
    """A run that nobody watches."""

    def __init__(
        self,
        window: MainWindow,
        duration_s: float,
        screenshot: Path | None,
        on_finish: Callable[[Measurement], None] | None,
    ) -> None:
        self._window, self._duration_s = window, duration_s
        self._screenshot, self._on_finish = screenshot, on_finish
        self._deadline_s = time.monotonic() + _GIVE_UP_S
        self._last: Measurement | None = None
        window.measurement_shown.connect(self._note)

    def _note(self, measurement: Measurement) -> None:
        if measurement.wavefront is not None:
            if self._last is None:
                self._deadline_s = time.monotonic() + self._duration_s
            self._last = measurement

    def look(self) -> bool:
        """Say whether its time is over; then leave the picture and the last measurement, or raise why there is none."""
        if time.monotonic() < self._deadline_s:
            return False
        if self._last is None:
            raise RunError(f"no wavefront within {_GIVE_UP_S:g} s: {self._window.messages.text.text()}")
        self._window.update_text()
        if self._screenshot is not None and not self._window.save_screenshot(self._screenshot):
            raise RunError(f"{self._screenshot}: cannot be written")
        if self._on_finish is not None:
            self._on_finish(self._last)
        return True
