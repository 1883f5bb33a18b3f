"""A small picture that is seen until the window is there; its libraries take seconds to load."""

import sys
from pathlib import Path

from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor, QIcon, QPainter, QPixmap
from PyQt6.QtWidgets import QApplication, QSplashScreen

_WIDTH, _HEIGHT, _ICON = 320, 150, 72  # px


def show_splash() -> QSplashScreen:
    """Show the picture at once; `finish` replaces it by a window."""
    application = QApplication.instance() or QApplication(sys.argv[:1])
    picture = QPixmap(_WIDTH, _HEIGHT)
    picture.fill(QColor("#1c2026"))
    painter = QPainter(picture)
    icon = QIcon(str(Path(__file__).with_name("svwfs.svg"))).pixmap(_ICON, _ICON)
    painter.drawPixmap((_WIDTH - icon.width()) // 2, 22, icon)
    painter.end()
    splash = QSplashScreen(picture)
    splash.showMessage(
        "svwfs is starting ...\n", Qt.AlignmentFlag.AlignBottom | Qt.AlignmentFlag.AlignHCenter, QColor("#dde2e8")
    )
    if QApplication.platformName() != "offscreen":  # nobody would see it
        splash.show()
        application.processEvents()
    return splash
