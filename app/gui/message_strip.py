"""One line that says what is the matter, the gravest first, what is to be decided, and how far a routine has come."""

from __future__ import annotations

import time

from PyQt6.QtCore import pyqtSignal
from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QFrame, QHBoxLayout, QProgressBar, QPushButton, QWidget

from app.acquisition.worker import Activity
from app.gui import theme
from app.gui.widgets import ElidedLabel, button

_NOTICE_S = 8.0  # how long the answer to something the user did is shown


class MessageStrip(QFrame):
    """Shows a failure for good, a notice for a while, and the state of the measurement otherwise."""

    reconnect_requested = pyqtSignal()
    cancel_requested = pyqtSignal()
    answered = pyqtSignal(bool)  # what was asked: whether it is to be

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setProperty("role", "strip")
        self._notice, self._notice_colour, self._notice_until_s = "", theme.AMBER, 0.0
        self._alarm = self._question = ""
        self._shown: tuple[str, str] = ("", "")
        self.text = ElidedLabel()
        self.reconnect = QPushButton("Reconnect")
        self.reconnect.setToolTip("Open the devices again and begin anew: dark, reference, live wavefronts (Ctrl+R)")
        self.reconnect.clicked.connect(self.reconnect_requested)
        self.accept = button("Use it", "What is proposed shall be so (Return)")
        self.accept.clicked.connect(lambda: self._answer(is_wanted=True))
        self.discard = button("Discard", "Leave everything as it is (Esc)")
        self.discard.clicked.connect(lambda: self._answer(is_wanted=False))
        self.dismiss = button("Dismiss", "The message has been read (Esc)")
        self.dismiss.clicked.connect(lambda: self.alarm(""))
        self.cancel = button("Cancel", "End what is under way; the bench is left as it was (Esc)")
        self.cancel.clicked.connect(self.cancel_requested)
        self.progress = QProgressBar()
        self.progress.setFixedWidth(200)
        self.progress.setFormat("%p %")
        layout = QHBoxLayout(self)
        layout.setContentsMargins(10, 3, 6, 3)
        layout.addWidget(self.text, 1)
        for widget in (self.reconnect, self.accept, self.discard, self.dismiss, self.progress, self.cancel):
            widget.hide()
            layout.addWidget(widget)
        self.setFixedHeight(self.cancel.sizeHint().height() + 8)  # whether or not there is a button

    def warn(self, text: str) -> None:
        """Show for a while why something was not done."""
        self._notify(text, theme.AMBER)

    def tell(self, text: str) -> None:
        """Show for a while what was done."""
        self._notify(text, theme.GREEN)

    def forget_notice(self) -> None:
        """Show nothing any more of what was done before: something else has been asked for."""
        self._notice_until_s = 0.0

    def alarm(self, text: str) -> None:
        """Show what went wrong until it is dismissed; empty text dismisses it."""
        self._alarm = text

    def ask(self, question: str) -> None:
        """Have the user decide; `answered` tells how."""
        self._question = question

    def escape(self) -> None:
        """Do what the key Esc means now: dismiss, discard or cancel."""
        if self._alarm:
            self.alarm("")
        elif self._question:
            self._answer(is_wanted=False)
        else:
            self.cancel_requested.emit()

    def enter(self) -> None:
        """Do what the key Return means now; a question that an alarm hides waits until it can be read."""
        if self._question and not self._alarm:
            self._answer(is_wanted=True)

    def show_activity(self, activity: Activity, *, may_cancel: bool) -> None:
        """Show what the worker is busy with, if with anything."""
        self.cancel.setVisible(may_cancel)
        self.progress.setVisible(bool(activity.text))
        if activity.text:
            self.progress.setRange(0, 1000 if activity.progress else 0)  # 0 ... 0 is Qt's "busy, who knows how long"
            self.progress.setValue(round(activity.progress * 1000))
            self.progress.setToolTip(f"{activity.text}: Esc cancels")

    def show_state(self, *, failure: str, warning: str, advice: str) -> None:
        """Show the gravest of a failure, an alarm, a question, a young notice, a warning, an advice."""
        self.reconnect.setVisible(bool(failure))
        if failure:
            self._question = ""  # there is nobody left to do it
        asks = bool(self._question) and not self._alarm
        for widget, is_shown in (
            (self.accept, asks),
            (self.discard, asks),
            (self.dismiss, bool(self._alarm) and not failure),
        ):
            widget.setVisible(is_shown)
        if failure:
            self._show(f"{failure}  \N{EM DASH}  the light and the devices were shut down", theme.RED)
        elif self._alarm:
            self._show(self._alarm, theme.RED)
        elif self._question:
            self._show(self._question, theme.GREEN)
        elif self._notice and time.monotonic() < self._notice_until_s:
            self._show(self._notice, self._notice_colour)
        elif warning:
            self._show(warning, theme.AMBER)
        else:
            self._show(advice, theme.DIM)

    def _answer(self, *, is_wanted: bool) -> None:
        self._question = ""
        self.answered.emit(is_wanted)

    def _notify(self, text: str, colour: QColor) -> None:
        self._notice, self._notice_colour, self._notice_until_s = text, colour, time.monotonic() + _NOTICE_S

    def _show(self, text: str, colour: QColor) -> None:
        sentence = text[:1].upper() + text[1:]
        if (sentence, colour.name()) != self._shown:
            self._shown = (sentence, colour.name())
            self.text.setText(sentence)
            self.text.setToolTip(sentence)
            self.text.setStyleSheet(f"color: {colour.name()};")
