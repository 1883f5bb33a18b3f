"""All panels of the window, a new one needs its line here; their default layout, and what a user may change in it."""

from typing import NamedTuple, get_type_hints

from PyQt6.QtCore import QSize, Qt
from PyQt6.QtWidgets import QDockWidget, QMainWindow, QMenu, QSizePolicy, QTabBar, QTabWidget, QToolButton, QWidget

from app.gui.panels.camera import CameraPanel
from app.gui.panels.coefficients import CoefficientsPanel
from app.gui.panels.controls import ControlsPanel
from app.gui.panels.corrector import CorrectorPanel
from app.gui.panels.histogram import HistogramPanel
from app.gui.panels.history import HistoryPanel
from app.gui.panels.layers import LayersPanel
from app.gui.panels.lenslet import LensletPanel
from app.gui.panels.panel import DisplayState, Panel
from app.gui.panels.quality import QualityPanel
from app.gui.panels.wavefronts import WavefrontPanel
from app.gui.widgets.buttons import Slot
from app.gui.widgets.layouts import column, row
from app.gui.widgets.texts import label
from app.gui.widgets.timers import timer

_OPTIONS = QMainWindow.DockOption
_MARGIN_PX = 8  # between the contents of a panel and its edge
_BUTTON_PX = 18
_LOW_PX = 600  # on lower screens the camera is one of the tabs
_SIDES = {Qt.DockWidgetArea.LeftDockWidgetArea, Qt.DockWidgetArea.RightDockWidgetArea}


class Panels(NamedTuple):
    """The panels in the order of tabs and menus."""

    camera: CameraPanel
    wavefronts: WavefrontPanel
    quality: QualityPanel
    coefficients: CoefficientsPanel
    history: HistoryPanel
    histogram: HistogramPanel
    lenslet: LensletPanel
    layers: LayersPanel
    corrector: CorrectorPanel
    controls: ControlsPanel


def make_panels(shown: DisplayState) -> Panels:
    """Make all panels, and connect those that follow each other."""
    made = Panels(*(kind(shown) for kind in get_type_hints(Panels).values()))
    made.camera.counts_for = made.controls, made.histogram
    made.camera.lenslet_clicked.connect(made.lenslet.inspect)
    made.histogram.levels_chosen.connect(made.camera.use_levels)
    made.coefficients.pinned.connect(made.history.pin)
    return made


class Dock(QDockWidget):
    """A panel that can be moved, floated and closed; a header moves it, among tabs the tab."""

    def __init__(self, panel: Panel) -> None:
        """Put a panel below its header, or its title; the handle of a strip stands at its left."""
        super().__init__(panel.title)
        self.setObjectName(panel.title)  # its key in a saved state
        self.panel, is_strip = panel, panel.dock_area == "strip"
        body = QWidget()
        column(panel, parent=body).setContentsMargins(*(0, 0, 0, 0) if is_strip else (_MARGIN_PX, 2, _MARGIN_PX, 4))
        if is_strip:
            self.setFeatures(self.features() | self.DockWidgetFeature.DockWidgetVerticalTitleBar)
            body.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.setWidget(body)
        self.bar = _TitleBar(self, panel.header or label("" if is_strip else panel.title, "title"), is_strip=is_strip)
        self.setTitleBarWidget(self.bar)
        policy = panel.sizePolicy()
        policy.setRetainSizeWhenHidden(True)
        panel.setSizePolicy(policy)
        panel.front_requested.connect(self.show)
        panel.front_requested.connect(self.raise_)
        self.visibilityChanged.connect(panel.setVisible)  # Qt calls a panel behind another tab visible
        # From behind a tab it floats without that signal.
        self.topLevelChanged.connect(lambda floats: panel.setVisible(floats or panel.isVisible()))


class _TitleBar(QWidget):
    """A header with two buttons: float and close."""

    def __init__(self, dock: Dock, header: QWidget, *, is_strip: bool) -> None:
        super().__init__(dock)
        self._is_compact = False
        floating = "Float as a window, or dock again"
        buttons = (
            _tool_button("\N{NORTH EAST ARROW}", floating, lambda: dock.setFloating(not dock.isFloating())),
            _tool_button("\N{MULTIPLICATION SIGN}", "Close; View > Panels opens it again", dock.close),
        )
        if is_strip:
            column(*buttons, spacing=0, parent=self).addStretch()
        else:
            row((header, 1), *buttons, spacing=2, parent=self).setContentsMargins(_MARGIN_PX, 4, 0, 4)

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        return QSize(0, 0) if self._is_compact else super().sizeHint()

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        return QSize(0, 0) if self._is_compact else super().minimumSizeHint()

    def show_compact(self, *, is_compact: bool) -> None:
        if is_compact != self._is_compact:
            self._is_compact = is_compact
            self.setVisible(not is_compact)
            self.updateGeometry()


class PanelDocks:
    """The docks of a window."""

    def __init__(self, window: QMainWindow, panels: Panels, bar: QWidget) -> None:
        """Dock all panels in the default layout, with the `bar` above the controls."""
        self._window = window
        self.docks = tuple(map(Dock, panels))
        self._tabs = [dock for dock in self.docks if dock.panel.dock_area == "tab"]
        self._closed: list[Dock] = []  # by `toggle_tabs`
        window.setDockOptions(_OPTIONS.AllowNestedDocks | _OPTIONS.AllowTabbedDocks | _OPTIONS.GroupedDragging)
        window.setTabPosition(Qt.DockWidgetArea.AllDockWidgetAreas, QTabWidget.TabPosition.North)
        self.settle = timer(window, 0, self._arrange, is_single=True)  # after all the signals of a change
        self._hint = label("All panels are closed or float: View > Restore default layout docks them", "dim")
        self._hint.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self._middle = QWidget()
        column((self._hint, 1), bar, spacing=0, parent=self._middle)
        window.setCentralWidget(self._middle)
        for dock in self.docks:
            for changed in (dock.visibilityChanged, dock.topLevelChanged, dock.dockLocationChanged):
                changed.connect(lambda *_: self.settle.start())
        left = self._at("left")
        window.addDockWidget(Qt.DockWidgetArea.TopDockWidgetArea, left)
        window.splitDockWidget(left, self._at("right"), Qt.Orientation.Horizontal)
        window.splitDockWidget(left, self._tabs[0], Qt.Orientation.Vertical)
        for before, dock in zip(self._tabs, self._tabs[1:], strict=False):
            window.tabifyDockWidget(before, dock)
        window.addDockWidget(Qt.DockWidgetArea.BottomDockWidgetArea, self._at("strip"))
        self._default = window.saveState()
        self.restore_default()

    def _at(self, dock_area: str) -> Dock:
        return next(dock for dock in self.docks if dock.panel.dock_area == dock_area)

    def restore_default(self) -> None:
        """Camera above the tabs, or among them on a low screen; wavefronts beside them, controls below; all open."""
        window, left, first = self._window, self._at("left"), self._tabs[0]
        window.restoreState(self._default)
        first.raise_()
        screen = window.screen()
        if screen is not None and screen.availableGeometry().height() < _LOW_PX:
            for dock in self._tabs:
                window.tabifyDockWidget(left, dock)
            left.raise_()
        window.resizeDocks([left, self._at("right")], [1000, 1000], Qt.Orientation.Horizontal)
        window.resizeDocks([left, first], [1000, 600], Qt.Orientation.Vertical)
        self._arrange()

    def toggle_tabs(self) -> None:
        """Close the open tabs, or open those closed last."""
        is_open = [dock for dock in self._tabs if not dock.isHidden()]
        for dock in is_open or self._closed or self._tabs:
            dock.setVisible(not is_open)
        self._closed = is_open

    def float_panels(self, *panels: QWidget) -> None:
        """Make each of these panels a window of its own, so that all are visible."""
        for dock in self.docks:
            if dock.panel in panels:
                dock.setFloating(True)
                dock.show()

    def menu(self) -> QMenu:
        made = QMenu(self._window)
        for dock in self.docks:
            made.addAction(dock.toggleViewAction())
        return made

    def _arrange(self) -> None:
        """Show headers of panels without a tab, and dress the tabs, which Qt makes anew."""
        docked = [dock for dock in self.docks if not (dock.isHidden() or dock.isFloating())]
        self._hint.setVisible(not docked)
        is_beside = any(self._window.dockWidgetArea(dock) in _SIDES for dock in docked)
        needed = QSizePolicy.Policy.Preferred if is_beside or not docked else QSizePolicy.Policy.Fixed
        self._middle.setSizePolicy(QSizePolicy.Policy.Preferred, needed)  # the docks have the rest
        for dock in self.docks:
            tabs = (other for other in self._window.tabifiedDockWidgets(dock) if not other.isHidden())
            dock.bar.show_compact(is_compact=dock.panel.header is None and not dock.isFloating() and any(tabs))
        for bar in self._window.findChildren(QTabBar, options=Qt.FindChildOption.FindDirectChildrenOnly):
            bar.setDrawBase(False)
            bar.setToolTip("Drag a tab out to move or to float its panel")
            for arrow in bar.findChildren(QToolButton):
                arrow.setFocusPolicy(Qt.FocusPolicy.NoFocus)


def _tool_button(text: str, tool_tip: str, clicked: Slot) -> QToolButton:
    made = QToolButton()
    made.setText(text)
    made.setToolTip(tool_tip)
    made.setAutoRaise(True)
    made.setFocusPolicy(Qt.FocusPolicy.NoFocus)
    made.setFixedSize(_BUTTON_PX, _BUTTON_PX)
    made.clicked.connect(clicked)
    return made
