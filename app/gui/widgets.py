"""Labels and buttons as all panels use them."""

from __future__ import annotations

from PyQt6.QtCore import QSize, Qt
from PyQt6.QtGui import QPainter, QPaintEvent
from PyQt6.QtWidgets import QAbstractScrollArea, QLabel, QPushButton, QSizePolicy, QStyle, QWidget


def label(text: str, role: str = "", parent: QWidget | None = None) -> QLabel:
    """Make a label; its role ("title", "dim", "on-image") is what the theme knows it by."""
    made = QLabel(text, parent)
    made.setProperty("role", role)
    return made


class ElidedLabel(QLabel):
    """A line that asks for no width: what does not fit is left out at its end, and an ellipsis says so."""

    def __init__(self, role: str = "", parent: QWidget | None = None) -> None:
        """Begin empty; for `role` see `label`."""
        super().__init__(parent)
        self.setProperty("role", role)
        self.setTextFormat(Qt.TextFormat.PlainText)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setMinimumHeight(self.fontMetrics().height())  # also when it is empty, so that nothing moves

    def paintEvent(self, _: QPaintEvent | None) -> None:  # noqa: N802 - Qt's name
        """Paint as much of the text as there is room for."""
        painter, style = QPainter(self), self.style()
        fitting = self.fontMetrics().elidedText(self.text(), Qt.TextElideMode.ElideRight, self.width())
        if isinstance(style, QStyle):
            style.drawItemText(
                painter, self.rect(), int(self.alignment()), self.palette(), True, fitting, self.foregroundRole()
            )


def button(text: str, tool_tip: str) -> QPushButton:
    """Make a button that leaves the keyboard where it is when it is clicked."""
    made = QPushButton(text)
    made.setToolTip(tool_tip)
    made.setIconSize(QSize(14, 14))
    made.setFocusPolicy(Qt.FocusPolicy.TabFocus)
    return made


def toggle(text: str, tool_tip: str) -> QPushButton:
    """Make a button that stays down."""
    made = button(text, tool_tip)
    made.setCheckable(True)
    return made


def unfocused(area: QAbstractScrollArea) -> None:
    """Leave an area that has no use for the keyboard out of the round of the key Tab."""
    for widget in (area, area.viewport()):
        if widget is not None:
            widget.setFocusPolicy(Qt.FocusPolicy.NoFocus)
