"""The menus, and the help that lists their keys and the conventions of the instrument."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import zip_longest

from PyQt6.QtCore import Qt
from PyQt6.QtGui import QKeySequence
from PyQt6.QtWidgets import QDialog, QDialogButtonBox, QLabel, QMainWindow, QMenu, QVBoxLayout, QWidget

_CONVENTIONS = """
<h3>Axes and signs</h3>
<p><b>+x</b> points to the right and <b>+y</b> down, in the camera image, in the field and in the pupil.
Rows count along y, columns along x, both from 0.</p>
<p>The wavefront is a phase in <b>radians</b>, without piston. Where it rises towards +x, the light
moves towards <b>+x</b>: displacement&nbsp;=&nbsp;(f/k)&nbsp;d&phi;/dx.</p>
<p>Displacements count from the <b>reference</b>, the frame without the sample.</p>
<h3>What is shown</h3>
<p>Each tile is the wavefront as seen from one position of the field, one square for each lenslet.
All share one colour scale. <b>RMS</b> and <b>PV</b> are taken over its valid lenslets.</p>
<p>A lenslet that could not be measured is <b>hatched</b>, and crossed out in red on the camera image:
it has no value, not the value zero.</p>
<p>Instead of the wavefront the tiles can show what follows from it: the point-spread function (<b>1</b> is the peak
without aberration, the middle is the Strehl ratio), what was measured, fitted, and their difference, and the
standard deviation. A click or the arrow keys select the view whose modulation transfer is plotted.</p>
<p>Arrows show the displacement of each lenslet's light averaged over the field, magnified as written.</p>
"""


_HELP_WIDTH = 560

Entries = tuple[tuple[str, str, Callable[[], object]], ...]  # text, key, what it does


def fill_menus(window: QMainWindow, menus: Mapping[str, Entries]) -> None:
    """Give the window its menus, and the help that lists them."""
    bar = window.menuBar()
    if bar is None:
        return
    for title, entries in menus.items():
        _fill(bar.addMenu(title), entries)
    _fill(bar.addMenu("&Help"), (("Shortcuts and conventions", "F1", lambda: _show_help(window, menus)),))


def _fill(menu: QMenu | None, entries: Entries) -> None:
    if menu is None:
        return
    for text, key, act in entries:
        action = menu.addAction(text)
        if action is not None:
            action.setShortcut(QKeySequence(key))
            action.triggered.connect(lambda _=False, act=act: act())


def _show_help(parent: QWidget, menus: Mapping[str, Entries]) -> None:
    """Show the help beside the running measurement."""
    dialog = QDialog(parent)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    dialog.setObjectName("help")
    dialog.setWindowTitle("Shortcuts and conventions")
    cells = [f"<td><b>{key}</b>&nbsp; {name}&nbsp; &nbsp;</td>" for menu in menus.values() for name, key, _ in menu]
    half = -(-len(cells) // 2)
    rows = (f"<tr>{''.join(pair)}</tr>" for pair in zip_longest(cells[:half], cells[half:], fillvalue=""))
    text = QLabel(f"<h3>Keys</h3><table>{''.join(rows)}</table>{_CONVENTIONS}")
    text.setWordWrap(True)
    text.setFixedSize(_HELP_WIDTH, text.heightForWidth(_HELP_WIDTH))
    buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
    buttons.rejected.connect(dialog.close)
    layout = QVBoxLayout(dialog)
    layout.addWidget(text)
    layout.addWidget(buttons)
    dialog.show()
