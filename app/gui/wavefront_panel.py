"""The wavefront panel: the chosen quantity at every view of the field."""

from collections.abc import Callable
from functools import partial

import numpy as np
from PyQt6.QtCore import Qt
from PyQt6.QtWidgets import QComboBox, QWidget

from app.gui.adaptive_scale import RANGES, AdaptiveScale
from app.gui.presentation import PRESENTATIONS, Presentation, place
from app.gui.view_grid import Maps, ViewGrid
from app.gui.widgets import ElidedLabel, column, label, row, toggle
from app.results.view_analysis import Analysis, Quantity
from reconstruction.arrays import Floats
from reconstruction.wavefront import Wavefront


class WavefrontPanel(QWidget):
    """Shows the chosen quantity, or that there is no wavefront."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._wavefront: Wavefront | None = None
        self._shown: tuple[Quantity, Floats] | None = None  # the maps in the grid
        self._limits = {one.family: AdaptiveScale(RANGES) for one in PRESENTATIONS.values()}
        self._reach_mrad = AdaptiveScale(RANGES)  # half width of PSF maps
        self._choice = QComboBox()
        self._choice.addItems(list(Quantity))
        for index, quantity in enumerate(Quantity):
            tip = f"{PRESENTATIONS[quantity].about} ({index + 1})"
            self._choice.setItemData(index, tip, Qt.ItemDataRole.ToolTipRole)
        self._choice.setToolTip("Quantity shown for every view (keys 1 to 6)")
        self._choice.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self._choice.currentIndexChanged.connect(self._change_quantity)
        self._summary = ElidedLabel("dim")
        self._summary.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.freeze_scale = toggle("Freeze scale", "Freeze the colour scale (H)")
        self.grid = ViewGrid()
        header = row(self._choice, label("over the field", "title"), (self._summary, 1), self.freeze_scale)
        column(header, (self.grid, 1), parent=self)

    @property
    def quantity(self) -> Quantity:
        """The chosen quantity."""
        return Quantity(self._choice.currentText())

    @property
    def reach_rad(self) -> float | None:
        """Half width of PSF maps; None until the extent of the light is known."""
        return self._reach_mrad.value * 1e-3 if self._reach_mrad.is_set else None

    def choose(self, quantity: Quantity) -> None:
        """Choose a quantity."""
        self._choice.setCurrentText(quantity)

    def show_wavefront(self, wavefront: Wavefront | None) -> None:
        """Show the views of a wavefront, or that there is none; `show_analysis` shows the other quantities."""
        if wavefront is None and self._wavefront is None:
            return
        self._wavefront = wavefront
        if wavefront is None:
            self._show_nothing()
        elif self.quantity is Quantity.WAVEFRONT:
            self._show(wavefront.views, _describe_lenslet)

    def show_analysis(self, analysis: Analysis) -> None:
        """Show the maps of an analysis unless another quantity was chosen meanwhile."""
        is_current = analysis.request.quantity is self.quantity is not Quantity.WAVEFRONT
        if self._wavefront is None or not is_current:
            return
        if analysis.maps is None:
            self._show_nothing()
        elif self.quantity is Quantity.PSF:
            self._follow(self._reach_mrad, analysis.light_reach_rad * 1e3)
            self._show(analysis.maps, partial(_describe_angle, analysis), is_smooth=True)
            self.update_text()
        else:
            self._show(analysis.maps, _describe_lenslet)
            self.update_text()

    def update_text(self) -> None:
        """Update the numbers under the views and in the header."""
        if self._shown is None or self._wavefront is None:
            self._summary.setText("")
            self.grid.set_captions({})
            return
        quantity, maps = self._shown
        presentation, field = PRESENTATIONS[quantity], self._wavefront.field
        self.grid.set_captions(
            {
                (i, j): (presentation.caption(maps[i, j]), place(float(field.view_x_m[j]), float(field.view_y_m[i])))
                for i, j in np.ndindex(maps.shape[:2])
            }
        )
        reach = f"half width {self._reach_mrad.value:g} mrad; " if quantity is Quantity.PSF else ""
        self._summary.setText(reach + presentation.summary(maps))
        self._summary.setToolTip(self._summary.text())

    def _change_quantity(self) -> None:
        if self._wavefront is None:
            self._show_nothing()
        else:
            self.show_wavefront(self._wavefront)
            self.update_text()

    def _show(
        self, maps: Floats, describe: Callable[[Presentation, int, int, float], str], *, is_smooth: bool = False
    ) -> None:
        presentation = PRESENTATIONS[self.quantity]
        limit = self._limits[presentation.family]
        self._follow(limit, max(presentation.limit(maps), presentation.finest))
        self._shown = (self.quantity, maps)
        self.grid.show_maps(Maps(maps, presentation.scale(limit.value), partial(describe, presentation), is_smooth))

    def _follow(self, scale: AdaptiveScale, needed: float) -> None:
        if not (self.freeze_scale.isChecked() and scale.is_set):
            scale.follow(needed)

    def _show_nothing(self) -> None:
        self._shown = None
        self.grid.show_maps(None)
        self.update_text()


def _describe_lenslet(presentation: Presentation, row: int, column: int, value: float) -> str:
    text = presentation.value.format(value) if np.isfinite(value) else "lost, no value"
    return f"Lenslet row {row}, column {column}: {text}"


def _describe_angle(analysis: Analysis, presentation: Presentation, row: int, column: int, value: float) -> str:
    if analysis.maps is None or not np.isfinite(value):
        return "no value"
    angle_mrad = np.linspace(-analysis.reach_rad, analysis.reach_rad, analysis.maps.shape[-1]) * 1e3
    return f"{angle_mrad[column]:+.2f}, {angle_mrad[row]:+.2f} mrad: {presentation.value.format(value)}"
