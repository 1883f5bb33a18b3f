"""A tour of the window, one part after the other."""

from PyQt6.QtCore import QEvent, QObject, QPoint, QRect, Qt
from PyQt6.QtGui import QCloseEvent, QKeyEvent
from PyQt6.QtWidgets import QFrame, QWidget

from app.gui.widgets.buttons import Button, keeps_key
from app.gui.widgets.layouts import column, row
from app.gui.widgets.texts import label

_WIDTH_PX = 340


class Tour(QFrame):
    """A bubble that explains one outlined part after the other; the window stays usable."""

    def __init__(self, window: QWidget, steps: tuple[tuple[QWidget, str, str], ...]) -> None:
        super().__init__(window)
        self.setObjectName("tour")
        self.setProperty("role", "bubble")
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self._window, self._steps, self._index = window, steps, 0
        self._outline = QFrame(window)
        self._outline.setProperty("role", "outline")
        self._outline.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.title, self.text, self.count = label("", "title"), label("", wraps=True), label("", "dim")
        self.text.setFixedWidth(_WIDTH_PX)
        self.text.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.next = Button("Next", "The next part", self._advance)
        self.end = Button("End the tour", "It stays in the menu Help", self.close)
        buttons = row((self.count, 1), self.end, self.next)
        column(self.title, self.text, buttons, spacing=8, parent=self).setContentsMargins(14, 12, 14, 12)
        window.installEventFilter(self)

    def begin(self) -> None:
        for other in self._window.findChildren(Tour):
            if other is not self:
                other.close()
        room, wrap = QRect(0, 0, _WIDTH_PX, 999), Qt.TextFlag.TextWordWrap
        heights = [self.text.fontMetrics().boundingRect(room, wrap, text).height() for _, _, text in self._steps]
        self.text.setFixedHeight(max(heights) + self.fontMetrics().height())
        self.show()  # from now on it has the fonts of the style sheet
        self.next.setText("Done")
        self.next.setMinimumWidth(self.next.sizeHint().width())
        self.adjustSize()
        self._show_step()

    def eventFilter(self, watched: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        """Follow the window's size, and end at Esc."""
        if isinstance(event, QKeyEvent) and event.key() == Qt.Key.Key_Escape and self.isVisible():
            if not keeps_key(event, Qt.Key.Key_Escape) and event.type() == QEvent.Type.KeyPress:
                self.close()
            return True
        if event is not None and event.type() == QEvent.Type.Resize:
            self._place()
        return super().eventFilter(watched, event)

    def closeEvent(self, event: QCloseEvent | None) -> None:  # noqa: N802 - Qt's name
        self._outline.close()
        super().closeEvent(event)

    def _advance(self) -> None:
        if self._index + 1 == len(self._steps):
            self.close()  # it still receives events until it is deleted
        else:
            self._index += 1
            self._show_step()

    def _show_step(self) -> None:
        _, title, text = self._steps[self._index]
        self.title.setText(title)
        self.text.setText(text)
        self.count.setText(f"{self._index + 1} of {len(self._steps)}")
        self.next.setText("Next" if self._index + 1 < len(self._steps) else "Done")
        self._place()

    def _place(self) -> None:
        """Outline the part; the bubble stays at the middle of the window, so that its button stays in place."""
        part = self._steps[self._index][0]
        where = QRect(part.mapTo(self._window, QPoint(0, 0)), part.size())
        self._outline.setGeometry(where)
        self._outline.show()
        self.move(self._window.rect().center() - self.rect().center())
        self.raise_()
