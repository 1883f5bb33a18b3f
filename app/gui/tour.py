"""A short tour of the window: one sentence or two beside each part."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PyQt6.QtCore import QEvent, QObject, QPoint, QRect, QSettings, Qt
from PyQt6.QtGui import QCloseEvent, QKeyEvent
from PyQt6.QtWidgets import QFrame, QLabel, QWidget

from app.gui.widgets import button, column, label, row

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow

_SEEN = "tour/seen"
_WIDTH = 340  # px


class Tour(QFrame):
    """A bubble that explains one outlined part after the other; the window stays usable."""

    def __init__(self, window: MainWindow) -> None:
        super().__init__(window)
        self.setObjectName("tour")
        self.setProperty("role", "bubble")
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self._window, self._index = window, 0
        self._steps: tuple[tuple[QWidget, str, str], ...] = (
            (
                window.camera_panel,
                "The camera",
                (
                    "Its picture with the lattice of the lenslets (G) and their mean displacement (A). The wheel zooms,"
                    " a double click shows the whole picture, a click on a lenslet inspects it."
                ),
            ),
            (
                window.wavefront_panel,
                "The wavefronts",
                (
                    "One map for each position of the field, all on one colour scale. Keys 1 to 6 choose what is shown,"
                    " V enlarges the selected view."
                ),
            ),
            (
                window.controls,
                "Devices and calibration",
                (
                    "Calibrate (Ctrl+K) finds lattice and exposure, takes dark and reference, and explains each step;"
                    " X, D and R do single ones. The lamps on Dark and Reference, and their tooltips, tell whether both"
                    " still fit the frames."
                ),
            ),
            (window.messages, "Messages", "What is wrong, why, and which key helps. Ctrl+L opens the log with times."),
            (
                window.recording_panel,
                "Recording",
                (
                    "W records every frame and its calibration; K saves the last ten seconds. Afterwards: replay,"
                    " report and export. F1 lists all keys."
                ),
            ),
        )
        self._outline = QFrame(window)
        self._outline.setProperty("role", "outline")
        self._outline.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.title, self.text, self.count = label("", "title"), QLabel(), label("", "dim")
        self.text.setWordWrap(True)
        self.text.setFixedWidth(_WIDTH)
        self.text.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.next = button("Next", "The next part", self._advance)
        self.end = button("End the tour", "It stays in the menu Help", self.close)
        buttons = row((self.count, 1), self.end, self.next)
        column(self.title, self.text, buttons, spacing=8, parent=self).setContentsMargins(14, 12, 14, 12)
        window.installEventFilter(self)
        window.docks.settled.connect(self.raise_)  # above a panel that has come to the front

    def begin(self) -> None:
        """Show the first part."""
        for other in self._window.findChildren(Tour):
            if other is not self:
                other.close()
        room, wrap = QRect(0, 0, _WIDTH, 999), Qt.TextFlag.TextWordWrap
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
            if event.type() == QEvent.Type.ShortcutOverride:
                event.accept()
            elif event.type() == QEvent.Type.KeyPress:
                self.close()
            return True
        if event is not None and event.type() == QEvent.Type.Resize:
            self._place()
        return super().eventFilter(watched, event)

    def closeEvent(self, event: QCloseEvent | None) -> None:  # noqa: N802 - Qt's name
        """Remove the outline, too."""
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


def offer_tour(window: MainWindow, settings: QSettings) -> None:
    """Show the tour at the first start."""
    if not settings.contains(_SEEN):
        settings.setValue(_SEEN, 1)
        Tour(window).begin()
