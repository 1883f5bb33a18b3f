"""A dialog with a text that can be copied; the measurement continues beside it."""

from PyQt6.QtCore import QSize, Qt, QUrl
from PyQt6.QtGui import QFontDatabase, QGuiApplication, QImage, QTextCursor, QTextDocument
from PyQt6.QtWidgets import QDialog, QTextBrowser, QWidget

from app.gui.widgets import button, column, row

_SIZE = QSize(760, 480)
_PAGE_SIZE = QSize(960, 720)


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

    def __init__(self, title: str, parent: QWidget, *, is_fixed_width: bool = False) -> None:
        super().__init__(parent)
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.setWindowTitle(title)
        self.view = _Page()
        self.view.setOpenExternalLinks(True)
        if is_fixed_width:
            self.view.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
        self.back = button("Back", "The page before (Alt+Left)", self.view.backward)
        self.back.hide()
        self.copy = button("Copy", "Copy the whole text", self._copy)
        close = button("Close", "Close (Esc)", self.close)
        buttons = row(self.back, spacing=8)
        buttons.addStretch()
        for each in (self.copy, close):
            buttons.addWidget(each)
        column((self.view, 1), buttons, spacing=8, parent=self).setContentsMargins(11, 11, 11, 11)
        self.resize(self._within_screen(_SIZE))

    def show_text(self, text: str, *, is_html: bool = False) -> None:
        """Show a text from its beginning."""
        if is_html:
            self.view.setHtml(text)
        else:
            self.view.setPlainText(text)
        self.show()

    def show_log(self, text: str) -> None:
        """Show a growing text from its end."""
        self.view.setPlainText(text)
        self.view.moveCursor(QTextCursor.MoveOperation.End)

    def show_page(self, page: QUrl) -> None:
        """Show a Markdown file and open its links in the same place."""
        self.resize(self._within_screen(_PAGE_SIZE))
        self.back.show()
        self.back.setEnabled(False)
        self.view.backwardAvailable.connect(self.back.setEnabled)
        self.show()  # the page has its width from now on
        self.view.setSource(page)

    def _copy(self) -> None:
        if (clipboard := QGuiApplication.clipboard()) is not None:
            clipboard.setText(self.view.toPlainText())

    def _within_screen(self, size: QSize) -> QSize:
        screen = self.screen()
        return size if screen is None else size.boundedTo(screen.availableGeometry().size() * 0.9)
