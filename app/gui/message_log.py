"""The message log: everything that the message strip has said, with times."""

from collections import deque
from datetime import datetime

from PyQt6.QtCore import QObject, pyqtSignal

from app.gui.message_strip import MessageStrip

_MOST = 1000


class MessageLog(QObject):
    """Keeps the last thousand messages of a strip; a repetition of the newest is left out."""

    changed = pyqtSignal()

    def __init__(self, messages: MessageStrip, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._lines: deque[tuple[str, str]] = deque(maxlen=_MOST)  # time and message
        messages.said.connect(self._add)

    @property
    def text(self) -> str:
        """The messages, oldest first, one on each line."""
        return "\n".join(f"{time}  {message}" for time, message in self._lines)

    def _add(self, message: str) -> None:
        if not self._lines or self._lines[-1][1] != message:
            self._lines.append((f"{datetime.now().astimezone():%Y-%m-%d %H:%M:%S}", message))
            self.changed.emit()
