"""Guided calibration: takes one step after the other, says what each does, and asks a person where it must."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Protocol

from PyQt6.QtCore import Qt
from PyQt6.QtWidgets import QDialog, QGridLayout, QWidget

from app.acquisition.instrument import Instrument, Setting, Status
from app.acquisition.start_up import EXPOSURE, LATTICE, STEPS, CalibrationStep, by_hand, differs
from app.acquisition.worker import Acquisition
from app.gui import theme
from app.gui.widgets import button, column, label, row
from app.gui.wording import exposure_found, lattice_found
from app.measurement.auto_exposure import AutoExposure
from app.measurement.routines import Cancelled
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey

_WIDTH = 660  # px
_LAMP = 16  # px


class _Send(Protocol):
    def __call__(
        self,
        submit: Callable[[Acquisition], Future[Any]],
        then: Callable[[Any], object] | None = None,
        otherwise: Callable[[Exception], object] | None = None,
    ) -> None: ...


class CalibrationGuide(QDialog):
    """Lists the steps with their states; the measurement is seen beside it."""

    def __init__(
        self,
        send: _Send,
        status: Callable[[], Status | None],
        use_lattice: Callable[[Lattice], object],
        cancel: Callable[[], object],
        parent: QWidget | None,
    ) -> None:
        """`send` queues a command for the worker, `cancel` ends its routine."""
        super().__init__(parent)
        self.setWindowTitle("Calibration")
        self._send, self._status, self._use_lattice, self._cancel = send, status, use_lattice, cancel
        self._frames = 0
        self._left: list[CalibrationStep] = []
        self._is_running = False
        self._accept: Callable[[], object] = self._next
        self._refuse: Callable[[], object] = self.close
        self.lamps = {step: label("") for step in STEPS}
        self.results = {step: label("", "dim") for step in STEPS}
        grid = QGridLayout()
        grid.setHorizontalSpacing(10)
        grid.setVerticalSpacing(2)
        grid.setColumnMinimumWidth(1, _WIDTH)
        for index, step in enumerate(STEPS):
            explanation, result = label(step.explanation, "dim"), self.results[step]
            for text in (explanation, result):
                text.setWordWrap(True)
            result.setTextFormat(Qt.TextFormat.PlainText)
            result.setAlignment(Qt.AlignmentFlag.AlignTop)
            result.setMinimumHeight(2 * result.fontMetrics().lineSpacing() + 8)  # the lattice takes two lines
            grid.addWidget(self.lamps[step], 3 * index, 0)
            grid.addWidget(label(f"{index + 1}  {step.title}", "title"), 3 * index, 1)
            grid.addWidget(explanation, 3 * index + 1, 1)
            grid.addWidget(result, 3 * index + 2, 1)
        self.question = label("")
        self.question.setWordWrap(True)
        self.yes = button("", "Return", self._answer_yes)
        self.no = button("", "Esc", self._answer_no)
        column(grid, row((self.question, 1), self.yes, self.no), spacing=12, parent=self).setContentsMargins(
            14, 12, 14, 12
        )

    def begin(self, frames: int) -> None:
        """Take all steps, averaging `frames` frames into dark and reference; while they run, only show them."""
        self.show()
        self.activateWindow()
        if self._is_running:
            return
        self._frames, self._left, self._is_running = frames, list(STEPS), True
        for step in STEPS:
            self._mark(step, "waiting", "")
        status = self._status()
        if status is not None and status.bench.has_manual_stage and not status.is_sample_in:  # nobody may have said so
            self._ask("Make sure that the sample is out of the beam", "It is out", self._next, "Stop", self._stop)
        else:
            self._next()

    def end_for_light(self) -> bool:
        """End the sequence because the light is switched off; return whether it was running."""
        was_running = self._is_running
        if was_running:
            self._end("ended: the light was switched off")
        return was_running

    def reject(self) -> None:
        """Cancel the running step, or close."""
        if self._is_running:
            self._cancel()
            self._end("cancelled")
        else:
            super().reject()

    def _answer_yes(self) -> None:
        self._accept()

    def _answer_no(self) -> None:
        self._refuse()

    def _next(self) -> None:
        if not self._is_running:
            return
        status = self._status()
        if not self._left or status is None:
            sample = (
                " Put the sample into the beam (S)." if status is not None and status.bench.has_manual_stage else ""
            )
            self._end(f"Calibrated.{sample}" if not self._left else "no bench is connected")
            return
        step = self._left[0]
        if (request := by_hand(step, status)) is not None:
            text, setting, value = request
            self._ask(
                text,
                "Done",
                lambda: self._send(
                    lambda to: to.submit(Instrument.set, setting, value), lambda _: self._next(), self._fail
                ),
                "Stop",
                self._stop,
            )
            return
        self._mark(step, "running", "running \N{HORIZONTAL ELLIPSIS}")
        self._show_question("", "", "Cancel", self.reject)
        self._send(lambda to: step.begin(to, self._frames), self._finish, self._fail)

    def _note(self, setting: Setting, value: bool) -> None:
        """Note what a person has done, and go on."""
        self._send(lambda to: to.submit(Instrument.set, setting, value), lambda _: self._next(), self._fail)

    def _finish(self, result: object) -> None:
        if not self._is_running:
            return
        step, status = self._left.pop(0), self._status()
        text = "taken"
        if isinstance(result, Survey):
            text = lattice_found(result)
            if status is not None and differs(result.lattice, status):
                self._mark(step, "failed", text)
                self._ask(
                    "The bench has another lattice.",
                    "Use this one",
                    lambda: self._take_lattice(step, text, result.lattice),
                    "Keep that of the bench",
                    self._next,
                )
                return
        elif isinstance(result, AutoExposure):
            text = exposure_found(result)
        self._mark(step, "done", text)
        self._next()

    def _take_lattice(self, step: CalibrationStep, text: str, lattice: Lattice) -> None:
        self._mark(step, "done", text)
        self._use_lattice(lattice)
        self._next()

    def _fail(self, error: Exception) -> None:
        if not self._is_running:
            return
        step = self._left[0]
        if isinstance(error, Cancelled):
            self._end("cancelled")
            return
        if step is LATTICE and EXPOSURE in self._left:  # perhaps too dark or too bright
            self._mark(step, "waiting", f"{error}; tried again after the exposure")
            self._left[:2] = [EXPOSURE, LATTICE]
            self._next()
            return
        self._mark(step, "failed", str(error))
        self._ask(f"{step.title} failed.", "Try again", self._next, "Stop", self._stop)

    def _stop(self) -> None:
        self._end("stopped")

    def _end(self, text: str) -> None:
        if self._left:
            self._mark(self._left[0], "failed", self.results[self._left[0]].text() if text == "stopped" else text)
        self._left, self._is_running = [], False
        self._show_question(text, "", "Close", self.close)

    def _ask(
        self, question: str, yes: str, accept: Callable[[], object], no: str, refuse: Callable[[], object]
    ) -> None:
        self._accept = accept
        self._show_question(question, yes, no, refuse)
        self.yes.setFocus()

    def _show_question(self, question: str, yes: str, no: str, refuse: Callable[[], object]) -> None:
        self._refuse = refuse
        self.question.setText(question[:1].upper() + question[1:])
        self.yes.setText(yes)
        self.yes.setVisible(bool(yes))
        self.no.setText(no)

    def _mark(self, step: CalibrationStep, state: str, text: str) -> None:
        icon = {
            "waiting": theme.validity_lamp(theme.DIM, is_good=False, is_missing=True),
            "running": theme.lamp(theme.ACCENT),
            "done": theme.validity_lamp(theme.GREEN, is_good=True, is_missing=False),
            "failed": theme.validity_lamp(theme.AMBER, is_good=False, is_missing=False),
        }[state]
        self.lamps[step].setPixmap(icon.pixmap(_LAMP, _LAMP))
        self.lamps[step].setToolTip(state)
        self.results[step].setText(text[:1].upper() + text[1:])
