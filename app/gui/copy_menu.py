"""Context menu of a panel: copies its picture and its numbers."""

from collections.abc import Callable, Iterable
from functools import partial

from PyQt6.QtCore import QPoint, Qt
from PyQt6.QtGui import QGuiApplication
from PyQt6.QtWidgets import QMenu, QWidget

from reconstruction.arrays import Floats


def add_copy_menu(
    widget: QWidget, numbers: Callable[[QPoint], str], fill: Callable[[QMenu, QPoint], object] = lambda *_: None
) -> None:
    """Open a menu at a right click; `numbers` returns a text for a position, and `fill` adds entries above."""

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
    """Return lines of tab-separated numbers below their heads, as a spreadsheet reads them."""
    lines = ["\t".join(f"{value:.7g}" for value in row) for row in rows]
    return "\n".join(filter(None, ["\t".join(heads), *lines]))


def copy_text(text: str) -> None:
    """Put a text into the clipboard."""
    if (clipboard := QGuiApplication.clipboard()) is not None:
        clipboard.setText(text)


def _copy_picture(widget: QWidget) -> None:
    if (clipboard := QGuiApplication.clipboard()) is not None:
        clipboard.setPixmap(widget.grab())
