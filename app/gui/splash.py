"""A small picture that is seen until the window is there; its libraries take seconds to load."""

import sys
from pathlib import Path

from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor, QIcon, QPainter, QPixmap
from PyQt6.QtWidgets import QApplication, QSplashScreen

_WIDTH, _HEIGHT, _ICON = 320, 150, 72  # px


class Splash(QSplashScreen):
    """The picture, shown at once; `finish` replaces it by a window."""

    def __init__(self) -> None:
        self._application = QApplication.instance() or QApplication(sys.argv[:1])  # held: it ends when nobody does
        picture = QPixmap(_WIDTH, _HEIGHT)
        picture.fill(QColor("#1c2026"))
        painter = QPainter(picture)
        icon = QIcon(str(Path(__file__).with_name("svwfs.svg"))).pixmap(_ICON, _ICON)
        painter.drawPixmap((_WIDTH - icon.width()) // 2, 22, icon)
        painter.end()
        super().__init__(picture)
        at_bottom = Qt.AlignmentFlag.AlignBottom | Qt.AlignmentFlag.AlignHCenter
        self.showMessage("svwfs is starting ...\n", at_bottom, QColor("#dde2e8"))
        if QApplication.platformName() != "offscreen":  # nobody would see it
            self.show()
            self._application.processEvents()
