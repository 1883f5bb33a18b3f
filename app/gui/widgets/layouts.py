"""Layouts of widgets: rows, columns, and areas that scroll where the screen is small."""

from PyQt6.QtCore import QEvent, QObject, QSize, Qt
from PyQt6.QtWidgets import QAbstractScrollArea, QBoxLayout, QFrame, QLayout, QScrollArea, QWidget

from app.gui.widgets.texts import label

Item = QWidget | QLayout | tuple[QWidget | QLayout, int]  # the number is the stretch
FRAME_PX = QSize(10, 40)  # window managers add it only when a window is shown


def row(*items: Item, spacing: int = 6, parent: QWidget | None = None) -> QBoxLayout:
    """Arrange widgets and layouts from left to right, without margins."""
    return _filled(QBoxLayout(QBoxLayout.Direction.LeftToRight, parent), items, spacing)


def row_of(*items: Item) -> QWidget:
    """Make a widget of items from left to right."""
    made = QWidget()
    row(*items, parent=made)
    return made


def captioned(name: str, control: QWidget) -> QWidget:
    """Make a widget of a control below its name, which may have a unit."""
    made = QWidget()
    control.setAccessibleName(control.accessibleName() or name)
    column(label(name, "dim"), (control, 1), spacing=1, parent=made)
    return made


def column(*items: Item, spacing: int = 6, parent: QWidget | None = None) -> QBoxLayout:
    """Arrange widgets and layouts from top to bottom, without margins."""
    return _filled(QBoxLayout(QBoxLayout.Direction.TopToBottom, parent), items, spacing)


def fill_dialog(dialog: QWidget, *items: Item) -> None:
    """Arrange the contents of a dialog or a bubble from top to bottom, with margins."""
    column(*items, spacing=10, parent=dialog).setContentsMargins(14, 12, 14, 12)


def fill_strip(strip: QWidget, *items: Item) -> None:
    """Arrange the contents of a strip above or below the panels from left to right."""
    row(*items, parent=strip).setContentsMargins(10, 3, 6, 3)


def _filled(layout: QBoxLayout, items: tuple[Item, ...], spacing: int) -> QBoxLayout:
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

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return the least width of the contents: they only scroll up and down."""
        contents, bar = self.widget(), self.verticalScrollBar()
        least = super().minimumSizeHint()
        if contents is None or bar is None:
            return least
        return QSize(contents.minimumSizeHint().width() + bar.sizeHint().width(), least.height())

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return the size of the contents, which Qt would limit, and space for the scroll bar."""
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
