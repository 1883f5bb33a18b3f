"""A line of names and values that leaves out the least important ones where there is no room for all."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

from PyQt6.QtCore import QSize
from PyQt6.QtGui import QResizeEvent
from PyQt6.QtWidgets import QHBoxLayout, QLabel, QSizePolicy, QWidget

from app.gui.widgets import label

_GAP = 14  # px between two parts
_WITHIN = 4  # px between a name and its value


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    name: str
    importance: int  # 0 is left out last
    shown: QWidget  # holds name and value
    value: QLabel


class FittingRow(QWidget):
    """Asks for no width; an ellipsis says that something is left out, and its tool tip what."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._parts: list[_Part] = []
        self._row = QHBoxLayout(self)
        self._row.setContentsMargins(0, 0, 0, 0)
        self._row.setSpacing(_GAP)
        self._more = label("\N{HORIZONTAL ELLIPSIS}", "dim")
        self._row.addWidget(self._more)
        self._row.addStretch()
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)

    def add(self, name: str, tool_tip: str, *, widest: str, importance: int) -> QLabel:
        """Add a value beside its name, with room for the `widest` that is usual; the higher number goes first."""
        value = label("\N{EN DASH}")
        value.setMinimumWidth(value.fontMetrics().horizontalAdvance(widest))
        shown = QWidget()
        row = QHBoxLayout(shown)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(_WITHIN)
        for widget in (label(name, "dim"), value):
            row.addWidget(widget)
        shown.setToolTip(tool_tip)
        value.setToolTip(tool_tip)
        self._row.insertWidget(len(self._parts), shown)
        self._parts.append(_Part(name, importance, shown, value))
        return value

    @property
    def left_out(self) -> tuple[str, ...]:
        """The names that there is no room for."""
        return tuple(part.name for part in self._parts if part.shown.isHidden())

    def fit(self) -> None:
        """Show what there is room for, after values have changed; a value never asks for less than it did before."""
        for part in self._parts:
            part.value.setMinimumWidth(max(part.value.minimumWidth(), part.value.sizeHint().width()))
        whole = "\n".join(f"{part.name} {part.value.text()}" for part in self._parts)
        for widget in (self, self._more):
            widget.setToolTip(whole)
        width, wanted = self.width(), sum(map(_width, self._parts))
        left = width if wanted <= width else width - self._more.sizeHint().width() - _GAP
        widths = accumulate(_width(part) for part in self._by_importance())
        count = sum(width <= left for width in widths)
        for index, part in enumerate(self._by_importance()):
            part.shown.setVisible(index < count)
            if self.width() != width:  # that had a layout move it, and it was fitted anew
                return
        self._more.setVisible(count < len(self._parts))

    def _by_importance(self) -> list[_Part]:
        return sorted(self._parts, key=lambda part: part.importance)

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Whatever is there, it gets along with none of the width."""
        return QSize(0, super().minimumSizeHint().height())

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802 - Qt's name
        """Another width has room for others."""
        super().resizeEvent(event)
        self.fit()


def _width(part: _Part) -> int:
    return part.shown.sizeHint().width() + _GAP
