"""Which part of the sensor is read out, and how it is binned: asked for in a dialog beside the running measurement."""

from __future__ import annotations

from PyQt6.QtCore import pyqtSignal
from PyQt6.QtWidgets import QComboBox, QDialog, QFormLayout, QHBoxLayout, QVBoxLayout, QWidget

from app.acquisition.instrument import Status
from app.gui.number_field import NumberField
from app.gui.widgets import button, label
from app.measurement.sensor_region import SensorArea, in_steps, region_around
from drivers.interface import Range, Region

_STEPS = "All four are in pixels of the sensor, unbinned; the camera takes them in its own steps"


class ReadOutDialog(QDialog):
    """Emits the area that its user wants; shows the one in force, and what the camera allows."""

    wanted = pyqtSignal(object)  # a SensorArea

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setWindowTitle("Part of the sensor, and binning")
        self._status: Status | None = None
        self.top = NumberField(tool_tip=f"First row of the sensor that is read out. {_STEPS}")
        self.left = NumberField(tool_tip=f"First column. {_STEPS}")
        self.rows = NumberField(tool_tip=f"How many rows. {_STEPS}")
        self.columns = NumberField(tool_tip=f"How many columns. {_STEPS}")
        self._sides = (self.top, self.left, self.rows, self.columns)
        self.binning = QComboBox()
        self.binning.setToolTip("How many pixels of the sensor, along both axes, make one of the frame")
        self.limits, self.in_force = label("", "dim"), label("", "dim")
        self.whole = button("Whole sensor", "Fill in all of the sensor")
        self.whole.clicked.connect(self._fill_whole)
        self.around = button("Around the lattice", "Fill in what holds all lenslets, and half a pitch about them")
        self.around.clicked.connect(self._fill_around)
        self.apply = button("Read this out", "Stop the camera, set it, and go on; dark and reference are to be retaken")
        self.apply.setDefault(True)
        self.apply.clicked.connect(lambda: self.wanted.emit(self.area))
        close = button("Close", "Leave everything as it is (Esc)")
        close.clicked.connect(self.close)
        self._lay_out((self.whole, self.around), (self.apply, close))

    @property
    def area(self) -> SensorArea:
        """What is filled in."""
        return SensorArea(Region(*(round(side.value()) for side in self._sides)), int(self.binning.currentText() or 1))

    def begin(self, status: Status) -> None:
        """Fill in what is in force, and let it be changed."""
        self._status = None
        self.show_status(status)
        self.show()

    def show_status(self, status: Status) -> None:
        """Show what is in force; what is being filled in is left alone until that has changed."""
        before, self._status = self._status, status
        allowed, area = status.capabilities, status.area
        is_new = before is None or (before.area, before.capabilities.sensor) != (area, allowed.sensor)
        pixels = f"{allowed.rows} x {allowed.columns} pixels"
        self.in_force.setText(f"In force: {area}; frames of {pixels}")
        whole = allowed.sensor or area.region
        steps = f", in steps of {allowed.region_step_px} px" if allowed.sensor is not None else ", no part of it"
        self.limits.setText(f"The camera reads out {whole.rows} x {whole.columns}{steps}")
        for side in (*self._sides, self.around):
            side.setEnabled(allowed.sensor is not None)
        self.around.setEnabled(allowed.sensor is not None and status.lattice is not None)
        self.binning.setEnabled(len(allowed.binnings) > 1)
        if is_new:
            self.binning.clear()
            self.binning.addItems(list(map(str, allowed.binnings)))
            self.binning.setCurrentText(str(area.binning))
            self._fill(area.region)

    def _fill(self, region: Region) -> None:
        """Fill in a region, in the steps of the camera as it is now."""
        if self._status is None:
            return
        allowed = self._status.capabilities
        whole = allowed.sensor or region
        if allowed.sensor is not None:
            region = in_steps(region, allowed.sensor, allowed.region_step_px)
        for side, value, most in (
            (self.top, region.top, whole.rows),
            (self.left, region.left, whole.columns),
            (self.rows, region.rows, whole.rows),
            (self.columns, region.columns, whole.columns),
        ):
            side.setSingleStep(allowed.region_step_px)
            side.show_value(value, Range(0, most))

    def _fill_whole(self) -> None:
        if self._status is not None and self._status.capabilities.sensor is not None:
            self._fill(self._status.capabilities.sensor)

    def _fill_around(self) -> None:
        status = self._status
        if status is not None and status.lattice is not None:
            self._fill(region_around(status.lattice, status.bench.sensor, status.area))

    def _lay_out(self, fills: tuple[QWidget, ...], ends: tuple[QWidget, ...]) -> None:
        form = QFormLayout()
        fields: tuple[tuple[str, QWidget], ...] = (
            ("First row", self.top),
            ("First column", self.left),
            ("Rows", self.rows),
            ("Columns", self.columns),
            ("Binning", self.binning),
        )
        for text, field in fields:
            form.addRow(label(text, "dim"), field)
        layout = QVBoxLayout(self)
        layout.setSpacing(8)
        layout.addWidget(self.limits)
        layout.addLayout(form)
        for widgets in (fills, ends):
            row = QHBoxLayout()
            for widget in widgets:
                row.addWidget(widget)
            layout.addLayout(row)
            if widgets is fills:
                layout.addWidget(self.in_force)
