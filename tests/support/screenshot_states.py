"""States of the window that take some preparation, for `make screenshots`: calibration, benches, panels, export."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from PyQt6.QtWidgets import QApplication, QFileDialog, QLineEdit

from app.acquisition.worker import Acquisition
from app.bench.presets import PRESETS
from app.gui.shell.access import Access
from app.gui.shell.main_window import MainWindow
from drivers.manual_light import ManualLight, ManualLightSettings
from support.gui_bench import FakeCamera, opener
from support.manual_bench import MANUAL

if TYPE_CHECKING:
    from support.screenshots import Photographer

_TRUST = '[camera]\ndriver = "dcam"\nlibrary = "{}"\n[light]\ndriver = "manual"\n'
_CLIPPING_S, _USUAL_S = 0.1, 0.025


def show_calibration(of: Photographer, window: MainWindow) -> None:
    """Take the guide while it takes its steps, and when it has ended."""
    guide = window.guide
    window.controls.calibrate.click()
    of._wait(lambda: any("found" in one.text().lower() for one in guide.results.values()))
    of._save("calibration", guide, settle_ms=300)
    if guide.yes.isVisible():
        guide.yes.click()
    of._wait(lambda: guide.question.text().startswith("Calibrated"))
    of._save("calibrated", guide, settle_ms=300)
    guide.close()


def show_benches(of: Photographer, window: MainWindow) -> None:
    """Take the form of the settings, and the questions about benches that do not open at once."""
    benches = window.benches
    benches.edit()
    dialog = benches.settings_dialog
    assert dialog is not None
    of._save("settings", dialog, settle_ms=500)
    line = dialog.editors["sensor.lenslet_pitch_m"][1]
    assert isinstance(line, QLineEdit)
    line.setText("-99999")
    line.textEdited.emit("-99999")
    of._save("settings_refused", dialog, settle_ms=300)
    benches.make()
    of._wait(lambda: dialog._search is None)
    of._save("new_bench", dialog, settle_ms=300)
    dialog.close()
    with tempfile.TemporaryDirectory() as folder:
        for name, text in _faulty_benches(Path(folder)).items():
            (Path(folder) / f"{name}.toml").write_text(text)
            benches.open(str(Path(folder) / f"{name}.toml"))
            of._wait(benches.dialog.isVisible)
            of._save(name, benches.dialog, settle_ms=500)
            benches.dialog.close()


def _faulty_benches(folder: Path) -> dict[str, str]:
    text = PRESETS["small_demo"].read_text()
    (folder / "dcam.so").write_bytes(b"code")
    return {
        "faulty_bench": text.replace("wavelength_m = ", "wavelength_m = 1e9 # "),
        "untrusted_bench": text[: text.index("[camera]")] + _TRUST.format(folder / "dcam.so"),
    }


def show_panel_states(of: Photographer, window: MainWindow) -> None:
    """Take a pinned coefficient, all charts of the history, floating and closed panels, and a clipped frame."""
    tabs, docks = window.panels, window.docks
    docks.show_panel(tabs.coefficients)
    tabs.coefficients.pin(3)
    of._wait(lambda: tabs.coefficients.map.maps is not None)
    of._save("coefficients_pinned", window)
    tabs.coefficients.table_toggle.click()
    of._save("coefficients_table", window)
    tabs.coefficients.table_toggle.click()
    for toggle in tabs.history.toggles.values():
        toggle.setChecked(True)
    docks.show_panel(tabs.history)
    of._save("history_charts", window)
    tabs.coefficients.pin(None)
    for dock in docks.docks[:1] + docks.docks[3:4]:
        dock.setFloating(True)
    of._save("floating", window)
    of._save("floating_panel", docks.docks[3], settle_ms=0)
    for dock in docks.docks:
        dock.close()
    of._save("no_panels", window, settle_ms=300)
    docks.restore_default()
    window.controls.requested.emit("exposure_s", _CLIPPING_S)
    of._wait(lambda: "clipped" in window.panels.camera.caption.text())
    of._save("clipped", window)
    window.controls.requested.emit("exposure_s", _USUAL_S)
    of._wait(lambda: "clipped" not in window.panels.camera.caption.text())


def show_export(of: Photographer, window: MainWindow) -> None:
    """Take the window after an export, and the exported picture."""
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "wavefronts.png"
        with patch.object(QFileDialog, "getSaveFileName", lambda *_: (str(picture), "")):
            window.panels.wavefronts.export()
        of._save("exported", window)
        (of._folder / "exported_view.png").write_bytes(picture.read_bytes())


def show_other_windows(of: Photographer) -> None:
    """Take a window without a bench, and the question of a light that is switched by hand."""
    empty = of._open(MainWindow())
    of._save("no_bench", empty, settle_ms=300)
    of._close(empty)
    camera, bench = FakeCamera(), replace(MANUAL, light=ManualLightSettings())
    camera.light = ManualLight()  # type: ignore[assignment] # the camera sees whether it is on
    window = of._open(MainWindow())
    window.open(Access(lambda: Acquisition(bench, opener(camera))))
    of._wait(lambda: camera.is_running and window.controller.is_settled)
    window.controls.dark.click()
    QApplication.processEvents()
    of._save("manual_light", window)
    window.messages.discard.click()
    of._close(window)
