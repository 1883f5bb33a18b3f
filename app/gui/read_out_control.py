"""What stands between the read-out dialog and the acquisition: it says what the camera took, and what is left out."""

from __future__ import annotations

from PyQt6.QtWidgets import QWidget

from app.acquisition.instrument import Status
from app.acquisition.worker import Acquisition
from app.gui.answers import Answers
from app.gui.message_strip import MessageStrip
from app.gui.read_out_dialog import ReadOutDialog
from app.measurement.sensor_region import SensorArea, lenslets_outside


class ReadOutControl:
    """Has another part of the sensor read out."""

    def __init__(self, messages: MessageStrip, answers: Answers, parent: QWidget) -> None:
        self.dialog = ReadOutDialog(parent)
        self._messages, self._answers = messages, answers

    def open(self, status: Status | None) -> None:
        """Let the user fill in what is wanted."""
        if status is None:
            return
        if status.capabilities.sensor is None and len(status.capabilities.binnings) == 1:
            self._messages.warn(f"{status.camera_name} always reads out its whole sensor, and does not bin")
            return
        self.dialog.begin(status)

    def read_out(self, acquisition: Acquisition, area: SensorArea) -> None:
        """Ask for it; what is refused is told."""
        self._answers.expect(acquisition.set_area(area), lambda taken: self._tell(acquisition.status, taken))

    def _tell(self, status: Status | None, taken: SensorArea) -> None:
        self.dialog.close()  # so that the keys are the window's again
        is_good = status is not None and status.reference == "good"
        retake = "" if is_good else ": take dark (D) and reference (R) again"
        lattice = None if status is None else status.lattice
        if status is not None and lattice is not None:
            sensor = status.bench.sensor
            outside = lenslets_outside(lattice, sensor, taken)
            if outside:
                count = sensor.lenslet_rows * sensor.lenslet_columns
                self._messages.warn(f"{outside} of {count} lenslets do not lie wholly in the {taken}{retake}")
                return
        self._messages.tell(f"the camera reads out {taken}{retake}")
