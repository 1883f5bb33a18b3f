"""The dialog that tells how the program ended, where no terminal does."""

import sys

from PyQt6.QtCore import Qt
from PyQt6.QtWidgets import QApplication, QMessageBox

from app.gui.theme import apply_theme


def show_ending(sentence: str, details: str) -> None:
    """Show a sentence, and details on request, until the dialog is closed."""
    application = QApplication.instance()
    if not isinstance(application, QApplication):
        application = QApplication(sys.argv[:1])
    application.setApplicationName("svwfs")
    apply_theme(application)
    dialog = QMessageBox(QMessageBox.Icon.Critical, "svwfs", sentence)
    dialog.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    dialog.setDetailedText(details)
    dialog.exec()
