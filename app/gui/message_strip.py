"""One line that says what is the matter, the gravest first, and how far a routine has come."""

from __future__ import annotations

import time

from PyQt6.QtCore import pyqtSignal
from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QFrame, QHBoxLayout, QProgressBar, QPushButton, QWidget

from app.acquisition import Activity
from app.gui import theme
from app.gui.widgets import ElidedLabel

_NOTICE_S = 8.0  # how long the answer to something the user did is shown


class MessageStrip(QFrame):
    """Shows a failure for good, a notice for a while, and the state of the measurement otherwise."""

    reconnect_requested = pyqtSignal()

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setProperty("role", "strip")
        self._notice, self._notice_colour, self._notice_until_s = "", theme.AMBER, 0.0
        self._shown: tuple[str, str] = ("", "")
        self.text = ElidedLabel()
        self.reconnect = QPushButton("Reconnect")
        self.reconnect.setToolTip("Open the devices again and begin anew: dark, reference, live wavefronts (Ctrl+R)")
        self.reconnect.clicked.connect(self.reconnect_requested)
        self.reconnect.hide()
        self.progress = QProgressBar()
        self.progress.setFixedWidth(200)
        self.progress.setFormat("%p %")
        self.progress.hide()
        layout = QHBoxLayout(self)
        layout.setContentsMargins(10, 3, 6, 3)
        layout.addWidget(self.text, 1)
        layout.addWidget(self.reconnect)
        layout.addWidget(self.progress)
        self.setFixedHeight(34)

    def warn(self, text: str) -> None:
        """Show for a while why something was not done."""
        self._notify(text, theme.AMBER)

    def tell(self, text: str) -> None:
        """Show for a while what was done."""
        self._notify(text, theme.GREEN)

    def show_activity(self, activity: Activity) -> None:
        """Show what the worker is busy with, if with anything."""
        self.progress.setVisible(bool(activity.text))
        if activity.text:
            self.progress.setRange(0, 1000 if activity.progress else 0)  # 0 ... 0 is Qt's "busy, who knows how long"
            self.progress.setValue(round(activity.progress * 1000))
            self.progress.setToolTip(f"{activity.text}: Esc cancels")

    def show_state(self, *, failure: str, problem: str, warning: str, advice: str) -> None:
        """Show the gravest of a failure, a notice not yet old, a frame's problem, a lasting warning, an advice."""
        self.reconnect.setVisible(bool(failure))
        if failure:
            self._show(f"{failure}  \N{EM DASH}  the light and the devices were shut down", theme.RED)
        elif self._notice and time.monotonic() < self._notice_until_s:
            self._show(self._notice, self._notice_colour)
        elif problem or warning:
            self._show(problem or warning, theme.AMBER)
        else:
            self._show(advice, theme.DIM)

    def _notify(self, text: str, colour: QColor) -> None:
        self._notice, self._notice_colour, self._notice_until_s = text, colour, time.monotonic() + _NOTICE_S

    def _show(self, text: str, colour: QColor) -> None:
        sentence = text[:1].upper() + text[1:]
        if (sentence, colour.name()) != self._shown:
            self._shown = (sentence, colour.name())
            self.text.setText(sentence)
            self.text.setToolTip(sentence)
            self.text.setStyleSheet(f"color: {colour.name()};")
