"""Elements of panels and dialogs: rows and columns, labels, marks of what a control shows, buttons, choices, timers."""

from collections.abc import Callable, Iterable
from typing import TypeVar

from PyQt6.QtCore import QEvent, QObject, QSize, Qt, QTimer, pyqtBoundSignal
from PyQt6.QtGui import QColor, QKeyEvent, QPainter, QPaintEvent, QResizeEvent, QTextLayout, QWheelEvent
from PyQt6.QtWidgets import (
    QAbstractScrollArea,
    QBoxLayout,
    QComboBox,
    QFrame,
    QHBoxLayout,
    QLabel,
    QLayout,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QStyle,
    QStyledItemDelegate,
    QStyleOptionComboBox,
    QVBoxLayout,
    QWidget,
)

from app.bench.settings_form import NAMES
from app.gui.widgets import theme

Item = QWidget | QLayout | tuple[QWidget | QLayout, int]  # the number is the stretch
L = TypeVar("L", bound=QBoxLayout)
FRAME_PX = QSize(10, 40)  # window managers add it only when a window is shown
Slot = Callable[..., object] | pyqtBoundSignal
ENTER = (Qt.Key.Key_Return, Qt.Key.Key_Enter)
_COMBO = QStyle.ComplexControl.CC_ComboBox
_CURSOR_PX = 2  # that Qt leaves beside a chosen text
REFRESH_MS = 40  # 25 times a second


def row(*items: Item, spacing: int = 6, parent: QWidget | None = None) -> QHBoxLayout:
    """Arrange widgets and layouts from left to right, without margins."""
    return _filled(QHBoxLayout(parent), items, spacing)


def row_of(*items: Item) -> QWidget:
    """Make a widget of items from left to right."""
    made = QWidget()
    row(*items, parent=made)
    return made


def column(*items: Item, spacing: int = 6, parent: QWidget | None = None) -> QVBoxLayout:
    """Arrange widgets and layouts from top to bottom, without margins."""
    return _filled(QVBoxLayout(parent), items, spacing)


def _filled(layout: L, items: tuple[Item, ...], spacing: int) -> L:
    layout.setContentsMargins(0, 0, 0, 0)
    layout.setSpacing(spacing)
    for item in items:
        content, stretch = item if isinstance(item, tuple) else (item, 0)
        if isinstance(content, QWidget):
            layout.addWidget(content, stretch)
        else:
            layout.addLayout(content, stretch)
    return layout


class Scrolled(QScrollArea):
    """Contents at their full size, which scroll where the screen is smaller."""

    def __init__(self, contents: QWidget) -> None:
        super().__init__()
        self.setWidget(contents)
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        unfocused(self)

    def eventFilter(self, watched: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        """Tell the layout that the contents need another size."""
        if event is not None and event.type() == QEvent.Type.LayoutRequest:
            self.updateGeometry()
        return super().eventFilter(watched, event)

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return the size of the contents, which Qt would limit, and room for the scroll bar."""
        contents, bar = self.widget(), self.verticalScrollBar()
        if contents is None or bar is None:
            return super().sizeHint()
        width = contents.sizeHint().width()
        height = max(contents.sizeHint().height(), contents.heightForWidth(width))
        return QSize(width + bar.sizeHint().width(), height)


def unfocused(area: QAbstractScrollArea) -> None:
    """Exclude an area from the Tab order."""
    for widget in (area, area.viewport()):
        if widget is not None:
            widget.setFocusPolicy(Qt.FocusPolicy.NoFocus)


def within_screen(widget: QWidget, size: QSize) -> QSize:
    """Return a size that fits, with the frame of its window, on the screen of a widget."""
    screen = widget.screen()
    return size if screen is None else size.boundedTo(screen.availableGeometry().size() - FRAME_PX)


def label(text: str, role: str = "", parent: QWidget | None = None, *, wraps: bool = False) -> QLabel:
    """Make a label; its role ("title", "dim", "badge") selects the style."""
    made = QLabel(text, parent)
    made.setProperty("role", role)
    made.setWordWrap(wraps)
    return made


class ElidedLabel(QLabel):
    """A text without minimum width; an ellipsis replaces what does not fit, and the tool tip has it all.

    The text is kept from QLabel, which would request a new layout for each change.
    """

    def __init__(self, role: str = "", text: str = "", *, lines: int = 1) -> None:
        """Show a text in as many lines as it needs, at most `lines`; for `role` see `label`."""
        super().__init__()
        self.setProperty("role", role)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._most, self._taken = lines, 1
        self._keep_room()
        self.setText(text)

    def setText(self, text: str | None) -> None:  # noqa: N802 - Qt's name
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
        lines = self._wrapped() if self._most > 1 else [self._text]
        first, rest = lines[: self._most - 1], "".join(lines[self._most - 1 :])
        fitting = self.fontMetrics().elidedText(rest, Qt.TextElideMode.ElideRight, self.width())
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
            self._taken = 1
            self._take_lines()

    def _take_lines(self) -> None:
        """Take more lines if the text needs them; only another width gives them back, so that nothing jumps."""
        if self._most > 1:
            self._taken = max(self._taken, min(len(self._wrapped()), self._most))
            self._keep_room()

    def _keep_room(self) -> None:
        self.setMinimumHeight(self._taken * self.fontMetrics().height())  # also when empty, so that nothing moves

    def _wrapped(self) -> list[str]:
        layout, lines = QTextLayout(self._text, self.font()), []
        layout.beginLayout()
        while (line := layout.createLine()).isValid():
            line.setLineWidth(self.width())
            lines.append(self._text[line.textStart() : line.textStart() + line.textLength()])
        layout.endLayout()
        return lines


def colour_text(shown: QLabel, colour: QColor) -> None:
    """Show a text in a colour of the theme, also when the theme changes."""
    _restyle(shown, "tone", theme.tone(colour))


def mark_wanted(control: QWidget, *, is_wanted: bool) -> None:
    """Show the value of a control in amber italics while it is wanted and not in force."""
    _restyle(control, "wanted", is_wanted)


def mark_refused(control: QWidget, *, is_refused: bool) -> None:
    """Show in red what is typed and cannot be used."""
    control.setStyleSheet(f"color: {theme.RED.name()};" if is_refused else "")


def _restyle(widget: QWidget, name: str, value: object) -> None:
    if (widget.property(name) or False) != value and (style := widget.style()) is not None:
        widget.setProperty(name, value)
        style.unpolish(widget)
        style.polish(widget)


class Button(QPushButton):
    """A button that does not take the focus when clicked.

    While it has the focus, Space and Return press it, although both are shortcuts of the window.
    """

    def __init__(self, text: str, tool_tip: str, clicked: Slot | None = None) -> None:
        super().__init__(text)
        self.setToolTip(tool_tip)
        self.setIconSize(QSize(14, 14))
        self.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        if clicked is not None:
            self.clicked.connect(clicked)

    def event(self, event: QEvent | None) -> bool:
        if isinstance(event, QKeyEvent) and event.type() == QEvent.Type.KeyPress and event.key() in ENTER:
            self.click()
            return True
        return keeps_key(event, Qt.Key.Key_Space, *ENTER) or super().event(event)


class Toggle(Button):
    """A button that stays pressed until the next click."""

    def __init__(
        self, text: str, tool_tip: str, clicked: Slot | None = None, *, is_on: bool = False, key: str = ""
    ) -> None:
        """Under its `key`, if any, its state is kept between two starts."""
        super().__init__(text, tool_tip, clicked)
        self.setObjectName(key)
        self.setCheckable(True)
        self.setChecked(is_on)


class Choice(QComboBox):
    """A choice that Space opens and the wheel changes only with the focus, which a click does not give."""

    def __init__(
        self,
        tool_tip: str = "",
        items: Iterable[str | tuple[str, object]] = (),
        changed: Slot | None = None,
        *,
        key: str = "",
    ) -> None:
        """Offer texts, some with data; `changed` is called when another is current. For the `key` see `Toggle`."""
        super().__init__()
        self.setItemDelegate(QStyledItemDelegate(self))  # Qt's own paints all items like a wanted value
        if (listed := self.view()) is not None:
            listed.setFont(self.font())
        self.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.setObjectName(key)
        self.setToolTip(tool_tip)
        for item in items:
            self.addItem(*((item,) if isinstance(item, str) else item))
        self.currentTextChanged.connect(self.updateGeometry)
        if changed is not None:
            self.currentIndexChanged.connect(changed)

    def show_choice(self, allowed: tuple[str | int, ...], chosen: str | int) -> None:
        """Offer these values by their human names and show the chosen one, without emitting `activated`."""
        if tuple(self.itemData(index) for index in range(self.count())) != allowed:
            self.clear()
            for value in allowed:
                self.addItem(NAMES.get(str(value), str(value)), value)
            if (items := self.view()) is not None:
                items.setMinimumWidth(items.sizeHintForColumn(0) + 8)  # no elided items below a narrow choice
        self.setCurrentIndex(self.findData(chosen))
        self.setEnabled(len(allowed) > 1)

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return the size in which the chosen text is not cut."""
        size, option, style = super().minimumSizeHint(), QStyleOptionComboBox(), self.style()
        self.initStyleOption(option)
        if isinstance(style, QStyle):
            part = style.subControlRect(_COMBO, option, QStyle.SubControl.SC_ComboBoxEditField, self)
            around = option.rect.width() - part.width() + _CURSOR_PX
            size.setWidth(self.fontMetrics().horizontalAdvance(self.currentText()) + around)
        return size

    def event(self, event: QEvent | None) -> bool:
        if scrolls_past(event, self):
            return False
        return keeps_key(event, Qt.Key.Key_Space) or super().event(event)


def keeps_key(event: QEvent | None, *keys: Qt.Key) -> bool:
    """Keep these keys from the shortcuts of the window; return whether the event offers one of them."""
    is_offered = isinstance(event, QKeyEvent) and event.type() == QEvent.Type.ShortcutOverride and event.key() in keys
    if event is not None and is_offered:
        event.accept()
    return is_offered


def scrolls_past(event: QEvent | None, widget: QWidget) -> bool:
    """Return whether the wheel turns over a widget without the focus, which must not change a setting."""
    is_past = isinstance(event, QWheelEvent) and not widget.hasFocus()
    if event is not None and is_past:
        event.ignore()
    return is_past


def timer(parent: QObject, interval_ms: int, act: Callable[[], object], *, is_single: bool = False) -> QTimer:
    """Make a timer, stopped, that calls `act`."""
    made = QTimer(parent)
    made.setInterval(interval_ms)
    made.setSingleShot(is_single)
    made.timeout.connect(act)
    return made
