"""Labels, and the colours of what is shown."""

import re

from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor, QFontMetrics, QPainter, QPaintEvent, QResizeEvent, QTextLayout
from PyQt6.QtWidgets import QLabel, QSizePolicy, QStyle, QWidget

from app.gui.widgets import theme

_BEFORE_UNIT = re.compile(r"(?<=\d) (?=%|\w{1,4}\b)")  # no line begins with a unit
_LOST_WORD = 15  # characters, of the longest word that is left out rather than cut


def label(text: str, role: str = "", parent: QWidget | None = None, *, is_wrapped: bool = False) -> QLabel:
    """Make a label; its role ("title", "dim", "badge") selects the style."""
    made = QLabel(text, parent)
    made.setProperty("role", role)
    made.setWordWrap(is_wrapped)
    return made


def elided(text: str, font: QFontMetrics, width: int) -> str:
    """Return a text of this width, px, with an ellipsis, after a whole word, in place of what does not fit."""
    shown = font.elidedText(text, Qt.TextElideMode.ElideRight, width)
    end = shown.rfind(" ", len(shown) - _LOST_WORD) if shown != text else -1
    return shown if end < 1 else shown[:end].rstrip(" ,;:(") + "\N{HORIZONTAL ELLIPSIS}"


class ElidedLabel(QLabel):
    """A text without minimum width; an ellipsis replaces what does not fit, and the tool tip has it all.

    The text is retained from QLabel, which would request a new layout for each change.
    """

    def __init__(self, role: str = "", text: str = "", *, lines: int = 1, least: int = 1) -> None:
        """Show a text in as many lines as it needs, `least` to `lines`; for `role` see `label`."""
        super().__init__()
        self.setProperty("role", role)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._most, self._least, self._taken, self._text = lines, least, least, ""
        self._fitted: tuple[tuple[object, ...], str] = (), ""  # what the shown text was computed for, and that text
        self._keep_room()
        self.setText(text)

    def setText(self, text: str | None) -> None:  # noqa: N802 - Qt's name
        if self._text == (text or ""):
            return
        self._text = text or ""
        self.setToolTip(text)
        self.setAccessibleName(text)
        self._take_lines()
        self.update()

    def text(self) -> str:
        return self._text

    @property
    def shown(self) -> str:
        """The text as it is painted: lines that fit the width, the last one elided."""
        fitted = self._text, self.width(), self.font()
        if fitted != self._fitted[0]:
            self._fitted = fitted, self._fit()
        return self._fitted[1]

    def _fit(self) -> str:
        lines = self._wrapped() if self._most > 1 else [self._text]
        first, rest = lines[: self._most - 1], "".join(lines[self._most - 1 :])
        fitting = elided(rest, self.fontMetrics(), self.width())
        return "\n".join([*first, "" if fitting == "\N{HORIZONTAL ELLIPSIS}" else fitting]).rstrip("\n")

    def paintEvent(self, _: QPaintEvent | None) -> None:  # noqa: N802 - Qt's name
        painter, style = QPainter(self), self.style()
        if isinstance(style, QStyle):
            style.drawItemText(
                painter, self.rect(), int(self.alignment()), self.palette(), True, self.shown, self.foregroundRole()
            )

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802 - Qt's name
        super().resizeEvent(event)
        if event is not None and event.size().width() != event.oldSize().width():
            self._taken = self._least
            self._take_lines()

    def _take_lines(self) -> None:
        """Take more lines if needed; only another width gives them back, so that nothing jumps."""
        if self._most > 1:
            self._taken = max(self._taken, min(len(self._wrapped()), self._most))
            self._keep_room()

    def _keep_room(self) -> None:
        self.setMinimumHeight(self._taken * self.fontMetrics().height())  # also when empty, so that nothing moves

    def _wrapped(self) -> list[str]:
        layout, lines = QTextLayout(_BEFORE_UNIT.sub("\N{NO-BREAK SPACE}", self._text), self.font()), []
        layout.beginLayout()
        while (line := layout.createLine()).isValid():
            line.setLineWidth(self.width())
            lines.append(self._text[line.textStart() : line.textStart() + line.textLength()])
        layout.endLayout()
        return lines


def colour_text(shown: QLabel, colour: QColor) -> None:
    """Show a text in a colour of the theme, also when the theme changes."""
    theme.restyle(shown, "tone", theme.tone(colour))


def mark_refused(control: QWidget, *, is_refused: bool) -> None:
    """Show in red what is typed and cannot be used."""
    control.setStyleSheet(f"color: {theme.RED.name()};" if is_refused else "")
