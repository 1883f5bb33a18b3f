"""Help: keys, conventions, message log, documentation, citation, versions, and a tour of the window."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path

from PyQt6.QtCore import QT_VERSION_STR, QEvent, QObject, QPoint, QRect, QSize, Qt, QUrl
from PyQt6.QtGui import QCloseEvent, QFontDatabase, QImage, QKeyEvent, QTextCursor, QTextDocument, QTextOption
from PyQt6.QtWidgets import QDialog, QFrame, QTextBrowser, QWidget

import app
from app.gui.panels.panel import Entries
from app.gui.shell.messages import MessageStrip
from app.gui.widgets.buttons import Button, close_button, keeps_key
from app.gui.widgets.copies import copy_text
from app.gui.widgets.layouts import fill_dialog, row, within_screen
from app.gui.widgets.texts import label
from app.run_facts import machine_facts, versions

_CONVENTIONS = """
<h3>Axes and signs</h3>
<p><b>+x</b> points to the right and <b>+y</b> down, in the camera image, in the field and in the pupil.
Rows count along y, columns along x, both from 0.</p>
<p>The wavefront is a phase in <b>radians</b>, without piston. Where it rises towards +x, the light
moves towards <b>+x</b>: displacement&nbsp;=&nbsp;(f/k)&nbsp;d&phi;/dx.</p>
<p>Displacements count from the <b>reference</b>, the frame without the sample.</p>
<h3>Display</h3>
<p>Each tile is the wavefront of one field position, one square for each lenslet.
All tiles share one colour scale. <b>RMS</b> and <b>PV</b> count the valid lenslets.</p>
<p>A lenslet that could not be measured is <b>hatched</b>, and crossed out in red on the camera image.</p>
<p>The tiles can also show the point-spread function (<b>1</b> is the peak without aberration, the value in the
middle is the Strehl ratio), the measured and the fitted wavefront, their difference, and the standard deviation.
A click or the arrow keys select the view whose MTF is plotted.</p>
<p>Arrows show the displacement of each lenslet, averaged over the field and magnified as stated.</p>
"""

_WIDTH_PX, _MOST_WIDTH_PX, _LINES = 960, 2000, 46  # of the help
_AROUND_PX = 70  # beside it: margins and scroll bar
_BUBBLE_PX = 340  # width of the tour's text
PAPER = (
    'F. Feng, C. Liang, D. Chen, K. Du, R. Yang, C. Lu, S. Chen, L. Chen, L. Tao, and H. Mao, "Space-variant '
    'Shack-Hartmann wavefront sensing based on affine transformation estimation," Applied Optics (2022), '
    "doi:10.1364/AO.471225"
)
_BIBTEX = """@article{Feng2022,
  author  = {Feng, Fan and Liang, Chen and Chen, Dongdong and Du, Ke and Yang, Runjia and Lu, Chang and
             Chen, Shumin and Chen, Liangyi and Tao, Louis and Mao, Heng},
  title   = {Space-variant {Shack-Hartmann} wavefront sensing based on affine transformation estimation},
  journal = {Applied Optics},
  year    = {2022},
  doi     = {10.1364/AO.471225},
}"""
_FIRST_PAGE = "window.md"


def show_keys(parent: QWidget, menus: Mapping[str, Entries]) -> None:
    """Show the keys of all entries and the conventions, without stopping the measurement."""
    tables = [_key_table(title, entries) for title, entries in menus.items()]
    tables[0] += tables.pop()  # the help below the first, which has few keys
    most_px = within_screen(parent, QSize(_MOST_WIDTH_PX, 0)).width() - _AROUND_PX
    if _width(_side_by_side(tables), parent) > most_px:
        tables[0] += tables.pop()
    dialog, shown = TextDialog("help", "Shortcuts and conventions", parent), _side_by_side(tables)
    dialog.view.setWordWrapMode(QTextOption.WrapMode.WordWrap)  # else it breaks within words
    dialog.view.setHtml(f"{shown}{_CONVENTIONS}")
    width_px = max(min(_WIDTH_PX, most_px), _width(shown, parent)) + _AROUND_PX
    dialog.resize(within_screen(parent, QSize(width_px, _LINES * parent.fontMetrics().height())))
    dialog.show()


def _side_by_side(tables: list[str]) -> str:
    columns = "".join(f"<td>{table}</td>" for table in tables)
    return f"<table cellspacing='0'><tr>{columns}</tr></table>"


def _width(html: str, shown_in: QWidget) -> int:
    """Return the width of a text without automatic line breaks, px."""
    document = QTextDocument()
    document.setDefaultFont(shown_in.font())
    document.setHtml(html)
    return math.ceil(document.idealWidth())


def _key_table(title: str, entries: Entries) -> str:
    rows = "".join(
        f"<tr><td style='padding-right: 10px'><b>{key}</b></td>"
        f"<td style='padding-right: 24px'>{name.replace(' ', '&nbsp;')}</td></tr>"
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

    def show_page(self, page: QUrl) -> None:
        self.resize(within_screen(self, QSize(960, 720)))
        self.back.show()
        self.back.setEnabled(False)
        self.view.backwardAvailable.connect(self.back.setEnabled)
        self.show()  # the page has its width from now on
        self.view.setSource(page)


def documentation() -> Path | None:
    """Return the folder of the documentation, in the package or beside its source; None if missing."""
    package = Path(app.__file__).parent
    return next((each for each in (package / "docs", package.parent / "docs") if (each / _FIRST_PAGE).is_file()), None)


def show_log(parent: QWidget, messages: MessageStrip) -> None:
    """Show all messages, also those that come from now on."""
    dialog = TextDialog("log", "Message log", parent)
    dialog.view.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))

    def update() -> None:
        dialog.view.setPlainText(messages.log or f"No message so far. Shown now: {messages.text.text()}")
        dialog.view.moveCursor(QTextCursor.MoveOperation.End)

    update()
    messages.logged.connect(update)
    dialog.finished.connect(lambda _: messages.logged.disconnect(update))
    dialog.show()


def show_documentation(parent: QWidget, warn: Callable[[str], object]) -> None:
    """Show the documentation, or warn that it is missing."""
    if (folder := documentation()) is None:
        warn("the documentation is not installed: it is in the folder docs of the source")
    else:
        TextDialog("documentation", "Documentation", parent).show_page(QUrl.fromLocalFile(str(folder / _FIRST_PAGE)))


def show_citation(parent: QWidget) -> None:
    """Show what to cite."""
    software = f"svwfs {versions()['svwfs']}, a live instrument for space-variant wavefront sensing"
    text = f"The method:\n\n{PAPER}\n\n{_BIBTEX}\n\nThe software:\n\n{software}\n"
    TextDialog("citation", "How to cite", parent, text).show()


def show_about(parent: QWidget, present: Mapping[str, str]) -> None:
    """Show versions, the computer, and `present` facts by name."""
    installed = versions("zarr")
    facts = {"Version": installed.pop("svwfs", "not installed"), "Licence": "GPL-3.0-or-later", **present}
    machine = {name.capitalize(): str(fact) for name, fact in machine_facts().items()}
    libraries = {"Qt": QT_VERSION_STR, **installed}
    text = "\n".join(f"{name}: {fact}" for name, fact in {**facts, **machine, **libraries}.items())
    about = f"svwfs: a live instrument for space-variant Shack-Hartmann wavefront sensing\n\n{text}\n"
    TextDialog("about", "About svwfs", parent, about).show()


def help_entries(
    window: QWidget,
    menus: Mapping[str, Entries],
    messages: MessageStrip,
    show_tour: Callable[[], object],
    facts: Callable[[], Mapping[str, str]],
) -> Entries:
    """Return the entries of the help menu, which is itself among the `menus`; "About" shows the `facts`."""
    return (
        ("Shortcuts and conventions", "F1", lambda: show_keys(window, menus)),
        ("Message log", "Ctrl+L", lambda: show_log(window, messages)),
        ("Documentation", "Shift+F1", lambda: show_documentation(window, messages.warn)),
        ("Tour of the window", "", show_tour),
        ("How to cite", "", lambda: show_citation(window)),
        ("About svwfs", "", lambda: show_about(window, facts())),
    )


class Tour(QFrame):
    """A bubble that explains one outlined part after the other; the window stays usable."""

    def __init__(self, window: QWidget, steps: tuple[tuple[QWidget, str, str], ...]) -> None:
        super().__init__(window)
        self.setObjectName("tour")
        self.setProperty("role", "bubble")
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self._window, self._steps, self._index = window, steps, 0
        self._outline = QFrame(window)
        self._outline.setProperty("role", "outline")
        self._outline.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.title, self.text, self.count = label("", "title"), label("", is_wrapped=True), label("", "dim")
        self.text.setFixedWidth(_BUBBLE_PX)
        self.text.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.next = Button("Next", "The next part", self._advance)
        self.end = Button("End the tour", "It stays in the menu Help", self.close)
        buttons = row((self.count, 1), self.end, self.next)
        fill_dialog(self, self.title, self.text, buttons)
        window.installEventFilter(self)

    def begin(self) -> None:
        for other in self._window.findChildren(Tour):
            if other is not self:
                other.close()
        room, wrap = QRect(0, 0, _BUBBLE_PX, 999), Qt.TextFlag.TextWordWrap
        heights = [self.text.fontMetrics().boundingRect(room, wrap, text).height() for _, _, text in self._steps]
        self.text.setFixedHeight(max(heights) + self.fontMetrics().height())
        self.show()  # from now on it has the fonts of the style sheet
        self.next.setText("Done")
        self.next.setMinimumWidth(self.next.sizeHint().width())
        self.adjustSize()
        self._show_step()

    def eventFilter(self, watched: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        """Follow the window's size, and end at Esc."""
        if isinstance(event, QKeyEvent) and event.key() == Qt.Key.Key_Escape and self.isVisible():
            if not keeps_key(event, Qt.Key.Key_Escape) and event.type() == QEvent.Type.KeyPress:
                self.close()
            return True
        if event is not None and event.type() == QEvent.Type.Resize:
            self._place()
        return super().eventFilter(watched, event)

    def closeEvent(self, event: QCloseEvent | None) -> None:  # noqa: N802 - Qt's name
        self._window.removeEventFilter(self)  # it would show the outline again until it is deleted
        self._outline.close()
        super().closeEvent(event)

    def _advance(self) -> None:
        if self._index + 1 == len(self._steps):
            self.close()  # it still receives events until it is deleted
        else:
            self._index += 1
            self._show_step()

    def _show_step(self) -> None:
        _, title, text = self._steps[self._index]
        self.title.setText(title)
        self.text.setText(text)
        self.count.setText(f"{self._index + 1} of {len(self._steps)}")
        self.next.setText("Next" if self._index + 1 < len(self._steps) else "Done")
        self._place()

    def _place(self) -> None:
        """Outline the part; the bubble stays in the middle, so that its button stays in place."""
        part = self._steps[self._index][0]
        where = QRect(part.mapTo(self._window, QPoint(0, 0)), part.size())
        self._outline.setGeometry(where)
        self._outline.show()
        self.move(self._window.rect().center() - self.rect().center())
        self.raise_()
