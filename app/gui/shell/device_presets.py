"""Named presets of exposure, gain, current and mask, and their dialog."""

import json

from PyQt6.QtCore import QSettings
from PyQt6.QtGui import QShowEvent
from PyQt6.QtWidgets import QDialog, QListWidget, QWidget

from app.gui.panels.controls import ControlsPanel
from app.gui.shell.controller import Controller
from app.gui.widgets.buttons import Button
from app.gui.widgets.fields import TextField
from app.gui.widgets.layouts import column, row
from app.gui.widgets.texts import label

_KEY = "presets/devices"  # of the settings
_ABOUT = "A preset keeps exposure, gain, current and mask: type a name, and save those in force."
_SETTINGS = {"exposure_s": int | float, "em_gain": int | float, "current_a": int | float, "mask": str}


class DevicePresets(QDialog):
    """Lists presets of exposure, gain, current and mask, which are kept between starts: saves, applies and deletes."""

    def __init__(self, controller: Controller, controls: ControlsPanel, settings: QSettings, parent: QWidget) -> None:
        """Apply presets as the `controls` would."""
        super().__init__(parent)
        self._controller, self._controls, self._settings = controller, controls, settings
        self.setWindowTitle("Presets of exposure and mask")
        self.names = QListWidget()
        self.names.currentItemChanged.connect(self._enable)
        self.names.itemDoubleClicked.connect(lambda _: self._apply())
        self.about = label("", "dim", wraps=True)
        self.about.setMinimumWidth(380)  # px: the title fits
        self.name = TextField(tool_tip="Name of the preset", hint="name")
        self.name.textChanged.connect(self._enable)
        self.save = Button("Save", "Save exposure, gain, current and mask in force under this name", self._save)
        self.apply = Button("Apply", "Set exposure, gain, current and mask of the chosen preset", self._apply)
        self.delete = Button("Delete", "Delete the chosen preset", self._delete)
        chosen = row(self.apply, self.delete, (QWidget(), 1), Button("Close", "Close (Esc)", self.close))
        lines = self.about, (self.names, 1), row((self.name, 1), self.save), chosen
        column(*lines, spacing=8, parent=self).setContentsMargins(12, 12, 12, 12)
        self._list()

    def _presets(self) -> dict[str, dict[str, object]]:
        """Presets that can be applied: the file may have been edited by hand."""
        try:
            found = json.loads(str(self._settings.value(_KEY, "{}")))
        except ValueError:
            return {}
        presets = found.items() if isinstance(found, dict) else ()
        return {name: values for name, values in presets if isinstance(values, dict) and _can_be_set(values)}

    def _keep(self, presets: dict[str, dict[str, object]]) -> None:
        self._settings.setValue(_KEY, json.dumps(presets))
        self._list()

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802 - Qt's name
        super().showEvent(event)
        self._enable()

    def _enable(self, *_: object) -> None:
        is_open, is_chosen = self._controller.status is not None, self.names.currentItem() is not None
        self.save.setEnabled(is_open and bool(self.name.text().strip()))
        self.apply.setEnabled(is_open and is_chosen)
        self.delete.setEnabled(is_chosen)

    def _list(self) -> None:
        self.names.clear()
        self.about.setText(_ABOUT if self._presets() else f"There are no presets yet. {_ABOUT}")
        for name, values in self._presets().items():
            self.names.addItem(name)
            if (item := self.names.item(self.names.count() - 1)) is not None:
                item.setToolTip("\n".join(f"{key} {value}" for key, value in values.items()))
        self._enable()

    def _save(self) -> None:
        status, name = self._controller.status, self.name.text().strip()
        if status is not None and name:
            self._keep({**self._presets(), name: {name: getattr(status, name) for name in _SETTINGS}})

    def _delete(self) -> None:
        if (item := self.names.currentItem()) is not None:
            self._keep({name: values for name, values in self._presets().items() if name != item.text()})

    def _apply(self) -> None:
        status, item = self._controller.status, self.names.currentItem()
        if status is None or item is None:
            return
        values = self._presets()[item.text()]
        for name in _SETTINGS:
            if values.get(name) not in {None, getattr(status, name)}:  # a manual light takes no current
                self._controls.requested.emit(name, values[name])


def _can_be_set(values: dict[str, object]) -> bool:
    """Return True if the values are of the right kinds; None stands for what a device does not have."""
    return all(isinstance(values.get(name), kind | None) for name, kind in _SETTINGS.items())
