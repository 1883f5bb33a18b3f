"""Named presets of exposure, gain, current and mask: saved, applied and kept between starts."""

import json

from PyQt6.QtCore import QSettings
from PyQt6.QtWidgets import QDialog, QListWidget, QWidget

from app.gui.panels.controls import ControlsPanel
from app.gui.shell.controller import Controller
from app.gui.widgets.basics import Button, column, row
from app.gui.widgets.fields import TextField

_KEY = "presets/devices"  # of the settings
_NAMES = {"exposure_s": "exposure", "em_gain": "em_gain", "current_a": "current", "mask": "mask"}  # in the controls


class DevicePresets(QDialog):
    """Lists the presets; the measurement continues beside it."""

    def __init__(self, controller: Controller, controls: ControlsPanel, settings: QSettings, parent: QWidget) -> None:
        """Apply presets as the `controls` would."""
        super().__init__(parent)
        self._controller, self._controls, self._settings = controller, controls, settings
        self.setWindowTitle("Presets of exposure and mask")
        self.names = QListWidget()
        self.names.itemDoubleClicked.connect(lambda _: self._apply())
        self.name = TextField(tool_tip="Name of the preset", hint="name")
        self.save = Button("Save", "Save exposure, gain, current and mask in force under this name", self._save)
        self.apply = Button("Apply", "Set exposure, gain, current and mask of the chosen preset", self._apply)
        self.delete = Button("Delete", "Delete the chosen preset", self._delete)
        chosen = row(self.apply, self.delete, (QWidget(), 1), Button("Close", "Close (Esc)", self.close))
        lines = (self.names, 1), row((self.name, 1), self.save), chosen
        column(*lines, spacing=8, parent=self).setContentsMargins(12, 12, 12, 12)
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
        status, name = self._controller.status, self.name.text().strip()
        if status is not None and name:
            self._keep({**self._presets(), name: {key: getattr(status, key) for key in _NAMES}})

    def _delete(self) -> None:
        if (item := self.names.currentItem()) is not None:
            self._keep({name: values for name, values in self._presets().items() if name != item.text()})

    def _apply(self) -> None:
        status, item = self._controller.status, self.names.currentItem()
        if status is None or item is None:
            return
        values = self._presets()[item.text()]
        for key, name in _NAMES.items():
            if key in values and values[key] != getattr(status, key):  # a manual light takes no current
                self._controls.requested.emit(name, values[key])
