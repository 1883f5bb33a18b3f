"""The wavefront panel: the chosen quantity at every view of the field."""

from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
from PyQt6.QtCore import Qt, pyqtSignal
from PyQt6.QtWidgets import QFileDialog, QWidget

from app.errors import InputError
from app.gui import theme
from app.gui.adaptive_scale import RANGES, AdaptiveScale
from app.gui.display_menu import DisplayMenu
from app.gui.enlarged_view import EnlargedView
from app.gui.number_field import NumberField
from app.gui.presentation import PRESENTATIONS, Presentation, number, place
from app.gui.situation import Liveness
from app.gui.view_grid import Maps, ViewGrid
from app.gui.widgets import Choice, ElidedLabel, button, colour_text, column, label, row_of, toggle
from app.results.frame_tallies import rms_noise
from app.results.shown_wavefront import StoredWavefront, Unit, WavefrontDisplay
from app.results.view_analysis import Analysis, Quantity
from drivers.interface import Range
from reconstruction.arrays import Floats
from reconstruction.quality.image_quality import aligned
from reconstruction.refinement import mean_rms
from reconstruction.wavefront import Wavefront

_LIMITS = Range(1e-3, 1e5)
_WEAK_RAD = 0.1  # mean RMS from which on noise is not looked at: it takes some milliseconds


class WavefrontPanel(QWidget):
    """Shows the chosen quantity, or that there is no wavefront."""

    refused = pyqtSignal(str)  # why a wavefront cannot be subtracted

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._newest: Wavefront | None = None  # as measured
        self.shown: Wavefront | None = None  # with the display options applied to its views
        self._display = WavefrontDisplay()
        self._maps: tuple[Quantity, Floats] | None = None  # the maps in the grid, in the shown unit
        units = {(one.family, unit): AdaptiveScale(RANGES) for one in PRESENTATIONS.values() for unit in Unit}
        self._limits = units
        self._reach_mrad = AdaptiveScale(RANGES)  # half width of PSF maps
        self._enlarged: EnlargedView | None = None
        self.choice = Choice()
        self.choice.addItems(list(Quantity))
        for index, quantity in enumerate(Quantity):
            tip = f"{PRESENTATIONS[quantity].about} ({index + 1})"
            self.choice.setItemData(index, tip, Qt.ItemDataRole.ToolTipRole)
        self.choice.setToolTip("Quantity shown for every view (keys 1 to 6)")
        self.choice.currentIndexChanged.connect(self._redraw)
        self._summary = ElidedLabel("dim")
        self._summary.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.freeze_scale = toggle("Freeze scale", "Freeze the colour scale (H)")
        self.freeze_scale.toggled.connect(self._show_limit)
        self.limit = NumberField(name="Limit of the colours", decimals=3, tool_tip="Limit of the frozen colour scale")
        self.limit.entered.connect(self._fix_limit)
        self.limit.hide()
        self.menu = DisplayMenu(self)
        self.menu.changed.connect(self._apply_options)
        self.menu.store_requested.connect(self._store)
        self.menu.file_requested.connect(self._choose_file)
        self.menu.enlarge_requested.connect(self.enlarge)
        self.display_button = button("Display", "Tilt, defocus, mean, unit, views", lambda: None)
        self.display_button.setMenu(self.menu)
        self.grid = ViewGrid()
        self.stale = ElidedLabel()  # always there, so that the maps stay where they are
        colour_text(self.stale, theme.AMBER)
        self.grid.opened.connect(self.enlarge)
        scale = (self.display_button, self.freeze_scale, self.limit)
        self.header = row_of(self.choice, label("over the field", "title"), (self._summary, 1), *scale)
        column(self.header, self.stale, (self.grid, 1), parent=self)

    @property
    def quantity(self) -> Quantity:
        """The chosen quantity."""
        return Quantity(self.choice.currentText())

    @property
    def reach_rad(self) -> float | None:
        """Half width of PSF maps; None until the extent of the light is known."""
        return self._reach_mrad.value * 1e-3 if self._reach_mrad.is_set else None

    def choose(self, quantity: Quantity) -> None:
        """Choose a quantity."""
        self.choice.setCurrentText(quantity)

    def show_liveness(self, shown: Liveness) -> None:
        """Say how the maps differ from live ones, and show those in grey that may be over."""
        self.grid.show_stale(is_stale=shown.is_grey)
        self.stale.setText(f"{shown.badge}: {shown.reason}" if shown.badge else "")

    def show_wavefront(self, wavefront: Wavefront | None) -> None:
        """Show the views of a wavefront, or that there is none; `show_analysis` shows the other quantities."""
        if wavefront is None and self._newest is None:
            return
        self._newest = wavefront
        self.shown = None if wavefront is None else self._display(wavefront)
        if self.shown is None:
            self._show_nothing()
        elif self.quantity is Quantity.WAVEFRONT:
            self._show(self.shown.views, _describe_lenslet)

    def forget_bench(self) -> None:
        """Forget the wavefronts of another bench, also the one that is subtracted: its lenslets may be others."""
        self.show_wavefront(None)
        self._display = WavefrontDisplay()
        self.menu.change(stored=None)

    def show_analysis(self, analysis: Analysis) -> None:
        """Show the maps of an analysis unless another quantity or other views were chosen meanwhile."""
        is_current = analysis.request.quantity is self.quantity is not Quantity.WAVEFRONT
        if self.shown is None or not is_current or analysis.request.wavefront.field != self.shown.field:
            return
        if analysis.maps is None:
            self._show_nothing()
        elif self.quantity is Quantity.PSF:
            self._follow(self._reach_mrad, analysis.light_reach_rad * 1e3)
            self._show(analysis.maps, partial(_describe_angle, analysis), analysis.reach_rad * 1e3)
            self.update_text()
        else:
            self._show(analysis.maps, _describe_lenslet)
            self.update_text()

    def update_text(self) -> None:
        """Update the numbers under the views and in the header."""
        if self._maps is None or self.shown is None:
            self._summary.setText("")
            self.grid.set_captions({})
            return
        quantity, maps = self._maps
        presentation, field = PRESENTATIONS[quantity], self.shown.field
        if maps.shape[:2] == (field.view_rows, field.view_columns):
            numbers = iter(presentation.captions(maps.reshape(-1, *maps.shape[2:])))
            self.grid.set_captions(
                {
                    (i, j): (next(numbers), place(float(field.view_x_m[j]), float(field.view_y_m[i])))
                    for i, j in np.ndindex(maps.shape[:2])
                }
            )
        reach = f"half width {self._reach_mrad.value:g} mrad" if quantity is Quantity.PSF else ""
        summary = self._below_noise() or presentation.summary(maps, self.menu.unit)
        parts = (self.menu.options.in_words, reach, summary)
        self._summary.setText("; ".join(filter(None, parts)))
        if self._enlarged is not None:
            self._enlarged.update_text()

    def _below_noise(self) -> str:
        """Say that the shown wavefront cannot be told from a flat one; empty if it can, or is no single frame's."""
        options = self.menu.options
        is_single = self.quantity is Quantity.WAVEFRONT and options.averaged == 1 and options.stored is None
        if self._newest is None or not is_single or not mean_rms(self._newest.views) < _WEAK_RAD:
            return ""
        noise_rad = float(np.sqrt(np.nanmean(rms_noise(self._newest) ** 2)))
        if mean_rms(self._newest.views) >= noise_rad:
            return ""
        unit = self.menu.unit
        return f"mean RMS below noise ({number(noise_rad * unit.per_rad(self._newest.sensor.wavelength_m))} {unit})"

    def enlarge(self) -> None:
        """Show the selected view in a window of its own."""
        if self._enlarged is None:
            self._enlarged = EnlargedView(self.grid, self)
            self._enlarged.destroyed.connect(self._forget_enlarged)
        self._enlarged.show()
        self._enlarged.raise_()

    def subtract_file(self, path: Path) -> None:
        """Subtract the wavefront of a file of results from now on."""
        try:
            lenslets = None if self._newest is None else self._newest.displacement.outcome.shape
            stored = StoredWavefront.from_results(path, lenslets)
        except InputError as error:
            self.refused.emit(str(error))
        else:
            self.menu.change(stored=stored)

    @property
    def _scale(self) -> AdaptiveScale:
        return self._limits[PRESENTATIONS[self.quantity].family, self.menu.unit]

    def _fix_limit(self, limit: float) -> None:
        self._scale.use(limit)
        self._redraw()

    def _show_limit(self) -> None:
        """Show the limit of a frozen colour scale, to be changed."""
        self.limit.setVisible(self.freeze_scale.isChecked())
        self.limit.show_value(self._scale.value, _LIMITS)

    def _store(self) -> None:
        if self._newest is not None:
            name = f"that of {datetime.now().astimezone():%H:%M:%S}"
            self.menu.change(stored=self._display.store(self._newest, name))

    def _choose_file(self) -> None:
        name, _ = QFileDialog.getOpenFileName(self, "Subtract a wavefront", "", "Results (*.nc)")
        if name:
            self.subtract_file(Path(name))

    def _apply_options(self) -> None:
        self._display.options = self.menu.options
        self._redraw()

    def _forget_enlarged(self) -> None:
        self._enlarged = None

    def _redraw(self) -> None:
        if self._newest is None or self.quantity is not Quantity.WAVEFRONT:
            self._show_nothing()  # until the analysis has it
        self.show_wavefront(self._newest)
        self.update_text()
        self._show_limit()

    def _show(
        self,
        maps: Floats,
        describe: Callable[[Presentation, str, int, int, float], str],
        reach_mrad: float | None = None,
    ) -> None:
        """Show maps over the lenslets, or over angles up to a reach."""
        presentation, unit = PRESENTATIONS[self.quantity], self.menu.unit
        if self.shown is None:
            return
        per_rad = unit.per_rad(self.shown.sensor.wavelength_m) if presentation.has_unit else 1.0
        sensor = self.shown.sensor
        shown = (aligned(maps, sensor.arrangement) if reach_mrad is None else maps) * per_rad
        limit = self._scale
        self._follow(limit, max(presentation.limit(shown), presentation.finest * per_rad))
        self._maps = (self.quantity, shown)
        x_mm = (sensor.lenslet_columns - 1) / 2 * sensor.lenslet_pitch_m * 1e3
        y_mm = (sensor.lenslet_rows - 1) / 2 * sensor.row_spacing_m * 1e3
        scale, text = presentation.scale(limit.value, unit), partial(describe, presentation, unit)
        if reach_mrad is None:
            self.grid.show_maps(Maps(shown, scale, text, reach=(x_mm, y_mm), reach_unit="mm"))
        else:
            both = (reach_mrad, reach_mrad)
            self.grid.show_maps(Maps(shown, scale, text, is_smooth=True, reach=both, reach_unit="mrad"))
        if self._enlarged is not None:
            self._enlarged.refresh()

    def _follow(self, scale: AdaptiveScale, needed: float) -> None:
        if not (self.freeze_scale.isChecked() and scale.is_set):
            scale.follow(needed)

    def _show_nothing(self) -> None:
        self._maps = None
        self.grid.show_maps(None)
        self.update_text()
        if self._enlarged is not None:
            self._enlarged.refresh()


def _describe_lenslet(presentation: Presentation, unit: str, row: int, column: int, value: float) -> str:
    text = presentation.value(value, unit) if np.isfinite(value) else "lost, no value"
    return f"Lenslet row {row}, column {column}: {text}"


def _describe_angle(
    analysis: Analysis, presentation: Presentation, unit: str, row: int, column: int, value: float
) -> str:
    if analysis.maps is None or not np.isfinite(value):
        return "no value"
    angle_mrad = np.linspace(-analysis.reach_rad, analysis.reach_rad, analysis.maps.shape[-1]) * 1e3
    return f"{angle_mrad[column]:+.2f}, {angle_mrad[row]:+.2f} mrad: {presentation.value(value, unit)}"
