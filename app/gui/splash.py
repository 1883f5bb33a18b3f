"""Splash screen while the libraries are loaded, and the dialog after an early end."""

import sys
import time

from PyQt6.QtCore import Qt
from PyQt6.QtGui import QColor, QPainter, QPixmap
from PyQt6.QtWidgets import QApplication, QMessageBox, QSplashScreen

from app.gui.widgets import theme

_WIDTH_PX, _HEIGHT_PX, _ICON_PX = 320, 150, 72
_EXPOSED_S = 1.0  # time that a slow X server has to show a window
_SETTLED_S = 0.1  # then a window manager may still add a frame and expose it again


class Splash(QSplashScreen):
    """The picture, shown at once; `finish` replaces it by a window."""

    def __init__(self) -> None:
        self._application = QApplication.instance() or QApplication(sys.argv[:1])  # kept alive with the picture
        ratio = self._application.devicePixelRatio() if isinstance(self._application, QApplication) else 1.0
        picture = QPixmap(round(_WIDTH_PX * ratio), round(_HEIGHT_PX * ratio))
        picture.setDevicePixelRatio(ratio)
        picture.fill(theme.SURFACE)
        painter = QPainter(picture)
        theme.icon().paint(painter, (_WIDTH_PX - _ICON_PX) // 2, 22, _ICON_PX, _ICON_PX)
        painter.end()
        super().__init__(picture)
        at_bottom = Qt.AlignmentFlag.AlignBottom | Qt.AlignmentFlag.AlignHCenter
        self.showMessage("svwfs is starting ...\n", at_bottom, QColor(theme.TEXT))
        if QApplication.platformName() != "offscreen":  # it could not be seen
            self.show()
            self._paint()

    def _paint(self) -> None:
        """Handle events until the picture is on the screen; nothing else does while libraries load."""
        until_s, is_exposed = time.monotonic() + _EXPOSED_S, False
        while time.monotonic() < until_s:
            QApplication.processEvents()
            time.sleep(0.005)
            window = self.windowHandle()
            if not is_exposed and window is not None and window.isExposed():
                until_s, is_exposed = time.monotonic() + _SETTLED_S, True


def show_ending(sentence: str, details: str) -> None:
    """Show how the program ended, with details on request, where no terminal does."""
    _application = theme.styled_application()  # kept alive with the dialog
    dialog = QMessageBox(QMessageBox.Icon.Critical, "svwfs", sentence)
    dialog.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    dialog.setDetailedText(details)
    dialog.exec()
