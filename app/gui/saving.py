"""What the window saves: a picture of itself, and the bench in force."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from PyQt6.QtCore import QStandardPaths
from PyQt6.QtWidgets import QFileDialog, QWidget

from app.bench.config import Bench, write_bench
from app.errors import InputError, RunError
from app.files import atomic_write
from app.gui.message_strip import MessageStrip


def save_screenshot(window: QWidget, messages: MessageStrip, path: Path | None = None) -> bool:
    """Save a picture of the window, in the user's picture folder unless told otherwise; return whether it was."""
    if path is None:
        folder = QStandardPaths.writableLocation(QStandardPaths.StandardLocation.PicturesLocation)
        path = Path(folder or ".") / f"svwfs-{datetime.now().astimezone():%Y%m%d-%H%M%S}.png"
    is_saved = window.grab().save(str(path))
    if is_saved:
        messages.tell(f"saved {path}")
    else:
        messages.warn(f"could not save {path}")
    return is_saved


def save_bench(window: QWidget, messages: MessageStrip, bench: Bench) -> None:
    """Save a bench where the user says."""
    name, _ = QFileDialog.getSaveFileName(window, "Save the bench", "bench.toml", "Bench (*.toml)")
    if name:
        try:
            with atomic_write(Path(name)) as temporary:
                temporary.write_text(write_bench(bench), "utf-8")
        except (InputError, RunError, ValueError) as error:  # the last from settings that do not go together
            messages.warn(str(error))
        else:
            messages.tell(f"saved {name}")
