"""Widgets outside the window: a picture until its libraries are loaded, and the dialog after an early end."""

import sys

from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor, QPainter, QPixmap
from PyQt6.QtWidgets import QApplication, QMessageBox, QSplashScreen

from app.gui.widgets import theme

_WIDTH, _HEIGHT, _ICON = 320, 150, 72  # px


class Splash(QSplashScreen):
    """The picture, shown at once; `finish` replaces it by a window."""

    def __init__(self) -> None:
        self._application = QApplication.instance() or QApplication(sys.argv[:1])  # kept alive with the picture
        picture = QPixmap(_WIDTH, _HEIGHT)
        picture.fill(theme.SURFACE)
        painter = QPainter(picture)
        icon = theme.icon().pixmap(_ICON, _ICON)
        painter.drawPixmap((_WIDTH - icon.width()) // 2, 22, icon)
        painter.end()
        super().__init__(picture)
        at_bottom = Qt.AlignmentFlag.AlignBottom | Qt.AlignmentFlag.AlignHCenter
        self.showMessage("svwfs is starting ...\n", at_bottom, QColor(theme.TEXT))
        if QApplication.platformName() != "offscreen":  # it could not be seen
            self.show()
            self._application.processEvents()


def show_ending(sentence: str, details: str) -> None:
    """Show how the program ended, and details on request, until the dialog is closed; no terminal tells."""
    application = QApplication.instance()
    if not isinstance(application, QApplication):
        application = QApplication(sys.argv[:1])
    application.setApplicationName("svwfs")
    theme.apply_theme(application)
    dialog = QMessageBox(QMessageBox.Icon.Critical, "svwfs", sentence)
    dialog.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    dialog.setDetailedText(details)
    dialog.exec()
