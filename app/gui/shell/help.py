"""Help: keys, conventions, message log, documentation, citation, and versions."""

from collections.abc import Callable, Mapping
from pathlib import Path

from PyQt6.QtCore import QT_VERSION_STR, QSize, Qt, QUrl
from PyQt6.QtGui import QFontDatabase, QImage, QTextCursor, QTextDocument, QTextOption
from PyQt6.QtWidgets import QDialog, QTextBrowser, QWidget

from app.documentation import FIRST_PAGE, TROUBLES, documentation, entries, entry_of
from app.gui.panels.panel import Entries
from app.gui.shell.messages import MessageStrip
from app.gui.widgets.buttons import Button, close_button
from app.gui.widgets.copies import copy_text
from app.gui.widgets.layouts import fill_dialog, row, within_screen
from app.run_facts import machine_facts, versions

_CONVENTIONS, _CITATION = (Path(__file__).parents[1] / name for name in ("conventions.html", "citation.txt"))
_SIZE_LINES = QSize(60, 46)  # of the help, in heights of a line


def _key_table(title: str, entries: Entries) -> str:
    rows = "".join(
        f"<tr><td style='padding-right: 10px'><b>{key}</b></td>"
        f"<td style='padding-right: 24px'>{name.rstrip('…').replace(' ', '&nbsp;')}</td></tr>"
        for name, key, _ in filter(None, entries)
        if key
    )
    return f"<h3>{title.replace('&', '')}</h3><table cellspacing='0'>{rows}</table>"


class _Page(QTextBrowser):
    """A page whose pictures are no wider than it was when they were loaded."""

    def loadResource(self, kind: int, name: QUrl) -> object:  # noqa: N802 - Qt's name
        """Return a resource; a wide picture is scaled down."""
        resource, bar, document = super().loadResource(kind, name), self.verticalScrollBar(), self.document()
        if kind != QTextDocument.ResourceType.ImageResource.value or bar is None or document is None:
            return resource
        picture = QImage(self.source().resolved(name).toLocalFile())
        width = self.contentsRect().width() - bar.sizeHint().width() - round(2 * document.documentMargin())
        if not 0 < width < picture.width():
            return resource
        return picture.scaledToWidth(width, Qt.TransformationMode.SmoothTransformation)


class TextDialog(QDialog):
    """Shows a text, or a Markdown page whose links to other pages work."""

    def __init__(self, name: str, title: str, parent: QWidget, text: str = "") -> None:
        super().__init__(parent)
        self.setObjectName(name)
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.setWindowTitle(title)
        self.view = _Page()
        self.view.setOpenExternalLinks(True)
        self.view.setPlainText(text)
        self.back = Button("Back", "The page before (Alt+Left)", self.view.backward)
        self.back.hide()
        self.copy = Button("Copy", "Copy the whole text", lambda: copy_text(self.view.toPlainText()))
        fill_dialog(self, (self.view, 1), row(self.back, (QWidget(), 1), self.copy, close_button(self), spacing=8))
        self.resize(within_screen(self, QSize(760, 480)))

    def show_page(self, page: Path, heading: str = "") -> None:
        """Show a page, from a heading on."""
        self.resize(within_screen(self, QSize(960, 720)))
        self.back.show()
        self.back.setEnabled(False)
        self.view.backwardAvailable.connect(self.back.setEnabled)
        self.show()  # the page has its width from now on
        self.view.setSource(QUrl.fromLocalFile(str(page)))
        if heading and self.view.find(heading) and (bar := self.view.verticalScrollBar()) is not None:
            bar.setValue(bar.value() + self.view.cursorRect().top())


def _show_log(messages: MessageStrip) -> None:
    if (window := messages.window()) is None:  # it is not retained: a button would keep it after its end
        return
    dialog = TextDialog("log", "Message log", window)
    dialog.view.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))

    def update() -> None:
        dialog.view.setPlainText(messages.log or f"No message so far. Shown now: {messages.text.text()}")
        dialog.view.moveCursor(QTextCursor.MoveOperation.End)

    update()
    messages.logged.connect(update)
    dialog.finished.connect(lambda _: messages.logged.disconnect(update))
    dialog.show()


def _show_documentation(messages: MessageStrip, page: str = FIRST_PAGE, anchor: str = "") -> None:
    if (folder := documentation()) is None:
        messages.warn("the documentation is not installed: it is in the folder docs of the source")
    elif (window := messages.window()) is not None:  # as above
        heading = entries().get(anchor, "").partition("\n")[0]
        TextDialog("documentation", "Documentation", window).show_page(folder / page, heading)


def help_entries(
    window: QWidget, menus: Mapping[str, Entries], messages: MessageStrip, facts: Callable[[], Mapping[str, str]]
) -> Entries:
    """Return the entries of the help menu, which is itself among the `menus`; "About" shows the `facts`."""

    def show_keys() -> None:
        tables = [_key_table(title, entries) for title, entries in menus.items()]
        columns = "".join(f"<td>{''.join(tables[at::2])}</td>" for at in range(2))
        dialog = TextDialog("help", "Shortcuts and conventions", window)
        dialog.view.setWordWrapMode(QTextOption.WrapMode.WordWrap)  # else it breaks within words
        dialog.view.setHtml(f"<table cellspacing='0'><tr>{columns}</tr></table>{_CONVENTIONS.read_text('utf-8')}")
        dialog.resize(within_screen(window, _SIZE_LINES * window.fontMetrics().height()))
        dialog.show()

    messages.show_log.clicked.connect(lambda: _show_log(messages))
    messages.explain.clicked.connect(lambda: _show_documentation(messages, TROUBLES, entry_of(messages.text.text())))

    def show_about() -> None:
        installed = versions("zarr")
        present = {"Version": installed.pop("svwfs", "not installed"), "Licence": "GPL-3.0-or-later", **facts()}
        machine = {name.capitalize(): str(fact) for name, fact in machine_facts().items()}
        about = {**present, **machine, "Qt": QT_VERSION_STR, **installed}
        text = "\n".join(f"{name}: {fact}" for name, fact in about.items())
        cite = _CITATION.read_text("utf-8").replace("VERSION", versions()["svwfs"])
        text = f"svwfs: a live instrument for space-variant Shack-Hartmann wavefront sensing\n\n{text}\n\n{cite}"
        TextDialog("about", "About svwfs", window, text).show()

    return (
        ("Shortcuts and conventions…", "F1", show_keys),
        ("Message log…", "Ctrl+L", messages.show_log),
        ("Documentation…", "Shift+F1", lambda: _show_documentation(messages)),
        ("About svwfs…", "", show_about),
    )
