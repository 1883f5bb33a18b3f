"""Dialogs that ask for a file or a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from PyQt6.QtWidgets import QFileDialog

from app.errors import InputError, RunError
from app.files import check_outputs
from app.gui.picture_file import write_picture
from app.results.dataset import write_shown

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow


def export_view(window: MainWindow) -> None:
    """Ask for a name, and write the shown wavefronts as a picture with their numbers and as NetCDF."""
    shown, status = window.wavefront_panel.shown, window.controller.status
    if shown is None or status is None:
        window.messages.warn("there is no wavefront to export")
        return
    name, _ = QFileDialog.getSaveFileName(window, "Export the shown wavefronts", "wavefronts.png", "Picture (*.png)")
    if not name:
        return
    path, results = Path(name).with_suffix(".png"), Path(name).with_suffix(".nc")
    try:
        check_outputs([results], overwrite=path.exists())  # the dialog asked about the picture
        write_picture(path, window.wavefront_panel.grab())
        write_shown(results, shown, status.bench, options=window.wavefront_panel.menu.options.in_words)
    except (InputError, RunError) as error:
        window.messages.warn(str(error))
    else:
        window.messages.inform(f"saved {path} and {results.name}")


def export_history(window: MainWindow) -> None:
    """Ask for a name, and write the history as CSV."""
    name, _ = QFileDialog.getSaveFileName(window, "Export the history", "history.csv", "Table (*.csv)")
    if not name:
        return
    try:
        window.tabs.history.history.write_csv(path := Path(name).with_suffix(".csv"))
    except RunError as error:
        window.messages.warn(str(error))
    else:
        window.messages.inform(f"saved {path}")


def choose_recording(window: MainWindow) -> None:
    """Ask for a recording and play it in another window."""
    before = str(window.controller.recordings_folder)
    if chosen := QFileDialog.getExistingDirectory(window, "Replay a recording", before):
        window.drop.open(Path(chosen))


def choose_recordings_folder(window: MainWindow) -> None:
    """Ask for the folder of later recordings."""
    before = str(window.controller.recordings_folder)
    if chosen := QFileDialog.getExistingDirectory(window, "Recordings folder", before):
        window.controller.use_recordings_folder(Path(chosen))
