"""The wavefront panel: the chosen quantity at every view of the field, and its display options."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from PyQt6.QtCore import QRect, Qt, pyqtSignal
from PyQt6.QtGui import QAction, QActionGroup, QMouseEvent
from PyQt6.QtWidgets import QFileDialog, QMenu, QWidget

from app.files import check_outputs
from app.gui.panels.panel import SLOWER_S, DisplayState, Entries, MoreEntries, Panel, Request
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button, Choice, checkable
from app.gui.widgets.copies import ask_file, write_picture
from app.gui.widgets.enlarged_view import EnlargedView
from app.gui.widgets.fields import NumberField
from app.gui.widgets.file_work import FileWork
from app.gui.widgets.layouts import column, row_of
from app.gui.widgets.presentation import PRESENTATIONS, AdaptiveScale, ColourScale, number, position_texts
from app.gui.widgets.texts import ElidedLabel, colour_text
from app.gui.widgets.view_grid import Caption, Maps, ViewGrid
from app.measurement.measurement import Measurement
from app.results.dataset import write_shown
from app.results.shown_wavefront import (
    MOST_AVERAGED,
    MOST_VIEWS,
    REMOVABLE,
    TILT,
    DisplayOptions,
    StoredWavefront,
    Unit,
    WavefrontDisplay,
)
from app.results.view_maps import Quantity, QuantityMaps, ViewNumbers, quantity_maps, view_numbers
from drivers.interface import Range
from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.pupil import Pupil
from reconstruction.quality.image_quality import aligned
from reconstruction.wavefront import Wavefront

_FIXED = " fixed"  # in the title of a colour bar
_UNSURE = 0.1  # error over the value of a view: more is hatched
_AVERAGES = (1, 2, 5, 10, 20, 50, MOST_AVERAGED)


class WavefrontPanel(Panel):
    """Shows the chosen quantity, or that there is no wavefront."""

    title, is_tab = "Wavefronts", False

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        self._newest: Wavefront | None = None  # as measured
        self._display = WavefrontDisplay()
        self._numbers: ViewNumbers | None = None  # of the maps in the grid, or of some before them
        self._limits = {(one.family, unit): AdaptiveScale() for one in PRESENTATIONS.values() for unit in Unit}
        self._reach_mrad = AdaptiveScale()  # half width of PSF maps
        self._enlarged: EnlargedView | None = None
        self._reading = FileWork(self, self.warned.emit)  # of a wavefront to subtract
        self._exports = FileWork(self, self.warned.emit)
        about = "Quantity shown for every view (keys 1 to 4)"
        self.choice = Choice(about, Quantity, self._redraw, key="view/quantity")
        for index, quantity in enumerate(Quantity):
            tip = f"{PRESENTATIONS[quantity].about} ({index + 1})"
            self.choice.setItemData(index, tip, Qt.ItemDataRole.ToolTipRole)
        self._summary = ElidedLabel(lines=2)
        about = "Fix the colour scale (H); a click on the bar types its limit"
        self.fix_scale = checkable(self, "Fix scale", about, self._show_fixed)
        self.menu = DisplayMenu(self)
        self.menu.changed.connect(self._apply_options)
        self.menu.store.triggered.connect(self._store)
        shown.pupil_drawn.connect(lambda pupil: self.menu.change(pupil=pupil))
        self.menu.fit_pupil.triggered.connect(self._fit_pupil)
        self.menu.file.triggered.connect(self._choose_file)
        self.display_button = Button("Display", "Remove modes, subtract, mean, unit, views")
        self.display_button.setMenu(self.menu)
        self.grid = ViewGrid()
        self.grid.selected.connect(shown.choose_view)
        self.grid.opened.connect(self.enlarge)
        self.limit = NumberField(name="Limit of the colours", decimals=3, tool_tip="Return fixes the colours to it")
        self.limit.setParent(self.grid)
        self.limit.hide()
        self.limit.entered.connect(self._fix_limit)
        self.limit.editingFinished.connect(self.limit.hide)
        self.grid.bar_clicked.connect(self._edit_limit)
        self.header = row_of(self.choice, (self._summary, 1), self.display_button)
        column((self.grid, 1), parent=self)

    def menu_entries(self) -> Mapping[str, Entries]:
        return {
            "&View": (
                *(
                    (f"{quantity} over the field", str(index + 1), partial(self.choice.setCurrentText, quantity))
                    for index, quantity in enumerate(Quantity)
                ),
                ("Fix scale", "H", self.fix_scale),
                ("Enlarge the selected view…", "V", self.enlarge),
            ),
            "&File": (("Export the shown wavefronts…", "Ctrl+E", self.export),),
        }

    def more_entries(self) -> MoreEntries:
        return (self.fix_scale,)

    @property
    def quantity(self) -> Quantity:
        return Quantity(self.choice.currentText())

    def show_measurement(self, measurement: Measurement) -> None:
        self.show_wavefront(measurement.wavefront)

    def show_wavefront(self, wavefront: Wavefront | None) -> None:
        """Show the views of a wavefront, if any; `show_result` shows the other quantities."""
        if wavefront is None and self._newest is None:
            return
        self._newest = wavefront
        if wavefront is None:
            self.shown.wavefront = None
            self._show_maps(None)
            return
        self.shown.wavefront, self.shown.wavelength_m = self._display(wavefront), wavefront.sensor.wavelength_m
        self.shown.pupil = self.shown.wavefront.sensor.pupil
        if self.is_needed and self.quantity is Quantity.WAVEFRONT:
            self._show(QuantityMaps(self.shown.wavefront.views))

    def forget_bench(self) -> None:
        """Forget all wavefronts, also the one that is subtracted: the lenslets may be others."""
        self.show_wavefront(None)
        self._reading.forget()
        self._display = WavefrontDisplay()
        self.menu.change(stored=None, pupil=None)

    @property
    def is_needed(self) -> bool:
        """True if the maps are seen, here or enlarged."""
        return self.isVisible() or (self._enlarged is not None and self._enlarged.isVisible())

    def catch_up(self) -> None:
        super().catch_up()
        self.show_wavefront(self._newest)

    def request(self) -> Request | None:
        """Frame the chosen view, and request maps with their numbers, of a wavefront only these."""
        self.grid.select(self.shown.view)
        wavefront, quantity, settings = self.shown.wavefront, self.quantity, self.shown.reconstruction
        if wavefront is not None and quantity is Quantity.WAVEFRONT:
            options = self.menu.options
            single = wavefront if options.averaged == 1 and options.stored is None else None
            return Request(wavefront, (quantity, options), lambda _: view_numbers(quantity, wavefront.views, single))
        if wavefront is None or settings is None:
            return None
        has_reach = quantity is Quantity.PSF and self._reach_mrad.is_set
        reach_rad = self._reach_mrad.value * 1e-3 if has_reach else None
        choice = (quantity, settings, reach_rad, wavefront.field)
        return Request(wavefront, choice, lambda _: quantity_maps(wavefront, quantity, settings, reach_rad), SLOWER_S)

    def show_result(self, result: QuantityMaps | ViewNumbers | None) -> None:
        if result is None:
            self._show_maps(None)
            return
        if isinstance(result, QuantityMaps):
            if self.quantity is Quantity.PSF:
                self._follow(self._reach_mrad, result.light_reach_rad * 1e3)
            self._show(result)
        self._numbers = result.numbers if isinstance(result, QuantityMaps) else result
        self.show_numbers()

    def show_numbers(self) -> None:
        badge, reason, _ = self.shown.data_freshness
        colour_text(self._summary, theme.AMBER if badge else theme.TEXT)
        doubt = f"{badge}: {reason}" * bool(badge)  # last: only the end may be cut
        numbers, wavefront, quantity = self._numbers, self.shown.wavefront, self.quantity
        if numbers is None or wavefront is None or numbers.quantity is not quantity:
            self._summary.setText(doubt)
            self.grid.set_captions({})
            self.shown.sigma_rad = None
            return
        presentation, field, factor = PRESENTATIONS[quantity], wavefront.field, self._factor
        errors = numbers.error_rad
        self.shown.sigma_rad = None if errors is None else float(np.nanmean(errors))
        if numbers.first.shape == (field.view_rows, field.view_columns):
            captions: dict[tuple[int, int], Caption] = {}
            for at, where in _positions(field).items():
                first, second = (factor * float(each[at]) for each in (numbers.first, numbers.second))
                error = math.nan if errors is None else factor * float(errors[at])
                captions[at] = presentation.caption(first, second, error, self.shown.unit), where
            self.grid.set_captions(captions)
        reach = f"half width {self._reach_mrad.value:g} mrad" if quantity is Quantity.PSF else ""
        summary = presentation.summary(factor * numbers.mean, self.shown.unit)
        if numbers.noise_rad is not None:  # it cannot be distinguished from a flat one
            summary = f"Mean RMS below noise ({number(factor * numbers.noise_rad)} {self.shown.unit})"
        self._summary.setText("; ".join(filter(None, (summary, self.menu.options.in_words, reach, doubt))))
        if self._enlarged is not None:
            self._enlarged.refresh()

    def enlarge(self) -> None:
        if self._enlarged is None:
            self._enlarged = EnlargedView(self.grid, self)
        self._enlarged.show()
        self._enlarged.raise_()

    def export(self) -> None:
        shown, status = self.shown.wavefront, self.shown.status
        if shown is None or status is None:
            self.warned.emit("there is no wavefront to export")
            return
        picture, bench, options = self.grab().toImage(), status.bench, self.menu.options.in_words
        proposed = self.shown.proposed("wavefronts.png")
        path = ask_file(self, "Export the shown wavefronts", proposed, "Picture (*.png)", ".nc")
        if path is None:
            return
        results = path.with_suffix(".nc")

        def write() -> None:
            check_outputs([path, results], overwrite=True)  # parts of a recording are never replaced
            write_picture(path, picture)
            write_shown(results, shown, bench, options=options)

        files = f"{path} and {results.name}"
        self._exports.run(write, lambda _: self.informed.emit(f"saved {files}"), writes=files)

    @property
    def _scale(self) -> AdaptiveScale:
        return self._limits[PRESENTATIONS[self.quantity].family, self.shown.unit]

    @property
    def _factor(self) -> float:
        """Factor of values in rad, or 1 for ratios."""
        return self.shown.per_rad if PRESENTATIONS[self.quantity].has_unit else 1.0

    def _titled(self, scale: ColourScale) -> ColourScale:
        """Say above the bar whether the scale is fixed."""
        return replace(scale, title=scale.title.removesuffix(_FIXED) + _FIXED * self.fix_scale.isChecked())

    def _show_fixed(self) -> None:
        if (maps := self.grid.maps) is not None:
            self.grid.show_maps(replace(maps, scale=self._titled(maps.scale)))

    def _fix_limit(self, limit: float) -> None:
        self.limit.hide()
        self._scale.use(limit)
        self.fix_scale.setChecked(True)
        self._redraw()

    def _edit_limit(self, bar: QRect) -> None:
        """Type the limit of the colour scale over its highest number."""
        self.limit.show_value(self._scale.value, Range(1e-3, 1e5))
        size = self.limit.sizeHint()
        self.limit.setGeometry(self.grid.width() - size.width(), bar.top(), size.width(), size.height())
        self.limit.show()
        self.limit.edit()

    def _store(self) -> None:
        if self._newest is not None:
            now = f"{datetime.now().astimezone():%H:%M:%S}"
            name = f"that of {now if self.shown.replayed is None else self.shown.replayed[0]}"
            self.menu.change(stored=self._display.store(self._newest, name))

    def _fit_pupil(self) -> None:
        """Show only the pupil that the valid lenslets fill."""
        if self._newest is None:
            self.warned.emit("a pupil cannot be fitted: there is no wavefront")
        else:
            sensor = replace(self._newest.sensor, pupil=Pupil(shape="fit"))
            self.menu.change(pupil=sensor.with_pupil(self._newest.displacement.valid).pupil)

    def _choose_file(self) -> None:
        """Subtract the wavefront of a file of results as soon as it is read."""
        name, _ = QFileDialog.getOpenFileName(self, "Subtract a wavefront", "", "Results (*.nc)")
        if name:
            sensor = None if self._newest is None else self._newest.sensor
            self._reading.forget()  # another file was chosen meanwhile
            read = partial(StoredWavefront.from_results, Path(name), sensor)
            self._reading.run(read, lambda stored: self.menu.change(stored=stored))

    def _apply_options(self) -> None:
        self._display.options, self.shown.unit = self.menu.options, self.menu.unit
        self.shown.options = self.menu.options.in_words
        self._redraw()

    def _redraw(self) -> None:
        if self._newest is None or self.quantity is not Quantity.WAVEFRONT:
            self._show_maps(None)  # until the analysis has it
        self.show_wavefront(self._newest)
        self.show_numbers()

    def _show(self, found: QuantityMaps) -> None:
        """Show maps over the lenslets, or those of a PSF over angles."""
        presentation, wavefront, unit = PRESENTATIONS[self.quantity], self.shown.wavefront, self.shown.unit
        if wavefront is None:
            return

        def scale_of(values: Floats) -> ColourScale:
            self._follow(self._scale, max(presentation.limit(values), presentation.finest * self._factor))
            return self._titled(presentation.scale(self._scale.value, unit))

        if self.quantity is Quantity.PSF:
            values, reach_mrad = found.values * self._factor, found.reach_rad * 1e3
            angle_mrad, reach = np.linspace(-reach_mrad, reach_mrad, values.shape[-1]), (reach_mrad, reach_mrad)

            def at_angle(row: int, column: int, value: float) -> str:
                place = f"{angle_mrad[column]:+.2f}, {angle_mrad[row]:+.2f} mrad"
                return f"{place}: {presentation.value(value, unit)}" if np.isfinite(value) else "no value"

            self._show_maps(Maps(values, scale_of(values), at_angle, is_smooth=True, reach=reach, reach_unit="mrad"))
        else:
            sensor = wavefront.sensor
            values = aligned(found.values, sensor.arrangement) * self._factor
            rows, columns = sensor.lenslets
            x_mm, y_mm = (columns - 1) / 2 * sensor.lenslet_pitch_m * 1e3, (rows - 1) / 2 * sensor.row_spacing_m * 1e3

            def at_lenslet(row: int, column: int, value: float) -> str:
                text = presentation.value(value, unit) if np.isfinite(value) else "lost, no value"
                return f"Lenslet row {row}, column {column}: {text}"

            measured = np.where(wavefront.displacement.valid, values, np.nan)  # the others are hatched
            size_m = sensor.lenslets[1] * sensor.lenslet_pitch_m, sensor.lenslets[0] * sensor.row_spacing_m
            edges = (sensor.pupil.edges_m / size_m + 0.5).tolist()
            maps = Maps(measured, scale_of(values), at_lenslet, reach=(x_mm, y_mm), reach_unit="mm", outline=edges)
            numbers = self._numbers
            if numbers is not None and numbers.sigma_rad is not None and numbers.sigma_rad.shape == values.shape:
                unsure = numbers.sigma_rad > _UNSURE * numbers.first[..., None, None]
                maps = replace(maps, unsure=unsure, sigma=numbers.sigma_rad * self._factor)
            self._show_maps(maps)

    def _follow(self, scale: AdaptiveScale, needed: float) -> None:
        if not (self.fix_scale.isChecked() and scale.is_set):
            scale.follow(needed)

    def _show_maps(self, maps: Maps | None) -> None:
        self.grid.show_maps(maps)
        if maps is None:
            self._numbers = None
            self.show_numbers()
        if self._enlarged is not None:
            self._enlarged.refresh()


@lru_cache(maxsize=4)
def _positions(field: Field) -> dict[tuple[int, int], tuple[str, ...]]:
    """Wordings of the position of each view (view_row, view_column)."""
    x_m, y_m = field.view_x_m.tolist(), field.view_y_m.tolist()
    return {(i, j): position_texts(x_m[j], y_m[i]) for i, j in np.ndindex(len(y_m), len(x_m))}


class _StayingMenu(QMenu):
    """Stays open while several of its entries are ticked."""

    def mouseReleaseEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        if event is not None and (action := self.actionAt(event.pos())) is not None:
            action.trigger()


class DisplayMenu(QMenu):
    """Chooses what is removed from the shown wavefront, its unit and its views."""

    changed = pyqtSignal()

    def __init__(self, parent: QWidget) -> None:
        super().__init__("&Display", parent)
        self.setToolTipsVisible(True)
        self.options, self.unit = DisplayOptions(), Unit.RAD
        remove = _StayingMenu("Remove", self)
        self.addMenu(remove)
        self.removed = {mode: QAction(name, remove) for mode, name in REMOVABLE.items()}
        remove.addSection("Piston is not measured")
        self.tilt = QAction("Tip and tilt", remove)
        self.tilt.setCheckable(True)
        self.tilt.triggered.connect(self._remove_tilt)
        self.changed.connect(lambda: self.tilt.setChecked(self.options.removed >= TILT))
        remove.addAction(self.tilt)
        for mode, action in self.removed.items():
            action.setObjectName(f"view/without {mode}")  # its state is restored at the next start
            action.setCheckable(True)
            action.toggled.connect(lambda _, mode=mode: self.change(removed=self.options.removed ^ {mode}))
            remove.addAction(action)
        self.store = self._add("Subtract the present wavefront", "The mean, if frames are averaged")
        self.file = self._add("Subtract a wavefront from a file…", "Results of svwfs with coefficients")
        self.clear_stored = self._add("Subtract nothing", "Show the whole wavefront")
        self.clear_stored.triggered.connect(lambda: self.change(stored=None))
        self.clear_stored.setEnabled(False)
        self.addSeparator()
        self.fit_pupil = self._add("Fit a pupil to the valid lenslets", "A circle, with a shadow if the middle is lost")
        self.no_pupil = self._add("Show all lenslets", "No pupil")
        self.no_pupil.triggered.connect(lambda: self.change(pupil=None))
        self.no_pupil.setEnabled(False)
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
        self.no_pupil.setEnabled(self.options.pupil is not None)
        self.changed.emit()

    def _remove_tilt(self, is_removed: bool) -> None:
        for mode in TILT:
            self.removed[mode].setChecked(is_removed)

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
