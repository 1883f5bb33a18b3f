"""A step of the calibration as a button: its name, its state as a lamp, and its time or value."""

from PyQt6.QtCore import QEvent
from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QSizePolicy

from app.acquisition.kept_averages import Validity
from app.gui import theme
from app.gui.widgets import Button, Slot

_LAMPS: dict[Validity, QColor] = {"missing": theme.DIM, "doubtful": theme.AMBER, "good": theme.GREEN}


class StepButton(Button):
    """Takes its step when clicked, and shows whether that is needed."""

    def __init__(self, name: str, tool_tip: str, clicked: Slot, *, widest: str = "00:00") -> None:
        """Leave room for the `widest` time or value."""
        super().__init__(name, tool_tip, clicked)
        self._name, self._about = name, tool_tip
        self._shown: tuple[Validity, str, str] = ("missing", "", "")
        self.setProperty("role", "step")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        if widest:
            self.ensurePolished()
            self.show_step("missing", widest, "")
            self.setMinimumWidth(self.sizeHint().width())
        self.show_step("missing", "", "no frame yet")

    def show_step(self, validity: Validity, state: str, note: str) -> None:
        """Show a time or value beside the name, and a note in the tool tip."""
        if (validity, state, note) == self._shown:
            return
        self._shown = validity, state, note
        self.setText(f"{self._name}  {state}" if state else self._name)
        self._light_lamp()
        self.setToolTip(f"{self._about}\n\n{validity.capitalize()}: {note}" if note else self._about)

    def changeEvent(self, event: QEvent | None) -> None:  # noqa: N802 - Qt's name
        """Follow the theme."""
        super().changeEvent(event)
        if event is not None and event.type() == QEvent.Type.PaletteChange:
            self._light_lamp()

    def _light_lamp(self) -> None:
        validity, _, _ = self._shown
        is_good, is_missing = validity == "good", validity == "missing"
        self.setIcon(theme.validity_lamp(_LAMPS[validity], is_good=is_good, is_missing=is_missing))
