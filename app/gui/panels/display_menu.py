"""The menu of the display options: what is removed from the shown wavefronts, their unit, and their views."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from PyQt6.QtCore import pyqtSignal
from PyQt6.QtGui import QAction, QActionGroup
from PyQt6.QtWidgets import QMenu, QWidget

from app.results.shown_wavefront import MOST_AVERAGED, MOST_VIEWS, DisplayOptions, Unit

_AVERAGES = (1, 2, 5, 10, 20, 50, MOST_AVERAGED)


class DisplayMenu(QMenu):
    """Chooses what is removed from the shown wavefront, its unit and its views."""

    changed = pyqtSignal()

    def __init__(self, parent: QWidget) -> None:
        super().__init__("&Display", parent)
        self.setToolTipsVisible(True)
        self.options, self.unit = DisplayOptions(), Unit.RAD
        self.enlarge = self._add("Enlarge the selected view", "Also by a double click")
        self.addSeparator()
        self.tilt, self.defocus = self._add("Remove tilt"), self._add("Remove defocus")
        for action, option in ((self.tilt, "tilt"), (self.defocus, "defocus")):
            action.setObjectName(f"view/{option}")  # its state is kept between two starts
            action.setCheckable(True)
            action.toggled.connect(lambda on, option=option: self.change(**{f"without_{option}": on}))
        self.addSeparator()
        self.store = self._add("Subtract the present wavefront", "The mean, if frames are averaged")
        self.file = self._add("Subtract a wavefront from a file ...", "Results of svwfs with coefficients")
        self.clear_stored = self._add("Subtract nothing", "Show the whole wavefront")
        self.clear_stored.triggered.connect(lambda: self.change(stored=None))
        self.clear_stored.setEnabled(False)
        self.addSeparator()
        averages = [(f"{n} frames" if n > 1 else "Off", n) for n in _AVERAGES]
        self.averages = self._add_choices("Average", "average", averages, lambda count: self.change(averaged=count))
        self.units = self._add_choices("Unit", "unit", [(unit.value, unit) for unit in Unit], self._choose_unit)
        square = [(f"{n} \N{MULTIPLICATION SIGN} {n}", n) for n in range(1, MOST_VIEWS + 1)]
        grids = [("As in the bench", None), *square]
        self.grids = self._add_choices("Views", "grid", grids, lambda count: self.change(views=count))

    def change(self, **changes: Any) -> None:
        self.options = replace(self.options, **changes)
        self.clear_stored.setEnabled(self.options.stored is not None)
        self.changed.emit()

    def _choose_unit(self, unit: Unit) -> None:
        self.unit = unit
        self.changed.emit()

    def _add(self, text: str, tip: str = "") -> QAction:
        action = QAction(text, self)
        action.setToolTip(tip)
        self.addAction(action)
        return action

    def _add_choices(
        self, title: str, key: str, choices: Iterable[tuple[str, Any]], choose: Callable[[Any], None]
    ) -> tuple[QAction, ...]:
        menu = QMenu(title, self)
        self.addMenu(menu)
        group = QActionGroup(menu)
        group.setObjectName(f"view/{key}")
        for text, value in choices:
            action = QAction(text, menu)
            action.setCheckable(True)
            action.triggered.connect(lambda _, value=value: choose(value))
            group.addAction(action)
            menu.addAction(action)
        actions = tuple(group.actions())
        actions[0].setChecked(True)
        return actions
