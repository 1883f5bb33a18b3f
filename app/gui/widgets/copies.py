"""Copies of what is shown: a context menu for the clipboard, and picture files."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from PyQt6.QtCore import QBuffer, QPoint, Qt
from PyQt6.QtGui import QGuiApplication, QImage, QPixmap
from PyQt6.QtWidgets import QFileDialog, QMenu, QWidget

from app.errors import RunError
from app.files import write_whole
from reconstruction.arrays import Floats


def add_copy_menu(
    widget: QWidget, numbers: Callable[[QPoint], str], fill: Callable[[QMenu, QPoint], object] = lambda *_: None
) -> None:
    """Open a menu at a right click: `numbers` returns a text for a position, `fill` adds entries."""

    def show(at: QPoint) -> None:
        menu = QMenu(widget)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        fill(menu, at)
        menu.addAction("Copy picture", partial(_copy_picture, widget))
        if text := numbers(at):
            menu.addAction("Copy numbers", partial(copy_text, text))
        menu.popup(widget.mapToGlobal(at))

    widget.setContextMenuPolicy(Qt.ContextMenuPolicy.CustomContextMenu)
    widget.customContextMenuRequested.connect(show)


def as_table(heads: Iterable[str], rows: Iterable[Floats]) -> str:
    """Return rows (column,) as lines of tab-separated numbers below their heads, for a spreadsheet."""
    lines = ["\t".join(f"{value:.7g}" for value in row) for row in rows]
    return "\n".join(filter(None, ["\t".join(heads), *lines]))


def copy_text(text: str) -> None:
    """Put a text into the clipboard."""
    if (clipboard := QGuiApplication.clipboard()) is not None:
        clipboard.setText(text)


def _copy_picture(widget: QWidget) -> None:
    if (clipboard := QGuiApplication.clipboard()) is not None:
        clipboard.setPixmap(widget.grab())


def ask_file(parent: QWidget, title: str, proposed: str, kinds: str) -> Path | None:
    """Ask for the name of a file to write; None if the user does not want to."""
    name, _ = QFileDialog.getSaveFileName(parent, title, proposed, kinds)
    return Path(name) if name else None


def write_picture(path: Path, picture: QPixmap | QImage) -> None:
    """Write a picture in the format that its suffix names; `RunError` if that is impossible."""
    encoded = QBuffer()  # Qt does not notice a full disk
    encoded.open(QBuffer.OpenModeFlag.WriteOnly)
    if not picture.save(encoded, path.suffix.lstrip(".") or "png"):
        raise RunError(f"{path} cannot be written: give a name that ends in .png or .jpg")
    write_whole(path, encoded.data().data())
