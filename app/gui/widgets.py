"""Labels and buttons of all panels."""

from PyQt6.QtCore import QSize, Qt
from PyQt6.QtGui import QPainter, QPaintEvent
from PyQt6.QtWidgets import QAbstractScrollArea, QLabel, QPushButton, QSizePolicy, QStyle, QWidget


def label(text: str, role: str = "", parent: QWidget | None = None) -> QLabel:
    """Make a label; its role ("title", "dim", "on-image") selects the style."""
    made = QLabel(text, parent)
    made.setProperty("role", role)
    return made


class ElidedLabel(QLabel):
    """A line of text without minimum width; an ellipsis replaces what does not fit."""

    def __init__(self, role: str = "", parent: QWidget | None = None) -> None:
        """Start empty; for `role` see `label`."""
        super().__init__(parent)
        self.setProperty("role", role)
        self.setTextFormat(Qt.TextFormat.PlainText)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setMinimumHeight(self.fontMetrics().height())  # also when empty, so that nothing moves

    def paintEvent(self, _: QPaintEvent | None) -> None:  # noqa: N802 - Qt's name
        """Paint the text, elided to the width."""
        painter, style = QPainter(self), self.style()
        fitting = self.fontMetrics().elidedText(self.text(), Qt.TextElideMode.ElideRight, self.width())
        if isinstance(style, QStyle):
            style.drawItemText(
                painter, self.rect(), int(self.alignment()), self.palette(), True, fitting, self.foregroundRole()
            )


def button(text: str, tool_tip: str) -> QPushButton:
    """Make a button that does not take the focus when clicked."""
    made = QPushButton(text)
    made.setToolTip(tool_tip)
    made.setIconSize(QSize(14, 14))
    made.setFocusPolicy(Qt.FocusPolicy.TabFocus)
    return made


def toggle(text: str, tool_tip: str) -> QPushButton:
    """Make a checkable button."""
    made = button(text, tool_tip)
    made.setCheckable(True)
    return made


def unfocused(area: QAbstractScrollArea) -> None:
    """Exclude an area from the Tab order."""
    for widget in (area, area.viewport()):
        if widget is not None:
            widget.setFocusPolicy(Qt.FocusPolicy.NoFocus)
