"""Layout of the main window: panels in docks, bars and messages below."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from PyQt6.QtCore import QSize
from PyQt6.QtWidgets import QWidget

from app.gui.file_dialogs import export_history
from app.gui.panel_docks import Dock, PanelDocks
from app.gui.widgets import column

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow

WINDOW_SIZE = QSize(1440, 900)  # unless the screen is smaller
_MIN_WIDTH = 900  # px; captions and plots need it


def lay_out(window: MainWindow) -> PanelDocks:
    """Place the panels of a window that has them already; return their docks."""
    window.setWindowTitle("svwfs")
    window.resize(WINDOW_SIZE)
    below = QWidget()
    column(window.replay, window.messages, window.status_line, spacing=4, parent=below)
    if (status_bar := window.statusBar()) is not None:
        status_bar.setSizeGripEnabled(False)
        status_bar.addPermanentWidget(below, 1)
        status_bar.setMinimumWidth(_MIN_WIDTH)  # the controls may need more
    docks = PanelDocks(
        window,
        Dock("Camera", window.camera_panel, window.camera_panel.header),
        Dock("Wavefronts", window.wavefront_panel, window.wavefront_panel.header),
        window.tabs.panels,
        Dock("Controls", window.controls, is_strip=True),
        window.recording_bar,
    )
    window.tabs.panel_requested.connect(docks.show_panel)
    for by in (window.camera_panel.picker, window.tabs.lenslet):
        by.exclusion_requested.connect(partial(_exclude, window))
    window.camera_panel.levels_changed.connect(window.tabs.histogram.show_levels)
    window.tabs.histogram.levels_chosen.connect(window.camera_panel.use_levels)
    window.tabs.history.export_requested.connect(partial(export_history, window))
    if (bar := window.menuBar()) is not None:
        bar.setNativeMenuBar(False)  # a native one has no corner
        bar.setCornerWidget(window.recording_panel)
    return docks


def _exclude(window: MainWindow, row: int, column: int) -> None:
    window.controller.settings.change(("lenslet", (row, column)))
