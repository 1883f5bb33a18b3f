"""Dialog that says why a bench is not open, shows the place in its file, and offers what can be done."""

from collections.abc import Callable
from html import escape

from PyQt6.QtCore import Qt
from PyQt6.QtWidgets import QDialog, QHBoxLayout, QLabel, QWidget

from app.gui import theme
from app.gui.widgets import button, column
from app.gui.wording import as_sentence

Choices = tuple[tuple[str, str, Callable[[], object]], ...]  # text, tool tip, action

_WIDTH = 560  # px


class BenchDialog(QDialog):
    """Shows one message with buttons that close it; the measurement continues beside it."""

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.text = QLabel()
        self.text.setTextFormat(Qt.TextFormat.RichText)
        self.text.setWordWrap(True)
        self.text.setMinimumWidth(_WIDTH)
        self.text.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self._buttons = QHBoxLayout()
        self._buttons.addStretch()
        column(self.text, self._buttons, spacing=12, parent=self).setContentsMargins(14, 12, 14, 12)

    def show_message(self, title: str, html: str, choices: Choices) -> None:
        """Show a message; each button closes the dialog before it acts."""
        self.setWindowTitle(title)
        self.text.setText(html)
        while (item := self._buttons.takeAt(1)) is not None:
            if (old := item.widget()) is not None:
                old.deleteLater()
        for text, tool_tip, act in (*choices, ("Close", "Change nothing (Esc)", lambda: None)):
            self._buttons.addWidget(button(text, tool_tip, lambda _=False, act=act: self._choose(act)))
        self.adjustSize()
        self.show()
        self.activateWindow()

    def _choose(self, act: Callable[[], object]) -> None:
        self.close()
        act()


def fault_html(sentence: str, lines: tuple[tuple[int, str], ...], faulty: int | None) -> str:
    """Format an error, and the lines of the file around the faulty one."""
    red = theme.RED.name()
    listing = "<br>".join(
        f'<span style="color: {red if number == faulty else theme.DIM.name()};">'
        f"{'&#9654;' if number == faulty else '&nbsp;'}&nbsp;{number:>4}&nbsp;&nbsp;{_spaced(text)}</span>"
        for number, text in lines
    )
    shown = f"<p>{escape(as_sentence(sentence))}</p>"
    return f'{shown}<p style="font-family: monospace;">{listing}</p>' if lines else shown


def _spaced(text: str) -> str:
    return escape(text).replace(" ", "&nbsp;")
