"""Messages: the strip that shows the most important one, and the log of all."""

import re
import time
from collections import deque
from collections.abc import Callable
from datetime import datetime

from PyQt6.QtCore import pyqtSignal
from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QFrame, QProgressBar

from app.acquisition.instrument import Activity
from app.documentation import entry_of
from app.gui.shell.status_text import as_sentence
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button
from app.gui.widgets.layouts import fill_strip
from app.gui.widgets.texts import ElidedLabel, colour_text

_NUMBER = re.compile(r"[\d.,]*\d")
_NOTICE_S = 8.0  # how long a notice is shown


class MessageStrip(QFrame):
    """Shows one message by priority: failure, alarm, refused entry, question, notice, warning, advice."""

    reconnect_requested = pyqtSignal()
    control_requested = pyqtSignal()
    cancel_requested = pyqtSignal()
    logged = pyqtSignal()
    dismissed = pyqtSignal()  # the alarm was removed
    answered = pyqtSignal(bool)  # whether the proposal is accepted

    def __init__(self) -> None:
        super().__init__()
        self.setProperty("role", "strip")
        self._notice, self._notice_colour, self._notice_until_s = "", theme.AMBER, 0.0
        self._alarm = self._question = ""
        self._act: Callable[[], object] = lambda: None  # after a "yes"
        self._is_destructive = False  # whether "yes" ends something
        self._lines: deque[tuple[str, str]] = deque(maxlen=1000)  # time and message
        self._standing: dict[str, str] = {}  # last failure and warning
        self._shown = ("", theme.DIM)
        self.text = ElidedLabel(lines=2)
        again = "Open the devices again, take dark and reference, and start measuring (Ctrl+R)"
        self.reconnect = Button("Reconnect", again, self.reconnect_requested)
        self.control = Button("Take control", "Command the instrument in place of others", self.control_requested)
        self.accept = Button("Use it", "", lambda: self._answer(is_accepted=True))
        self.discard = Button("Discard", "Change nothing (Esc)", lambda: self._answer(is_accepted=False))
        self.dismiss = Button("Dismiss", "Remove this message (Esc)", lambda: self.alarm(""))
        self.cancel = Button("Cancel", "Stop, and restore the devices (Esc)", self.cancel_requested)
        self.show_log = Button("Log…", "All messages with their times (Ctrl+L)")
        self.explain = Button("?", "Cause and remedy of this message")
        self.progress = QProgressBar()
        self.progress.setFixedWidth(200)
        self.progress.setTextVisible(False)
        buttons = self.reconnect, self.control, self.accept, self.discard, self.dismiss
        hidden = (*buttons, self.progress, self.cancel, self.explain)
        for widget in hidden:
            widget.hide()
        fill_strip(self, (self.text, 1), *hidden, self.show_log)
        self.setFixedHeight(max(self.cancel.sizeHint().height(), 2 * self.fontMetrics().height()) + 8)  # constant

    @property
    def log(self) -> str:
        """The last thousand messages with times, oldest first, without advice and refused entries."""
        return "\n".join(f"{time}  {message}" for time, message in self._lines)

    def warn(self, text: str) -> None:
        """Show an amber notice: something was not done."""
        self._notify(text, theme.AMBER)
        self._say(text)

    def refuse(self, text: str) -> None:
        """Show a red notice: an entry cannot be used; empty text removes it."""
        self._notify(text, theme.RED)

    def inform(self, text: str) -> None:
        """Show a green notice: something was done."""
        self._notify(text, theme.GREEN)
        self._say(text)

    def clear_notice(self) -> None:
        self._notice_until_s = 0.0

    def alarm(self, text: str) -> None:
        """Show an error until the user dismisses it; empty text removes it."""
        self._alarm = text
        if not text:
            self.dismissed.emit()
        self._say(text)

    def ask(
        self,
        question: str,
        act: Callable[[], object] = lambda: None,
        accept: str = "Use it",
        discard: str = "Discard",
        *,
        is_destructive: bool = False,
    ) -> None:
        """Show a question, and act after "yes"; if that `is_destructive`, it is amber, and Return does not accept."""
        self._question, self._act, self._is_destructive = question, act, is_destructive
        self._say(question)
        self.accept.setText(accept)
        key = "Ctrl+Return" if is_destructive else "Return"
        self.accept.setShortcut(key)
        self.accept.setToolTip(f"Accept ({key})")
        self.discard.setText(discard)

    def escape(self) -> None:
        """Dismiss the alarm, discard the proposal, or request to cancel."""
        if self._alarm:
            self.alarm("")
        elif self._asks:
            self._answer(is_accepted=False)
        elif self._question:
            self.clear_notice()  # of a refused entry: the question is seen again
        else:
            self.cancel_requested.emit()

    def show_activity(self, activity: Activity, *, may_cancel: bool) -> None:
        """Show the progress of the worker's activity, if any, and a button that cancels it."""
        self.cancel.setVisible(may_cancel and activity.may_cancel and bool(activity.text))
        self.progress.setVisible(bool(activity.text))
        if activity.text:
            self.progress.setRange(0, 1000 if activity.progress else 0)  # 0 to 0: busy, of unknown duration
            self.progress.setValue(round(activity.progress * 1000))
            self.progress.setToolTip(f"{activity.text}: Esc cancels" if activity.may_cancel else activity.text)

    def show_state(
        self, *, failure: str, warning: str, advice: str, may_reconnect: bool = True, may_take_control: bool = False
    ) -> None:
        """Show the message of highest priority, a `failure` with `advice`, and a button if it `may_take_control`."""
        if failure and failure != self._standing.get("failure"):
            self._question = ""  # no device is left to apply it
        for name, text in (("failure", failure), ("warning", warning)):
            is_same = _NUMBER.sub("", self._standing.get(name, "")) == _NUMBER.sub("", text)
            self._standing[name] = text
            if not is_same:  # a number alone may change ten times a second
                self._say(text)
        self.reconnect.setVisible(bool(failure) and may_reconnect and not self._asks)
        self.control.setVisible(may_take_control and not failure)
        self.accept.setVisible(self._asks)
        self.discard.setVisible(self._asks)
        self.dismiss.setVisible(bool(self._alarm) and not failure)
        if failure and not self._asks:  # a question is about the way out
            self._show(f"{failure}  \N{EM DASH}  {advice}", theme.RED)
        elif self._alarm:
            self._show(self._alarm, theme.RED)
        elif self._asks:
            self._show(self._question, theme.AMBER if self._is_destructive else theme.GREEN)
        elif self._has_notice:
            self._show(self._notice, self._notice_colour)
        elif warning:
            self._show(warning, theme.AMBER)
        else:
            self._show(advice, theme.DIM)

    def show_closing(self, light: str) -> None:
        """Show that the window closes when the devices have; `light` says what becomes of it."""
        self._show(f"closing: {light}; waiting for the frame that is being processed", theme.AMBER)

    @property
    def _has_notice(self) -> bool:
        return bool(self._notice) and time.monotonic() < self._notice_until_s

    @property
    def _asks(self) -> bool:
        """True if the question is seen: no alarm and no refused entry hides it."""
        is_refusing = self._has_notice and self._notice_colour is theme.RED
        return bool(self._question) and not self._alarm and not is_refusing

    def _answer(self, *, is_accepted: bool) -> None:
        act, self._act, self._question = self._act, lambda: None, ""  # it may hold a closed bench
        self.answered.emit(is_accepted)
        if is_accepted:
            act()

    def _notify(self, text: str, colour: QColor) -> None:
        self._notice, self._notice_colour, self._notice_until_s = text, colour, time.monotonic() + _NOTICE_S

    def _say(self, text: str) -> None:
        """Keep a message in the log, unless it repeats the newest."""
        sentence = as_sentence(text)
        if text and not (self._lines and self._lines[-1][1] == sentence):
            self._lines.append((f"{datetime.now().astimezone():%Y-%m-%d %H:%M:%S}", sentence))
            self.logged.emit()

    def _show(self, text: str, colour: QColor) -> None:
        sentence = as_sentence(text)
        if (sentence, colour) != self._shown:
            self._shown = (sentence, colour)
            self.text.setText(sentence)
            self.explain.setVisible(colour in (theme.RED, theme.AMBER) and bool(entry_of(sentence)))
            colour_text(self.text, colour)
