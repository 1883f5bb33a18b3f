"""A short tour of the window: one sentence or two beside each part."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PyQt6.QtCore import QEvent, QObject, QPoint, QRect, QSettings, Qt
from PyQt6.QtWidgets import QFrame, QLabel, QWidget

from app.gui.widgets import button, column, label, row

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow

_SEEN = "tour/seen"
_WIDTH = 340  # px
_MARGIN = 14  # px, to the part and to the window


class Tour(QFrame):
    """A bubble that explains one part after the other; the window stays usable."""

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
        self.title, self.text, self.count = label("", "title"), QLabel(), label("", "dim")
        self.text.setWordWrap(True)
        self.text.setFixedWidth(_WIDTH)
        self.next = button("Next", "The next part", self._advance)
        self.end = button("End the tour", "It stays in the menu Help", self.close)
        buttons = row((self.count, 1), self.end, self.next)
        column(self.title, self.text, buttons, spacing=8, parent=self).setContentsMargins(14, 12, 14, 12)
        window.installEventFilter(self)

    def begin(self) -> None:
        """Show the first part."""
        for other in self._window.findChildren(Tour):
            if other is not self:
                other.close()
        self._show_step()
        self.show()
        self.raise_()

    def eventFilter(self, watched: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        """Follow the window's size."""
        if event is not None and event.type() == QEvent.Type.Resize:
            self._place()
        return super().eventFilter(watched, event)

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
        self.text.setFixedHeight(self.text.heightForWidth(_WIDTH))
        self.count.setText(f"{self._index + 1} of {len(self._steps)}")
        self.next.setText("Next" if self._index + 1 < len(self._steps) else "Done")
        self._place()

    def _place(self) -> None:
        """Put the bubble beside its part, above one at the lower edge, and within the window."""
        self.adjustSize()
        part = self._steps[self._index][0]
        where = QRect(part.mapTo(self._window, QPoint(0, 0)), part.size())
        room = self._window.rect().marginsRemoved(self.contentsMargins()).adjusted(_MARGIN, _MARGIN, -_MARGIN, -_MARGIN)
        if where.height() > 2 * self.height():
            corner = where.center() - self.rect().center()
        elif where.center().y() > room.center().y():
            corner = QPoint(where.center().x() - self.width() // 2, where.top() - self.height() - _MARGIN)
        else:
            corner = QPoint(where.center().x() - self.width() // 2, where.bottom() + _MARGIN)
        x = min(max(corner.x(), room.left()), room.right() - self.width())
        y = min(max(corner.y(), room.top()), room.bottom() - self.height())
        self.move(x, y)


def offer_tour(window: MainWindow, settings: QSettings) -> None:
    """Show the tour at the first start."""
    if not settings.contains(_SEEN):
        settings.setValue(_SEEN, 1)
        Tour(window).begin()
