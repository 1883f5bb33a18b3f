"""All panels of the window, a new one needs its line here; their default layout, and what a user may change in it."""

from functools import partial
from typing import NamedTuple, get_type_hints

from PyQt6.QtCore import QByteArray, QSize, Qt
from PyQt6.QtGui import QContextMenuEvent
from PyQt6.QtWidgets import QDockWidget, QMainWindow, QSizePolicy, QTabBar, QTabWidget, QToolButton, QWidget

from app.gui.panels.camera import CameraPanel
from app.gui.panels.coefficients import CoefficientsPanel
from app.gui.panels.controls import ControlsPanel
from app.gui.panels.histogram import HistogramPanel
from app.gui.panels.history import HistoryPanel
from app.gui.panels.layers import LayersPanel
from app.gui.panels.lenslet import LensletPanel
from app.gui.panels.panel import DisplayState, MoreEntries, Panel
from app.gui.panels.quality import QualityPanel
from app.gui.panels.wavefronts import WavefrontPanel
from app.gui.shell.menus import listing_menu
from app.gui.widgets.buttons import Button
from app.gui.widgets.copies import copy_picture, copy_text, save_numbers
from app.gui.widgets.layouts import column, row
from app.gui.widgets.texts import label
from app.gui.widgets.timers import timer

_OPTIONS = QMainWindow.DockOption
_MARGIN_PX = 8  # between the contents of a panel and its edge
_AROUND_PX, _CONTROLS_PX = 70, 300  # height of all else than the maps, without the width of their scale; width
_UPPER = 0.595  # most of the height for camera and controls
_LOW_PX = 600  # on lower screens the camera is one of the tabs
_SIDES = {Qt.DockWidgetArea.LeftDockWidgetArea, Qt.DockWidgetArea.RightDockWidgetArea}


class Panels(NamedTuple):
    """The panels in the order of tabs and menus."""

    camera: CameraPanel
    controls: ControlsPanel
    wavefronts: WavefrontPanel
    quality: QualityPanel
    coefficients: CoefficientsPanel
    history: HistoryPanel
    histogram: HistogramPanel
    lenslet: LensletPanel
    layers: LayersPanel


def make_panels(shown: DisplayState) -> Panels:
    """Make all panels, and connect those that follow each other."""
    made = Panels(*(kind(shown) for kind in get_type_hints(Panels).values()))
    made.camera.counts_for = made.controls, made.histogram
    made.camera.lenslet_clicked.connect(made.lenslet.inspect)
    made.coefficients.pinned.connect(made.history.pin)
    return made


class Dock(QDockWidget):
    """A panel that can be moved, floated and closed; a header moves it, among tabs the tab."""

    def __init__(self, panel: Panel) -> None:
        """Put a panel below its header, or its title, with its menu at the top right."""
        super().__init__(panel.title)
        self.setObjectName(panel.title)  # its key in a saved state
        self.panel = panel
        self.more = Button("\N{HORIZONTAL ELLIPSIS}", f"More about {panel.title}: save, copy, float, close")
        self.more.setProperty("role", "more")
        self.more.setAccessibleName(f"More about {panel.title}")
        self.more.setMenu(listing_menu(self, self._entries))
        body, header = QWidget(), (panel.header or label(panel.title, "title"), 1)
        beside = (column(self.more, (QWidget(), 1)),) if panel.is_tab else ()
        row((panel, 1), *beside, spacing=2, parent=body).setContentsMargins(_MARGIN_PX, 2, 2 * bool(beside), 4)
        self.setWidget(body)
        self.bar = _TitleBar(self)
        shown = (header,) if panel.is_tab else (header, self.more)
        row(*shown, spacing=2, parent=self.bar).setContentsMargins(_MARGIN_PX, 4, 2, 0)
        self.setTitleBarWidget(self.bar)
        policy = panel.sizePolicy()
        policy.setRetainSizeWhenHidden(True)
        panel.setSizePolicy(policy)
        panel.front_requested.connect(self.show)
        panel.front_requested.connect(self.raise_)
        self.visibilityChanged.connect(panel.setVisible)  # Qt calls a panel behind another tab visible
        # From behind a tab it floats without that signal.
        self.topLevelChanged.connect(lambda floats: panel.setVisible(floats or panel.isVisible()))

    def _entries(self) -> MoreEntries:
        return (
            *self.panel.more_entries(),
            ("Save the numbers as CSV…", self._save_numbers),
            ("Copy the numbers", lambda: copy_text(self.panel.table())),
            ("Copy the picture", partial(copy_picture, self.panel)),
            ("Float as a window, or dock again", lambda: self.setFloating(not self.isFloating())),
            ("Close (View > Panels opens it)", self.close),
        )

    def contextMenuEvent(self, event: QContextMenuEvent | None) -> None:  # noqa: N802 - Qt's name
        """Open the menu of the panel by a right click."""
        if event is not None and (menu := self.more.menu()) is not None:
            menu.popup(event.globalPos())

    def _save_numbers(self) -> None:
        save_numbers(self.panel, self.panel.table(), self.panel.shown.proposed(f"{self.panel.title.lower()}.csv"))


class _TitleBar(QWidget):
    """A header, which takes no space while it is compact."""

    _is_compact = False

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        return QSize(0, 0) if self._is_compact else super().sizeHint()

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        return QSize(0, 0) if self._is_compact else super().minimumSizeHint()

    def show_compact(self, *, is_compact: bool) -> None:
        if is_compact != self._is_compact:
            self._is_compact = is_compact
            self.setVisible(not is_compact)
            self.updateGeometry()


def restore_docks(window: QMainWindow, state: QByteArray, version: int = 0) -> bool:
    """Restore a state of the docks if it fits; Qt would leave the tab bars of the state before where they were."""
    before = window.findChildren(QTabBar, options=Qt.FindChildOption.FindDirectChildrenOnly)
    is_restored = window.restoreState(state, version)
    for bar in before if is_restored else ():
        bar.hide()
    return is_restored


class PanelDocks:
    """The docks of a window."""

    def __init__(self, window: QMainWindow, panels: Panels, bar: QWidget) -> None:
        """Dock all panels in the default layout, with the `bar` above the controls."""
        self._window = window
        self.docks = tuple(map(Dock, panels))
        self._tabs = [dock for dock in self.docks if dock.panel.is_tab]
        self._fixed = [dock for dock in self.docks if not dock.panel.is_tab]
        window.setDockOptions(_OPTIONS.AllowNestedDocks | _OPTIONS.AllowTabbedDocks | _OPTIONS.GroupedDragging)
        window.setTabPosition(Qt.DockWidgetArea.AllDockWidgetAreas, QTabWidget.TabPosition.North)
        self.settle = timer(window, 0, self._arrange, is_single=True)  # after all the signals of a change
        self._middle = QWidget()
        column((QWidget(), 1), bar, spacing=0, parent=self._middle)
        window.setCentralWidget(self._middle)
        for dock in self.docks:
            for changed in (dock.visibilityChanged, dock.topLevelChanged, dock.dockLocationChanged):
                changed.connect(lambda *_: self.settle.start())
        camera, controls, wavefronts = self._fixed
        window.addDockWidget(Qt.DockWidgetArea.TopDockWidgetArea, camera)
        window.splitDockWidget(camera, wavefronts, Qt.Orientation.Horizontal)
        window.splitDockWidget(camera, self._tabs[0], Qt.Orientation.Vertical)
        window.splitDockWidget(camera, controls, Qt.Orientation.Horizontal)
        for before, dock in zip(self._tabs, self._tabs[1:], strict=False):
            window.tabifyDockWidget(before, dock)
        self._default = window.saveState()
        self.restore_default()

    def restore_default(self) -> None:
        """Camera and controls above the tabs, wavefronts beside them; on a low screen the camera is one of the tabs."""
        window, first, (camera, controls, wavefronts) = self._window, self._tabs[0], self._fixed
        restore_docks(window, self._default)
        first.raise_()
        screen = window.screen()
        if screen is not None and screen.availableGeometry().height() < _LOW_PX:
            for dock in self._tabs:
                window.tabifyDockWidget(camera, dock)
            camera.raise_()
        left = max(window.width() - window.height() + _AROUND_PX, window.width() // 2)  # the wavefronts are a square
        window.resizeDocks([first, wavefronts], [left, window.width() - left], Qt.Orientation.Horizontal)
        window.resizeDocks([camera, controls], [max(left - _CONTROLS_PX, 1), _CONTROLS_PX], Qt.Orientation.Horizontal)
        # The camera has half of the height at least; with large texts the controls scroll, so that plots have space.
        room = window.height() - _AROUND_PX
        needed = controls.sizeHint().height() + 3 * window.fontMetrics().height()
        upper = min(max(needed, room // 2), round(_UPPER * room))
        window.resizeDocks([camera, first], [upper, room - upper], Qt.Orientation.Vertical)
        self._arrange()

    def float_panels(self, *panels: QWidget) -> None:
        """Make each of these panels a window of its own, so that all are visible."""
        for dock in self.docks:
            if dock.panel in panels:
                dock.setFloating(True)
                dock.show()

    def _arrange(self) -> None:
        """Show headers of panels without a tab, and dress the tabs, which Qt makes anew."""
        docked = [dock for dock in self.docks if not (dock.isHidden() or dock.isFloating())]
        is_beside = any(self._window.dockWidgetArea(dock) in _SIDES for dock in docked)
        needed = QSizePolicy.Policy.Preferred if is_beside or not docked else QSizePolicy.Policy.Fixed
        self._middle.setSizePolicy(QSizePolicy.Policy.Preferred, needed)  # the docks have the rest
        for dock in self.docks:
            tabs = (other for other in self._window.tabifiedDockWidgets(dock) if not other.isHidden())
            dock.bar.show_compact(is_compact=dock.panel.header is None and not dock.isFloating() and any(tabs))
        for bar in self._window.findChildren(QTabBar, options=Qt.FindChildOption.FindDirectChildrenOnly):
            bar.setDrawBase(False)
            bar.setAccessibleName("Panels")
            bar.setToolTip("Drag a tab out to move or to float its panel")
            for arrow in bar.findChildren(QToolButton):
                arrow.setFocusPolicy(Qt.FocusPolicy.NoFocus)
