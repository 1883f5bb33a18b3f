"""Menus, and the help that lists their keys and the conventions of the instrument."""

from collections.abc import Callable, Mapping

from PyQt6.QtCore import QSize, Qt
from PyQt6.QtGui import QAction, QKeySequence
from PyQt6.QtWidgets import (
    QAbstractButton,
    QDialog,
    QFrame,
    QLabel,
    QMainWindow,
    QMenu,
    QScrollArea,
    QVBoxLayout,
    QWidget,
)

from app.gui.widgets import button

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

_EVERYWHERE = {"L"}  # keys that work in every dialog: the light
_HELP_WIDTH = 960  # px
_HELP_OF_SCREEN = 0.9

Act = Callable[[], object] | QAbstractButton | QMenu  # a button lends its entry tick and greying
Entries = tuple[tuple[str, str, Act] | None, ...]  # text, key and action, or a separator


def fill_menus(window: QMainWindow, menus: Mapping[str, Entries], more_help: Entries = ()) -> None:
    """Fill the menu bar, and add the help that lists all keys, followed by `more_help`."""
    bar = window.menuBar()
    if bar is None:
        return
    for title, entries in menus.items():
        _fill(bar.addMenu(title), entries)
    tables = {**menus, "&Help": more_help}
    _fill(bar.addMenu("&Help"), (("Shortcuts and conventions", "F1", lambda: _show_help(window, tables)), *more_help))


def _fill(menu: QMenu | None, entries: Entries) -> None:
    if menu is None:
        return
    buttons: list[tuple[QAction, QAbstractButton]] = []
    for entry in entries:
        if entry is None:
            menu.addSeparator()
            continue
        text, key, act = entry
        if isinstance(act, QMenu):
            act.setTitle(text)
            menu.addMenu(act)
        elif (action := menu.addAction(text)) is not None:
            if isinstance(act, QAbstractButton):
                buttons.append((action, act))
                act = act.click
            action.setShortcut(QKeySequence(key))
            action.setAutoRepeat(False)  # a held key switches once
            if key in _EVERYWHERE:
                action.setShortcutContext(Qt.ShortcutContext.ApplicationShortcut)
            action.triggered.connect(lambda _=False, act=act: act())
    menu.aboutToShow.connect(lambda: _follow(buttons))
    menu.aboutToHide.connect(lambda: _enable(buttons))


def _follow(buttons: list[tuple[QAction, QAbstractButton]]) -> None:
    """Tick and grey the entries as their buttons."""
    for action, one in buttons:
        action.setEnabled(one.isEnabled() and not one.isHidden())
        action.setCheckable(one.isCheckable())
        action.setChecked(one.isChecked())


def _enable(buttons: list[tuple[QAction, QAbstractButton]]) -> None:
    """Enable the keys of a closed menu; a button refuses by itself."""
    for action, _ in buttons:
        action.setEnabled(True)


def _show_help(parent: QWidget, menus: Mapping[str, Entries]) -> None:
    """Show the help without stopping the measurement."""
    dialog = QDialog(parent)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    dialog.setObjectName("help")
    dialog.setWindowTitle("Shortcuts and conventions")
    tables = [_key_table(title, entries) for title, entries in menus.items()]
    tables[0] += tables.pop()  # the help below the first, which has few keys
    columns = "".join(f"<td>{table}</td>" for table in tables)
    text = QLabel(f"<table cellspacing='0'><tr>{columns}</tr></table>{_CONVENTIONS}")
    text.setWordWrap(True)
    width = max(_HELP_WIDTH, text.sizeHint().width())
    text.setMinimumSize(width, text.heightForWidth(width))
    text.setContentsMargins(8, 0, 8, 0)
    area = QScrollArea()
    area.setWidget(text)
    area.setFrameShape(QFrame.Shape.NoFrame)
    close = button("Close", "Close the help (Esc)", dialog.close)
    layout = QVBoxLayout(dialog)
    layout.addWidget(area)
    layout.addWidget(close, alignment=Qt.AlignmentFlag.AlignRight)
    if (screen := parent.screen()) is not None:
        room = screen.availableGeometry().size() * _HELP_OF_SCREEN
        dialog.resize(dialog.sizeHint().expandedTo(text.sizeHint() + QSize(50, 80)).boundedTo(room))
    dialog.show()


def _key_table(title: str, entries: Entries) -> str:
    rows = "".join(
        f"<tr><td style='padding-right: 10px'><b>{key}</b></td>"
        f"<td style='padding-right: 24px'>{name.replace(' ', '&nbsp;')}</td></tr>"
        for name, key, _ in filter(None, entries)
        if key
    )
    return f"<h3>{title.replace('&', '')}</h3><table cellspacing='0'>{rows}</table>"
