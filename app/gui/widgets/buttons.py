"""Buttons and choices, which take no focus when they are clicked."""

from collections.abc import Callable, Iterable

from PyQt6.QtCore import QEvent, QObject, QSize, Qt, pyqtBoundSignal
from PyQt6.QtGui import QAction, QHelpEvent, QKeyEvent, QWheelEvent
from PyQt6.QtWidgets import QComboBox, QPushButton, QStyle, QStyledItemDelegate, QStyleOptionComboBox, QToolTip, QWidget

from app.bench.settings_form import name_of

Slot = Callable[..., object] | pyqtBoundSignal
Items = Iterable[str | tuple[str, object]]  # texts of a choice, some with data
ENTER = (Qt.Key.Key_Return, Qt.Key.Key_Enter)
_COMBO = QStyle.ComplexControl.CC_ComboBox
_CURSOR_PX = 2  # that Qt leaves next to a chosen text


class Button(QPushButton):
    """A button that a click gives no focus: with it, Space and Return would press it, although both are shortcuts."""

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


def close_button(dialog: QWidget, tool_tip: str = "Close (Esc)") -> Button:
    """Make the button that closes a dialog."""
    return Button("Close", tool_tip, dialog.close)


class Toggle(Button):
    """A button that stays pressed until the next click."""

    def __init__(self, text: str, tool_tip: str, clicked: Slot) -> None:
        super().__init__(text, tool_tip, clicked)
        self.setCheckable(True)


def checkable(
    parent: QWidget, text: str, tool_tip: str, toggled: Slot, *, is_on: bool = False, key: str = ""
) -> QAction:
    """Make an entry of a menu that is ticked or not; under its `key`, if any, that is restored at the next start."""
    made = QAction(text, parent)
    made.setToolTip(tool_tip)
    made.setObjectName(key)
    made.setCheckable(True)
    made.setChecked(is_on)
    made.toggled.connect(toggled)
    return made


class Choice(QComboBox):
    """A choice that Space opens and the wheel changes only with the focus, which a click does not give."""

    def __init__(self, tool_tip: str = "", items: Items = (), changed: Slot | None = None, *, key: str = "") -> None:
        """Offer `items`; call `changed` when another is current. `key`: see `checkable`."""
        super().__init__()
        self.setItemDelegate(QStyledItemDelegate(self))  # Qt's own paints all items like a wanted value
        if (listed := self.view()) is not None:
            listed.setFont(self.font())
        self.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.setObjectName(key)
        self.setToolTip(tool_tip)
        self.setAccessibleName(tool_tip.partition("\n")[0])
        for item in items:
            self.addItem(*((item,) if isinstance(item, str) else item))
        self.currentTextChanged.connect(self.updateGeometry)
        if changed is not None:
            self.currentIndexChanged.connect(changed)

    def show_choice(self, allowed: tuple[str | int, ...], chosen: str | int) -> None:
        """Offer values by their human names and show the chosen one, without `activated`."""
        if tuple(self.itemData(index) for index in range(self.count())) != allowed:
            self.clear()
            for value in allowed:
                self.addItem(name_of(str(value)), value)
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
    """Return whether the wheel turns over a widget without the focus; it must not change a setting."""
    is_past = isinstance(event, QWheelEvent) and not widget.hasFocus()
    if event is not None and is_past:
        event.ignore()
    return is_past


class Refusal(QObject):
    """Shows for a reason, in place of their tool tips, why widgets in some parents are disabled."""

    def __init__(self, *parents: QWidget) -> None:
        super().__init__(parents[0])
        self.reason = ""
        for each in (each for parent in parents for each in parent.findChildren(QWidget)):
            each.installEventFilter(self)

    def eventFilter(self, on: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        if not self.reason or not isinstance(event, QHelpEvent) or event.type() != QEvent.Type.ToolTip:
            return False
        if not isinstance(on, QWidget) or on.isEnabled():
            return False
        QToolTip.showText(event.globalPos(), self.reason, on)
        return True
