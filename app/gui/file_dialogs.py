"""Dialogs that ask for a file or a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from PyQt6.QtWidgets import QFileDialog

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow


def save_bench(window: MainWindow) -> None:
    """Ask for a file and save the bench in force."""
    if window.controller.status is not None:
        name, _ = QFileDialog.getSaveFileName(window, "Save the bench", "bench.toml", "Bench (*.toml)")
        if name:
            window.controller.save_bench(Path(name))


def choose_recordings_folder(window: MainWindow) -> None:
    """Ask for the folder of later recordings."""
    before = str(window.controller.recordings_folder)
    if chosen := QFileDialog.getExistingDirectory(window, "Recordings folder", before):
        window.controller.use_recordings_folder(Path(chosen))
