"""Dialog of the sensor region and the binning."""

from PyQt6.QtWidgets import QDialog, QFormLayout, QWidget

from app.acquisition.instrument import Status
from app.gui.shell.controller import Controller
from app.gui.shell.status_text import area_taken
from app.gui.widgets.buttons import Button, Choice, close_button
from app.gui.widgets.fields import NumberField
from app.gui.widgets.layouts import fill_dialog, row
from app.gui.widgets.texts import label
from app.measurement.sensor_region import SensorArea, in_steps, region_around
from drivers.interface import Range, Region

_SIDES = {
    "First row": "First row that is read out",
    "First column": "First column that is read out",
    "Rows": "Number of rows",
    "Columns": "Number of columns",
}


class SensorRegionDialog(QDialog):
    """Sets the area; shows the one in force and what the camera allows."""

    def __init__(self, controller: Controller, parent: QWidget) -> None:
        super().__init__(parent)
        self.setWindowTitle("Sensor region and binning")
        self._controller, self._messages = controller, controller.messages
        self._status: Status | None = None
        self._sides = [
            NumberField(name=name, unit="px", tool_tip=f"{about}. Unbinned pixels; rounded to the camera's steps")
            for name, about in _SIDES.items()
        ]
        self.binning = Choice("Sensor pixels per frame pixel, along both axes")
        self.limits, self.in_force = label("", "dim"), label("", "dim")
        self.whole = Button("Whole sensor", "Fill in the whole sensor", lambda: self.fill(self._sensor))
        about = "Fill in all lenslets with a margin of half a pitch"
        self.around = Button("Around the lattice", about, self._fill_around)
        self.apply = Button("Apply", "Set the region; then take a new dark (D) and reference (R)", self._set_area)
        self.apply.setDefault(True)
        close = close_button(self, "Change nothing (Esc)")
        form = QFormLayout()
        for name, field in zip((*_SIDES, "Binning"), (*self._sides, self.binning), strict=True):
            form.addRow(label(f"{name} (px)", "dim"), field)
        fills, ends = row((self.whole, 1), (self.around, 1)), row((self.apply, 1), (close, 1))
        fill_dialog(self, self.limits, form, fills, self.in_force, ends)

    @property
    def area(self) -> SensorArea:
        return SensorArea(Region(*(round(side.value()) for side in self._sides)), int(self.binning.currentText() or 1))

    def begin(self) -> None:
        """Fill in the area in force and open the dialog, if there is anything to choose."""
        if (status := self._controller.status) is None:
            return
        if status.capabilities.sensor is None and len(status.capabilities.binnings) == 1:
            self._messages.warn(f"{status.camera_name} always reads out its whole sensor and cannot bin")
            return
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

    @property
    def _sensor(self) -> Region | None:
        return None if self._status is None else self._status.capabilities.sensor

    def fill(self, region: Region | None) -> None:
        if self._status is None or region is None:
            return
        allowed = self._status.capabilities
        whole = allowed.sensor or region
        values, most = (region.top, region.left, region.rows, region.columns), (whole.rows, whole.columns)
        for side, value, limit in zip(self._sides, values, most * 2, strict=True):
            side.setSingleStep(allowed.region_step_px)
            side.show_value(value, Range(0, limit))

    def _fill_around(self) -> None:
        status, sensor = self._status, self._sensor
        if status is not None and status.lattice is not None and sensor is not None:
            region = region_around(status.lattice, status.bench.sensor, status.area)
            self.fill(in_steps(region, sensor, status.capabilities.region_step_px))

    def _set_area(self) -> None:
        if all(side.commit() for side in self._sides):
            area = self.area
            self._controller.send(lambda to: to.set_area(area), self._show_taken)

    def _show_taken(self, area: SensorArea) -> None:
        self.close()  # returns the keys to the window
        if (status := self._controller.status) is not None:
            text, is_whole = area_taken(status, area)
            (self._messages.inform if is_whole else self._messages.warn)(text)
