"""Named presets of exposure, gain, current and mask: saved, applied and kept between starts."""

import json
from collections.abc import Callable

from PyQt6.QtCore import QSettings
from PyQt6.QtWidgets import QDialog, QListWidget, QWidget

from app.acquisition.instrument import Status
from app.gui.controls_panel import ControlsPanel
from app.gui.text_field import TextField
from app.gui.widgets import button, column, row

_KEY = "presets/devices"  # of the settings


class DevicePresets(QDialog):
    """Lists the presets; the measurement continues beside it."""

    def __init__(
        self, status: Callable[[], Status | None], controls: ControlsPanel, settings: QSettings, parent: QWidget
    ) -> None:
        """Apply presets as the `controls` would."""
        super().__init__(parent)
        self._status, self._controls, self._settings = status, controls, settings
        self.setWindowTitle("Presets of exposure and mask")
        self.names = QListWidget()
        self.names.itemDoubleClicked.connect(lambda _: self._apply())
        self.name = TextField(tool_tip="Name of the preset", hint="name")
        self.save = button("Save", "Save exposure, gain, current and mask in force under this name", self._save)
        self.apply = button("Apply", "Set exposure, gain, current and mask of the chosen preset", self._apply)
        self.delete = button("Delete", "Delete the chosen preset", self._delete)
        chosen = row(self.apply, self.delete, (QWidget(), 1), button("Close", "Close (Esc)", self.close))
        column((self.names, 1), row((self.name, 1), self.save), chosen, spacing=8, parent=self)
        if (layout := self.layout()) is not None:
            layout.setContentsMargins(12, 12, 12, 12)
        self._list()

    def _presets(self) -> dict[str, dict[str, object]]:
        try:
            found = json.loads(str(self._settings.value(_KEY, "{}")))
        except ValueError:  # edited by hand
            return {}
        return found if isinstance(found, dict) else {}

    def _keep(self, presets: dict[str, dict[str, object]]) -> None:
        self._settings.setValue(_KEY, json.dumps(presets))
        self._list()

    def _list(self) -> None:
        self.names.clear()
        for name, values in self._presets().items():
            self.names.addItem(name)
            if (item := self.names.item(self.names.count() - 1)) is not None:
                item.setToolTip("\n".join(f"{key} {value}" for key, value in values.items()))

    def _save(self) -> None:
        status, name = self._status(), self.name.text().strip()
        if status is None or not name:
            return
        now = {"exposure_s": status.exposure_s, "em_gain": status.em_gain, "current_a": status.current_a}
        self._keep({**self._presets(), name: {**now, "mask": status.mask}})

    def _delete(self) -> None:
        if (item := self.names.currentItem()) is not None:
            self._keep({name: values for name, values in self._presets().items() if name != item.text()})

    def _apply(self) -> None:
        status, item = self._status(), self.names.currentItem()
        if status is None or item is None:
            return
        values = self._presets()[item.text()]
        requests = {
            "exposure_s": (self._controls.exposure_requested, status.exposure_s),
            "em_gain": (self._controls.em_gain_requested, status.em_gain),
            "current_a": (self._controls.current_requested, status.current_a),
            "mask": (self._controls.mask_requested, status.mask),
        }
        for key, (request, now) in requests.items():
            if key in values and values[key] != now:  # a manual light takes no current
                request.emit(values[key])
