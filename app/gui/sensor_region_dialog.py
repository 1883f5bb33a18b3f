"""Dialog for the sensor region and the binning; the measurement continues beside it."""

from PyQt6.QtCore import pyqtSignal
from PyQt6.QtWidgets import QDialog, QFormLayout, QWidget

from app.acquisition.instrument import Status
from app.gui.number_field import NumberField
from app.gui.widgets import Choice, button, column, label, row
from app.measurement.sensor_region import SensorArea
from drivers.interface import Range, Region

_STEPS = "In unbinned sensor pixels; rounded to the camera's steps"


class SensorRegionDialog(QDialog):
    """Emits the requested area; shows the one in force and what the camera allows."""

    area_requested = pyqtSignal(object)  # a SensorArea
    around_requested = pyqtSignal()  # the region around the lattice

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setWindowTitle("Sensor region and binning")
        self._status: Status | None = None
        self.top = NumberField(name="First row", tool_tip=f"First row that is read out. {_STEPS}")
        self.left = NumberField(name="First column", tool_tip=f"First column that is read out. {_STEPS}")
        self.rows = NumberField(name="Rows", tool_tip=f"Number of rows. {_STEPS}")
        self.columns = NumberField(name="Columns", tool_tip=f"Number of columns. {_STEPS}")
        self._sides = (self.top, self.left, self.rows, self.columns)
        self.binning = Choice()
        self.binning.setToolTip("Sensor pixels per frame pixel, along both axes")
        self.limits, self.in_force = label("", "dim"), label("", "dim")
        self.whole = button("Whole sensor", "Fill in the whole sensor", self._fill_whole)
        self.around = button(
            "Around the lattice", "Fill in all lenslets with a margin of half a pitch", self.around_requested
        )
        self.apply = button("Apply", "Set the region; then take a new dark (D) and reference (R)", self._request_area)
        self.apply.setDefault(True)
        close = button("Close", "Change nothing (Esc)", self.close)
        form = QFormLayout()
        for text, field in (
            ("First row", self.top),
            ("First column", self.left),
            ("Rows", self.rows),
            ("Columns", self.columns),
            ("Binning", self.binning),
        ):
            form.addRow(label(text, "dim"), field)
        fills, ends = row((self.whole, 1), (self.around, 1)), row((self.apply, 1), (close, 1))
        column(self.limits, form, fills, self.in_force, ends, spacing=8, parent=self).setContentsMargins(11, 11, 11, 11)

    @property
    def area(self) -> SensorArea:
        """The area that is filled in."""
        return SensorArea(Region(*(round(side.value()) for side in self._sides)), int(self.binning.currentText() or 1))

    def begin(self, status: Status) -> None:
        """Fill in the area in force and open the dialog."""
        self._status = None
        self.show_status(status)
        self.show()

    def show_status(self, status: Status) -> None:
        """Show the area in force; refill the fields only if it has changed."""
        before, self._status = self._status, status
        allowed, area = status.capabilities, status.area
        is_new = before is None or (before.area, before.capabilities.sensor) != (area, allowed.sensor)
        pixels = f"{allowed.rows} x {allowed.columns} pixels"
        self.in_force.setText(f"In force: {area}; frames of {pixels}")
        whole = allowed.sensor or area.region
        steps = f", in steps of {allowed.region_step_px} px" if allowed.sensor is not None else ", always whole"
        self.limits.setText(f"Sensor: {whole.rows} x {whole.columns} pixels{steps}")
        for side in (*self._sides, self.around):
            side.setEnabled(allowed.sensor is not None)
        self.around.setEnabled(allowed.sensor is not None and status.lattice is not None)
        self.binning.setEnabled(len(allowed.binnings) > 1)
        if is_new:
            self.binning.clear()
            self.binning.addItems(list(map(str, allowed.binnings)))
            self.binning.setCurrentText(str(area.binning))
            self.fill(area.region)

    def fill(self, region: Region) -> None:
        """Fill in a region."""
        if self._status is None:
            return
        allowed = self._status.capabilities
        whole = allowed.sensor or region
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
            self.fill(self._status.capabilities.sensor)

    def _request_area(self) -> None:
        if all(side.commit() for side in self._sides):
            self.area_requested.emit(self.area)
