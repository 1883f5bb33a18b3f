"""Lenslets picked in the camera picture: a click, but not a double click, inspects one; its menu excludes it."""

from collections.abc import Callable

import pyqtgraph as pg
from PyQt6.QtCore import QObject, QPoint, QPointF, Qt, QTimer, pyqtSignal
from PyQt6.QtWidgets import QApplication, QMenu

Lenslet = tuple[int, int]  # row and column


class LensletPicker(QObject):
    """Emits what is asked for the lenslet under the pointer."""

    clicked = pyqtSignal(object)  # `Lenslet` to inspect; None beside the lattice
    exclusion_requested = pyqtSignal(int, int)  # of this lenslet, or its end

    def __init__(self, graphics: pg.GraphicsView, find: Callable[[QPointF], Lenslet | None]) -> None:
        """`find` returns the lenslet at a position of the scene."""
        super().__init__(graphics)
        self._graphics, self._find = graphics, find
        self._clicked_at: Lenslet | None = None
        self._wait = QTimer(self)
        self._wait.setSingleShot(True)
        self._wait.timeout.connect(lambda: self.clicked.emit(self._clicked_at))
        graphics.scene().sigMouseClicked.connect(self._click)

    def cancel(self) -> None:
        """Forget a click that was the first of two."""
        self._wait.stop()

    def _click(self, event: object) -> None:
        if event.button() != Qt.MouseButton.LeftButton:  # type: ignore[attr-defined] # pyqtgraph's event
            return
        self._wait.stop()
        if not event.double():  # type: ignore[attr-defined] # pyqtgraph's event
            self._clicked_at = self._find(event.scenePos())  # type: ignore[attr-defined] # pyqtgraph's event
            self._wait.start(QApplication.doubleClickInterval())

    def fill(self, menu: QMenu, at: QPoint) -> None:
        """Add what can be done with the lenslet at a position of the view."""
        if (lenslet := self._find(self._graphics.mapToScene(at))) is None:
            return
        name = "lenslet row {}, column {}".format(*lenslet)
        menu.addAction(f"Inspect {name}", lambda: self.clicked.emit(lenslet))
        menu.addAction(f"Exclude {name}, or use it again", lambda: self.exclusion_requested.emit(*lenslet))
        menu.addSeparator()
