"""Calibration: single routines, and a guide that takes all steps in order and explains them."""

from collections.abc import Callable
from functools import partial

from PyQt6.QtCore import Qt
from PyQt6.QtWidgets import QDialog, QGridLayout, QWidget

from app.acquisition.start_up import EXPOSURE, LATTICE, STEPS, CalibrationStep, by_hand, has_moved
from app.gui.panels.camera import CameraPanel
from app.gui.shell.controller import Controller, SettingsControl
from app.gui.shell.status_text import exposure_found, lattice_found
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button
from app.gui.widgets.layouts import Scrolled, fill_dialog, row, within_screen
from app.gui.widgets.texts import label
from app.measurement.auto_exposure import AutoExposure
from app.measurement.averages import BackgroundCheck
from app.measurement.routines import Cancelled
from reconstruction.lattice.search import Survey

_LAMP_PX = 16


class CalibrationGuide(QDialog):
    """Takes the steps, shows their states, and asks a person where it must; takes single steps on their own."""

    def __init__(self, controller: Controller, settings: SettingsControl, camera: CameraPanel, parent: QWidget) -> None:
        super().__init__(parent)
        self.setWindowTitle("Calibration")
        self._controller, self._settings, self._camera = controller, settings, camera
        self._messages = controller.messages
        controller.question_closed.connect(lambda: camera.propose(None))
        self._frames = 0
        self._left: list[CalibrationStep] = []
        self._is_running = False
        self._answers: dict[bool, Callable[[], object]] = {}  # called after "yes" and after "no"
        self.lamps = {step: label("") for step in STEPS}
        self.results = {step: label("", "dim", is_wrapped=True) for step in STEPS}
        steps = QWidget()
        grid = QGridLayout(steps)
        grid.setContentsMargins(0, 0, 0, 0)
        grid.setHorizontalSpacing(10)
        grid.setVerticalSpacing(2)
        grid.setColumnMinimumWidth(1, 660)  # px
        for index, step in enumerate(STEPS):
            result = self.results[step]
            result.setTextFormat(Qt.TextFormat.PlainText)
            result.setAlignment(Qt.AlignmentFlag.AlignTop)
            result.setMinimumHeight(2 * result.fontMetrics().lineSpacing() + 8)  # the lattice takes two lines
            grid.addWidget(self.lamps[step], 3 * index, 0)
            grid.addWidget(label(f"{index + 1}  {step.title}", "title"), 3 * index, 1)
            grid.addWidget(label(f"{step.explanation}.", "dim", is_wrapped=True), 3 * index + 1, 1)
            grid.addWidget(result, 3 * index + 2, 1)
        self.question = label("", is_wrapped=True)
        self.yes = Button("Yes", "Return", lambda _: self._answers[True]())
        self.no = Button("No", "Esc", lambda _: self._answers[False]())
        answers = row((self.question, 1), self.yes, self.no)
        self.steps = Scrolled(steps)
        fill_dialog(self, (self.steps, 1), answers)
        controller.connected.connect(self._restart)

    def expose(self) -> None:
        self._controller.send(lambda to: to.auto_expose(), lambda found: self._messages.inform(exposure_found(found)))

    def find_lattice(self) -> None:
        """Find the lenslets in the reference, and ask whether to use that lattice."""

        def propose(survey: Survey) -> None:
            self._camera.propose(survey)
            self._messages.ask(lattice_found(survey), partial(self.use_lattice, survey))

        self._controller.send(lambda to: to.survey_lattice(), propose)

    def check_background(self) -> None:

        def show(check: BackgroundCheck) -> None:
            (self._messages.inform if check.is_good else self._messages.warn)(check.verdict)

        self._controller.send(lambda to: to.check_background(), show)

    def ask_undo(self) -> None:
        """Ask whether to take the last dark, reference or change of the bench back."""

        def ask(found: tuple[str, str]) -> None:
            by, how = found
            question = f"restore what was in force before {by}{how and f' ({how})'}?"
            self._messages.ask(question, lambda: self._controller.send(lambda to: to.undo(), done), "Restore", "Cancel")

        def done(by: str) -> None:
            self._messages.inform(f"restored the state before {by}; press Ctrl+Z to return")

        self._controller.send(lambda to: to.undoable(), ask)

    def use_lattice(self, found: Survey) -> None:
        inform = partial(self._messages.inform, "the lattice is in use; Ctrl+S saves it")
        self._settings.change(("sensor", found.sensor), ("lattice", found.lattice), then=lambda _: inform())

    def begin(self, frames: int) -> None:
        """Take all steps, averaging `frames` frames into dark and reference; only show steps under way."""
        self.show()
        self.activateWindow()
        if self._is_running:
            return
        self._frames, self._left, self._is_running = frames, list(STEPS), True
        for step in STEPS:
            self._mark(step, "waiting", "")
        self.steps.updateGeometry()  # with lamps, and the fonts of the style sheet
        self.resize(within_screen(self, self.sizeHint()))
        status = self._controller.status
        if status is not None and status.bench.has_manual_stage and not status.is_sample_in:  # as noted
            self._ask("Make sure that the sample is out of the beam", "It is out", self._next)
        else:
            self._next()

    def end_for_light(self) -> bool:
        """End the sequence because the light is switched off; return whether it was running."""
        was_running = self._is_running
        if was_running:
            self._end("ended: the light was switched off")
        return was_running

    def _restart(self) -> None:
        """End the sequence of an acquisition that has gone, whose commands are not answered."""
        if self._is_running:
            self._end("ended: the devices were connected again")

    def reject(self) -> None:
        if self._is_running:
            self._controller.cancel()
            self._end("cancelled")
        else:
            super().reject()

    def _next(self) -> None:
        if not self._is_running:
            return
        status = self._controller.status
        if status is None:
            self._end("no bench is connected")
            return
        if not self._left:
            self._end("Calibrated." + " Put the sample into the beam (S)." * status.bench.has_manual_stage)
            return
        step = self._left[0]
        if (request := by_hand(step, status)) is not None:
            text, note = request
            self._ask(text, "Done", lambda: self._controller.send(note, lambda _: self._next(), self._fail))
            return
        self._mark(step, "running", "running\N{HORIZONTAL ELLIPSIS}")
        self._ask("", no="Cancel", refuse=self.reject)
        self._controller.send(lambda to: step.begin(to, self._frames), self._finish, self._fail)

    def _finish(self, result: object) -> None:
        if not self._is_running:
            return
        step, status, text = self._left.pop(0), self._controller.status, "taken"
        if isinstance(result, AutoExposure):
            text = exposure_found(result)
        elif isinstance(result, Survey):
            text = lattice_found(result)
            if status is not None and has_moved(result.lattice, status):
                self._mark(step, "failed", text)

                def use() -> None:
                    self._mark(step, "done", text)
                    self.use_lattice(result)
                    self._next()

                question = "The bench has another lattice."
                self._ask(question, "Use this one", use, "Use the bench's", self._next)
                return
        self._mark(step, "done", text)
        self._next()

    def _fail(self, error: Exception) -> None:
        if not self._is_running:
            return
        step = self._left[0]
        if isinstance(error, Cancelled):
            self._end("cancelled")
        elif step is LATTICE and EXPOSURE in self._left:  # perhaps too dark or too bright
            self._mark(step, "waiting", f"{error}; tried again after the exposure")
            self._left[:2] = [EXPOSURE, LATTICE]
            self._next()
        else:
            self._mark(step, "failed", str(error))
            self._ask(f"{step.title} failed.", "Try again", self._next)

    def _end(self, text: str) -> None:
        if self._left:
            self._mark(self._left[0], "failed", self.results[self._left[0]].text() if text == "stopped" else text)
        self._left, self._is_running = [], False
        self._ask(text, no="Close", refuse=self.close)

    def _ask(
        self,
        question: str,
        yes: str = "",
        accept: Callable[[], object] = lambda: None,
        no: str = "Stop",
        refuse: Callable[[], object] | None = None,
    ) -> None:
        """Ask a question; without a "yes" it only has the other button, which stops the calibration by default."""
        self._answers = {True: accept, False: refuse or partial(self._end, "stopped")}
        self.question.setText(question[:1].upper() + question[1:])
        self.yes.setText(yes)
        self.yes.setVisible(bool(yes))
        self.no.setText(no)
        if yes:
            self.yes.setFocus()

    def _mark(self, step: CalibrationStep, state: str, text: str) -> None:
        lamp = theme.lamp(theme.ACCENT)
        if state != "running":
            lamp = theme.validity_lamp({"waiting": "missing", "done": "good", "failed": "doubtful"}[state])
        self.lamps[step].setPixmap(lamp.pixmap(_LAMP_PX, _LAMP_PX))
        self.lamps[step].setToolTip(state)
        self.results[step].setText(text[:1].upper() + text[1:])
