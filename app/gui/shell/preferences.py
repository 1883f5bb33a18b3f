"""Preferences of the window: its theme and the size of its texts, kept between starts."""

from PyQt6.QtCore import QSettings
from PyQt6.QtWidgets import QApplication, QDialog, QFormLayout, QWidget

from app.gui.widgets import theme
from app.gui.widgets.basics import Button, Choice, label

_THEME, _SIZE = "preferences/theme", "preferences/text"  # keys of the settings
_SIZES = (80, 100, 125, 150)  # percent of the desktop's


def apply_preferences(application: QApplication, settings: QSettings) -> None:
    """Use the saved theme and size; before a window is made, because its panels measure their texts."""
    theme.use_theme(application, str(settings.value(_THEME, "system")))
    font, size = application.font(), str(settings.value(_SIZE, "100"))
    if size.isdecimal() and int(size) in _SIZES:
        font.setPointSizeF(font.pointSizeF() * int(size) / 100)
        application.setFont(font)


class PreferencesDialog(QDialog):
    """Changes the theme at once, and the size from the next start on."""

    def __init__(self, settings: QSettings, parent: QWidget) -> None:
        super().__init__(parent)
        self._settings = settings
        self.setWindowTitle("Preferences")
        self.theme = Choice(items=(("as the desktop", "system"), ("dark", "dark"), ("light", "light")))
        self.size_choice = Choice(items=[(f"{percent} %", str(percent)) for percent in _SIZES])
        for choice, key, usual in ((self.theme, _THEME, "system"), (self.size_choice, _SIZE, "100")):
            choice.setCurrentIndex(choice.findData(str(settings.value(key, usual))))
            choice.activated.connect(self._save)
        form = QFormLayout(self)
        form.addRow("Theme", self.theme)
        form.addRow("Size of texts", self.size_choice)
        form.addRow("", label("The size changes at the next start.", "dim"))
        form.addRow("", Button("Close", "Close (Esc)", self.close))

    def _save(self) -> None:
        self._settings.setValue(_THEME, self.theme.currentData())
        self._settings.setValue(_SIZE, self.size_choice.currentData())
        application = QApplication.instance()
        if isinstance(application, QApplication):
            theme.use_theme(application, self.theme.currentData())
