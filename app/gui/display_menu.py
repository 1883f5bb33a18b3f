"""Menu of the display options."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

from PyQt6.QtCore import pyqtSignal
from PyQt6.QtGui import QAction, QActionGroup
from PyQt6.QtWidgets import QMenu, QWidget

from app.results.shown_wavefront import MOST_AVERAGED, MOST_VIEWS, DisplayOptions, Unit

_AVERAGES = (1, 2, 5, 10, 20, 50, MOST_AVERAGED)


class DisplayMenu(QMenu):
    """Chooses what is removed from the shown wavefront, its unit and its views."""

    changed = pyqtSignal()
    enlarge_requested = pyqtSignal()
    store_requested = pyqtSignal()
    file_requested = pyqtSignal()

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__("&Display", parent)
        self.setToolTipsVisible(True)
        self.options, self.unit = DisplayOptions(), Unit.RAD
        self.enlarge = self._add("Enlarge the selected view", self.enlarge_requested.emit, "Also by a double click")
        self.addSeparator()
        self.tilt = self._add_toggle("Remove tilt", "without_tilt")
        self.defocus = self._add_toggle("Remove defocus", "without_defocus")
        self.addSeparator()
        self.store = self._add(
            "Subtract the present wavefront", self.store_requested.emit, "The mean, if frames are averaged"
        )
        self.file = self._add(
            "Subtract a wavefront from a file ...", self.file_requested.emit, "Results of svwfs with coefficients"
        )
        self.clear_stored = self._add("Subtract nothing", lambda: self.change(stored=None), "Show the whole wavefront")
        self.addSeparator()
        self.averages = self._add_choices(
            "Average", [(f"{n} frames" if n > 1 else "Off", n) for n in _AVERAGES], self._choose_average
        )
        self.units = self._add_choices("Unit", [(unit.value, unit) for unit in Unit], self._choose_unit)
        grids = [
            ("As in the bench", None),
            *((f"{n} \N{MULTIPLICATION SIGN} {n}", n) for n in range(1, MOST_VIEWS + 1)),
        ]
        self.grids = self._add_choices("Views", grids, lambda count: self.change(views=count))
        self._show()

    def change(self, **changes: Any) -> None:
        """Change display options."""
        self.options = replace(self.options, **changes)
        self._show()
        self.changed.emit()

    def _show(self) -> None:
        self.clear_stored.setEnabled(self.options.stored is not None)

    def _choose_average(self, count: int) -> None:
        self.change(averaged=count)

    def _choose_unit(self, unit: Unit) -> None:
        self.unit = unit
        self.changed.emit()

    def _add(self, text: str, act: Callable[[], object], tip: str) -> QAction:
        action = QAction(text, self)
        action.setToolTip(tip)
        action.triggered.connect(lambda _=False: act())
        self.addAction(action)
        return action

    def _add_toggle(self, text: str, option: str) -> QAction:
        action = QAction(text, self)
        action.setCheckable(True)
        action.toggled.connect(lambda on: self.change(**{option: on}))
        self.addAction(action)
        return action

    def _add_choices(
        self, title: str, choices: Iterable[tuple[str, Any]], choose: Callable[[Any], None]
    ) -> tuple[QAction, ...]:
        menu = QMenu(title, self)
        self.addMenu(menu)
        group = QActionGroup(menu)
        for text, value in choices:
            action = QAction(text, menu)
            action.setCheckable(True)
            action.triggered.connect(partial(lambda value, _=False: choose(value), value))
            group.addAction(action)
            menu.addAction(action)
        actions = tuple(group.actions())
        actions[0].setChecked(True)
        return actions
