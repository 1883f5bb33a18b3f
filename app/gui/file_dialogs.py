"""Dialogs that ask for a file or a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from PyQt6.QtWidgets import QFileDialog

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow


def choose_recordings_folder(window: MainWindow) -> None:
    """Ask for the folder of later recordings."""
    before = str(window.controller.recordings_folder)
    if chosen := QFileDialog.getExistingDirectory(window, "Recordings folder", before):
        window.controller.use_recordings_folder(Path(chosen))
