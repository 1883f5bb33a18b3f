"""Copies of what is shown: pictures and numbers in the clipboard, and in files."""

import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path

from PyQt6.QtCore import QBuffer
from PyQt6.QtGui import QGuiApplication, QImage, QPixmap
from PyQt6.QtWidgets import QFileDialog, QMessageBox, QWidget

from app.errors import RunError
from app.files import write_csv, write_whole
from app.gui.widgets.file_work import FileWork, answer
from reconstruction.arrays import Floats


def as_table(heads: Iterable[str], rows: Iterable[Floats]) -> str:
    """Return rows (column,) as lines of tab-separated numbers below their heads, for a spreadsheet."""
    lines = ["\t".join(f"{value:.7g}" for value in row) for row in rows]
    return "\n".join(filter(None, ["\t".join(heads), *lines]))


def save_numbers(parent: QWidget, table: str, proposed: str) -> None:
    """Ask for a file and write lines of tab-separated numbers into it, as CSV."""
    path = ask_file(parent, "Save the numbers", proposed, "Table (*.csv)")
    if path is not None:
        rows = [line.split("\t") for line in table.splitlines()]
        work = FileWork(parent, lambda problem: QMessageBox.warning(parent, "svwfs", problem))
        work.run(partial(write_csv, path, rows[0], rows[1:]), lambda _: work.deleteLater(), writes=str(path))


def copy_text(text: str) -> None:
    """Put a text into the clipboard."""
    if (clipboard := QGuiApplication.clipboard()) is not None:
        clipboard.setText(text)


def copy_picture(widget: QWidget) -> None:
    """Put a picture of a widget into the clipboard."""
    if (clipboard := QGuiApplication.clipboard()) is not None:
        clipboard.setPixmap(widget.grab())


def ask_file(parent: QWidget, title: str, proposed: str, kinds: str, *also: str) -> Path | None:
    """Ask for the name of a file to write, and whether existing files may be replaced; None if the user refuses.

    Without a suffix, the name gets that of the proposed one; `also` are suffixes of files that are written with it.
    """
    unasked = QFileDialog.Option.DontConfirmOverwrite  # Qt would ask about the name without its suffix
    name, _ = QFileDialog.getSaveFileName(parent, title, proposed, kinds, "", unasked)
    if not name:
        return None
    path, suffix = Path(name), Path(proposed).suffix
    if f"*{path.suffix.lower()}" not in re.split(r"[ ()]", kinds):
        if path.suffix.strip(".0123456789"):  # of another kind; ".5" ends a number
            QMessageBox.warning(parent, "svwfs", f"{path.name}: the name must end with {suffix}")
            return None
        path = path.with_name(f"{path.name}{suffix}")
    existing = [one.name for one in (path, *map(path.with_suffix, also)) if answer(one.exists, otherwise=True)]
    question = f"{' and '.join(existing)} exist{'s' * (len(existing) == 1)} already. Replace?"
    yes, no = QMessageBox.StandardButton.Yes, QMessageBox.StandardButton.Cancel
    return path if not existing or QMessageBox.question(parent, "svwfs", question, yes | no, no) == yes else None


def write_picture(path: Path, picture: QPixmap | QImage) -> None:
    """Write a picture in the format that its suffix names; `RunError` if that is impossible."""
    encoded = QBuffer()  # Qt does not notice a full disk
    encoded.open(QBuffer.OpenModeFlag.WriteOnly)
    if not picture.save(encoded, path.suffix.lstrip(".") or "png"):
        raise RunError(f"{path} cannot be written: give a name that ends in .png or .jpg")
    write_whole(path, encoded.data().data())
