"""Labels and buttons as all panels use them."""

from __future__ import annotations

from PyQt6.QtCore import QSize, Qt
from PyQt6.QtWidgets import QLabel, QPushButton, QWidget


def label(text: str, role: str = "", parent: QWidget | None = None) -> QLabel:
    """Make a label; its role ("title", "dim", "on-image") is what the theme knows it by."""
    made = QLabel(text, parent)
    made.setProperty("role", role)
    return made


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
