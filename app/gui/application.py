"""The Qt application: runs the window until its user, a signal or an unattended run closes it."""

import gc
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from PyQt6.QtCore import QMessageLogContext, QTimer, QtMsgType, qInstallMessageHandler

from app.acquisition.address import CLOSING_S, NAME
from app.acquisition.remote.connection import RunningInstrument
from app.acquisition.start_up import HeadlessRun
from app.acquisition.worker import Acquisition
from app.cache import loading, share_memory_of_threads
from app.errors import SHOWN, Interrupted, RunError, ended_by
from app.gui.shell.main_window import WINDOW_SIZE, MainWindow, MakeFor
from app.gui.shell.state import apply_preferences, saved_state
from app.gui.shell.status_text import left_behind
from app.gui.shortcut import take_identity
from app.gui.widgets.copies import write_picture
from app.gui.widgets.theme import styled_application
from app.gui.widgets.timers import timer
from app.measurement.measurement import Measurement
from app.timing import StageTimes, TimedStage
from reconstruction.runtime.opencv import cv2

_FIRST_WAVEFRONT_S = 120.0  # timeout of an unattended run


def run_window(
    open_first: Callable[[MainWindow], object],
    *,
    steps: Callable[[MainWindow], Iterator[object]] | None = None,
    make_for: MakeFor = Acquisition,
    name: str = NAME,
) -> int:
    """Run the window until it closes, and return the exit status.

    `open_first` opens a bench or a recording; `make_for` and `name` are those of `MainWindow`. `steps` run without a
    user: the first comes before `open_first`, the others at 10 Hz, and the window closes after the last; such a window
    always looks the same. `RunError` if the run did not finish, `InputError` if the bench is invalid and no other was
    opened, `Interrupted` if a signal such as Ctrl-C closed the window.
    """
    share_memory_of_threads()
    cv2.setNumThreads(1)  # one more costs a picture more than it saves
    take_identity()
    with loading():
        application = styled_application()
        qInstallMessageHandler(_pass_on)
        saved = saved_state() if steps is None else None
        if saved is not None:
            apply_preferences(application, saved)
        window = MainWindow(saved=saved, make_for=make_for, name=name)
    timer = None if steps is None else _StepTimer(window, steps(window))
    signals: list[int] = []

    def end(number: int, _frame: object) -> None:
        signals.append(number)
        QTimer.singleShot(0, window.close)  # works before the event loop starts, too

    with window.reported_errors(), ended_by(end):  # Python handles signals when the window's timer fires
        try:
            window.show()
            if saved is None:
                window.resize(WINDOW_SIZE)  # the screen of Qt's offscreen platform is small
            open_first(window)
            status = application.exec()
        finally:
            gc.unfreeze()
            window.close()
    for sentence in window.unsaved:
        sys.stderr.write(f"svwfs: {sentence}\n")
    _raise_failure(window, is_interrupted=bool(signals))
    if timer is not None and timer.error is not None:
        raise timer.error
    return 1 if window.unsaved else status


def _raise_failure(window: MainWindow, *, is_interrupted: bool) -> None:
    """Raise why the window ended, unless its user closed it and all is well."""
    if window.controller.is_stuck and window.controller.is_silent:
        raise RunError(f"{window.controller.notice}, and see whether the light is off")
    if window.controller.is_stuck:
        raise RunError(left_behind(window.controller.status, CLOSING_S))
    error = window.controller.error if window.controller.failure else None  # may have come while closing
    if error is None and window.controller.acquisition is None:
        error = window.benches.error
    if error is not None:
        error.add_note(SHOWN)
        raise error
    if is_interrupted:
        status_at_end = window.controller.status
        is_by_hand = status_at_end is not None and status_at_end.bench.has_manual_light
        light = "switch the light off by hand" if is_by_hand else "the light is off"
        raise Interrupted(f"interrupted: {window.controller.left or light}")


def _pass_on(_kind: QtMsgType, _context: QMessageLogContext, text: str | None) -> None:
    """Print Qt's messages, except one that the offscreen platform emits for every window."""
    if text and "propagateSizeHints" not in text:
        sys.stderr.write(f"{text}\n")


class _StepTimer:
    """Makes the steps of an unattended run, and closes the window when it is done or has failed."""

    def __init__(self, window: MainWindow, steps: Iterator[object]) -> None:
        self._window, self._steps = window, steps
        next(steps)
        self.error: Exception | None = RunError("the window was closed before the run had finished")  # None: finished
        self._timer = timer(window, 100, self._poll)
        self._timer.start()

    def _poll(self) -> None:
        if self._window.is_closing:  # which ends commands that wait
            return
        try:
            if self._window.controller.failure:
                raise self._window.controller.error  # noqa: TRY301 - one way out
            next(self._steps)
        except StopIteration:
            self.error = None
        except Exception as error:  # noqa: BLE001 - an error in a Qt slot would abort the program
            self.error = error
        else:
            return
        self._timer.stop()
        self._window.close()


def headless_steps(
    window: MainWindow,
    run: HeadlessRun,
    seconds: float,
    screenshot: Path | None = None,
    on_finish: Callable[[RunningInstrument, Measurement, dict[TimedStage, StageTimes]], object] = lambda *_: None,
) -> Iterator[None]:
    """Wait for a wavefront and then `seconds`; save a screenshot, and call `on_finish` with what was measured."""
    shown = list[Measurement]()

    def note(measurement: Measurement) -> None:
        if measurement.wavefront is not None:
            shown[:] = [measurement]

    window.measurement_shown.connect(note)
    end_s = seconds + (yield from run.first_wavefront(_FIRST_WAVEFRONT_S))

    def is_over() -> bool:
        now_s = time.perf_counter()
        if not shown and now_s > end_s + _FIRST_WAVEFRONT_S:
            raise RunError("the window has not drawn a wavefront")
        return bool(shown) and now_s >= end_s

    yield from run.until(is_over)
    window.update_text()
    if screenshot is not None:
        write_picture(screenshot, window.grab())
    on_finish(run.acquisition, shown[0], run.stage_times())
