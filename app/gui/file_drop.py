"""Files dropped on the window: recordings, benches, and frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from PyQt6.QtCore import QEvent, QMimeData, QObject
from PyQt6.QtGui import QDropEvent

from app.errors import InputError
from app.images import SUFFIXES
from app.recording.folder import read_run

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow


class FileDrop(QObject):
    """Takes what is dropped on a window: opens benches, plays recordings in another window, and shows frames."""

    def __init__(self, window: MainWindow) -> None:
        super().__init__(window)
        self._window = window
        window.setAcceptDrops(True)
        window.installEventFilter(self)

    def eventFilter(self, watched: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        """Accept local files and open them."""
        if isinstance(event, QDropEvent) and (paths := _paths(event.mimeData())):  # also its subclasses: enter, move
            event.acceptProposedAction()
            for path in paths if event.type() == QEvent.Type.Drop else ():
                self.open(path)
            return True
        return super().eventFilter(watched, event)

    def open(self, path: Path) -> None:
        """Open a recording or a bench, or show a frame."""
        try:
            if path.is_dir():
                read_run(path)
                self._window.recording_bar.play(path)
            elif path.suffix == ".toml":
                self._window.benches.open(str(path))
            elif path.suffix.lower() in SUFFIXES:
                self._show_frame(path)
            else:
                self._window.messages.warn(
                    f"{path.name}: drop a recording's folder, a bench (.toml) or a frame (.tif, .fits, .png, .npy)"
                )
        except InputError as error:
            self._window.messages.warn(str(error))

    def _show_frame(self, path: Path) -> None:
        acquisition = self._window.controller.acquisition
        if acquisition is None:
            return
        if acquisition.recording is not None and acquisition.recording.stage == "recording":
            self._window.messages.warn(f"{path.name}: is not shown during a recording, of which it would be part")
            return
        shown = acquisition.show_file(path)
        text = f"{path.name} is shown, reconstructed with the present reference; Space returns to the camera"
        self._window.controller.pending.add(shown, lambda _: self._window.messages.inform(text))


def _paths(data: QMimeData | None) -> list[Path]:
    return [] if data is None else [Path(url.toLocalFile()) for url in data.urls() if url.isLocalFile()]
