"""Pictures of the window in every state, for the documentation and for looking at them: `make screenshots`.

Each variant of screen, language and theme runs in a process of its own, because Qt reads them once.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from PyQt6.QtCore import QEvent, QSize, Qt
from PyQt6.QtGui import QAction, QImage, QStyleHints
from PyQt6.QtWidgets import QApplication, QDialog, QWidget

from app.acquisition.devices import open_devices
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench
from app.gui.shell.access import Access
from app.gui.shell.main_window import MainWindow
from app.gui.widgets.theme import apply_theme
from app.results.player import Player
from app.results.view_analysis import Quantity
from support.paths import DOCS, ROOT
from support.screenshot_states import show_benches, show_calibration, show_export, show_other_windows, show_panel_states
from support.window_tools import tabs, use_font

_WAIT_S = 300.0
_SETTLE_MS = 2000  # numbers, plots in the background and notices
IN_DOCS = {"live": "window", "recorded": "window_recorded", "replay": "window_replay"}
_DOCS_WIDTH = 1100  # px


@dataclass(frozen=True, slots=True)
class Variant:
    """A screen with a language and a theme."""

    width: int  # px of the screen
    height: int
    scale: int = 1
    scheme: str = "dark"
    language: str = "en_GB.UTF-8"
    is_complete: bool = False  # every state, or only the main ones

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.width}x{self.height}@{self.scale}-{self.scheme}-{self.language[:2]}"

    @property
    def size(self) -> QSize:
        """Size of the window in Qt's logical pixels."""
        return QSize(self.width // self.scale, self.height // self.scale)


VARIANTS = (
    Variant(1440, 900, is_complete=True),
    Variant(1440, 900, scheme="light", is_complete=True),
    Variant(1280, 800, language="de_DE.UTF-8"),
    Variant(1280, 800, scheme="light"),
    Variant(2560, 1440),
    Variant(2560, 1440, scale=2),
    Variant(2560, 1440, scale=2, scheme="light", language="de_DE.UTF-8"),
)


class Photographer:
    """Brings the window into each state and saves a picture of it, or of a dialog."""

    def __init__(self, application: QApplication, variant: Variant, folder: Path) -> None:
        self._application, self._variant, self._folder = application, variant, folder.resolve()
        self._elsewhere = tempfile.mkdtemp()
        os.chdir(self._elsewhere)
        self._runs = Path("recordings")  # as the pictures show it

    def take_all(self) -> None:
        """Take the pictures of the variant."""
        bench = load_bench("live_demo")
        window = self._open(MainWindow())
        window.recording_bar.recordings_folder = self._runs
        window.open(Access(lambda: Acquisition(bench, open_devices)))
        self._wait(lambda: window.controller.status is not None)
        self._save("starting", window, settle_ms=0)
        self._wait(lambda: self._is_live(window))
        self._wait(lambda: self._is_corrected(window))
        self._save("live", window)
        self._show_recording(window)
        self._show_replay()
        if self._variant.is_complete:
            self._show_panels(window)
            show_panel_states(self, window)
            show_export(self, window)
            self._show_dialogs(window)
            show_calibration(self, window)
            show_benches(self, window)
            self._show_messages(window)
        self._close(window)
        if self._variant.is_complete:
            show_other_windows(self)
        shutil.rmtree(self._elsewhere)

    def _show_replay(self) -> None:
        (run,) = self._runs.iterdir()
        player = Player(run)
        replayed = self._open(MainWindow())
        replayed.open(Access(player.acquisition, player.begin, player))
        self._wait(lambda: self._is_live(replayed))
        replayed.replay.slider.setValue(20)
        self._save("replay", replayed)
        self._close(replayed)

    def _show_recording(self, window: MainWindow) -> None:
        bar = window.recording_bar
        bar.prepare()
        bar.name.setText("mouse 7")
        bar.note.setText("3 % agarose, second slice")
        bar.stop_after.setValue(40)
        self._save("before_recording", window)
        window.recording_panel.record.click()
        self._wait(lambda: window.recording_panel.record.text() != "Record")
        self._save("recording", window, settle_ms=300)
        self._wait(lambda: bar.folder is not None)
        self._save("recorded", window)
        bar.done.click()

    def _show_panels(self, window: MainWindow) -> None:
        window.panels.wavefronts.choice.setCurrentText(Quantity.PSF)
        self._save("psf", window)
        window.panels.wavefronts.choice.setCurrentText(Quantity.UNCERTAINTY)
        self._save("uncertainty", window)
        window.panels.wavefronts.choice.setCurrentText(Quantity.WAVEFRONT)
        for name, panel in tabs(window).items():
            if name == "Lenslet":
                window.panels.lenslet.inspect(7, 7)
            window.docks.show_panel(panel)
            if panel.has_own_thread:
                analysis = window.analyses.of[panel]
                self._wait(lambda analysis=analysis: analysis.request is not None and not analysis.is_busy)  # type: ignore[misc] # mypy and defaults
            self._save(name.lower(), window)
        window.panels.wavefronts.menu.change(views=9)
        window.status_line.toggle_times()
        self._save("nine_views_and_times", window)
        window.status_line.toggle_times()
        window.panels.wavefronts.menu.change(views=None)
        window.panels.wavefronts.enlarge()
        self._save_others("enlarged", window)

    def _show_dialogs(self, window: MainWindow) -> None:
        for action in window.findChildren(QAction):
            if action.text() in {
                "Shortcuts and conventions",
                "Message log",
                "Documentation",
                "How to cite",
                "About svwfs",
                "Choose the sensor region",
            }:
                action.trigger()
                self._save_others(action.text().lower().replace(" ", "_"), window)
        for menu in window.menuBar().actions():  # type: ignore[union-attr] # the window has one
            shown = menu.menu()
            if shown is not None:
                shown.popup(window.mapToGlobal(window.rect().topLeft()))
                _pause(200)
                self._save(f"menu_{menu.text().replace('&', '').lower()}", shown, settle_ms=0)
                shown.close()

    def _show_messages(self, window: MainWindow) -> None:
        window.controls.lattice.click()
        self._wait(window.messages.accept.isVisible)
        self._save("proposal", window)
        window.messages.discard.click()
        window.controls.exposure.edit()
        line = window.controls.exposure.lineEdit()
        if line is not None:
            line.setText("2000")
        self._save("refused_number", window, settle_ms=300)
        window.controls.exposure.clearFocus()
        window.controls.requested.emit("exposure_s", 0.03)
        self._save("stale", window)
        window.controls.light.click()
        self._save("light_off", window)
        window.messages.alarm("the recording ended early, 1200 frames are saved: the disk is full")
        self._save("alarm", window)
        window.messages.alarm("")
        window.resize(900, 640)
        self._save("smallest", window)

    def _open(self, window: MainWindow) -> MainWindow:
        window.show()
        window.resize(self._variant.size)
        return window

    def _close(self, window: MainWindow) -> None:
        window.close()
        window.deleteLater()
        self._application.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)

    def _is_live(self, window: MainWindow) -> bool:
        measurement = None if window.controller.acquisition is None else window.controller.acquisition.newest
        is_ready = measurement is not None and measurement.wavefront is not None and window.controller.is_settled
        if window.controller.failure:
            raise RuntimeError(window.controller.failure)
        return is_ready

    def _is_corrected(self, window: MainWindow) -> bool:
        """True if the layers are found and a correction is applied."""
        measurement = window.shown.measurement
        if measurement is None or measurement.assumed.sample is None:
            return False
        return measurement.assumed.refinement.stage == "applied"

    def _save(self, name: str, widget: QWidget, *, settle_ms: int = _SETTLE_MS) -> None:
        _pause(settle_ms)
        if not widget.grab().save(str(self._folder / f"{name}.png")):
            raise OSError(f"{self._folder / name}.png cannot be written")

    def _save_others(self, name: str, window: MainWindow) -> None:
        """Save and close what is open beside the window."""
        _pause(500)
        for widget in self._application.topLevelWidgets():
            if widget is not window and widget.isVisible() and widget.isWindow():
                self._save(name, widget)
                widget.close()
        for dialog in window.findChildren(QDialog):
            if dialog.isVisible():
                self._save(name, dialog)
                dialog.close()

    def _wait(self, condition: Callable[[], object]) -> None:
        deadline_s = time.monotonic() + _WAIT_S
        while not condition():
            if time.monotonic() > deadline_s:
                raise TimeoutError("the window does not come into this state")
            _pause(50)


def _pause(milliseconds: int) -> None:
    """Let the window work for a while."""
    end_s = time.monotonic() + milliseconds / 1e3
    while time.monotonic() < end_s:
        QApplication.processEvents()
        time.sleep(0.01)


def take(variant: Variant, folder: Path) -> None:
    """Take the pictures of a variant in this process."""
    application = QApplication(sys.argv[:1])
    use_font(application)
    scheme = Qt.ColorScheme.Light if variant.scheme == "light" else Qt.ColorScheme.Dark
    with patch.object(QStyleHints, "colorScheme", lambda _: scheme):  # the offscreen platform has none
        apply_theme(application)
    folder.mkdir(parents=True, exist_ok=True)
    Photographer(application, variant, folder).take_all()


def main(out: Path, *names: str) -> None:
    """Take all variants, or those named, each in a process; copy what the documentation shows."""
    out.mkdir(parents=True, exist_ok=True)
    for variant in VARIANTS:
        if names and variant.name not in names:
            continue
        screen = {"name": "screen", "x": 0, "y": 0, "width": variant.width, "height": variant.height}
        (out / "screen.json").write_text(json.dumps({"screens": [screen]}))  # the usual one has 800 x 800 pixels
        environment = {
            **os.environ,
            "QT_QPA_PLATFORM": f"offscreen:configfile={out / 'screen.json'}",
            "QT_SCALE_FACTOR": str(variant.scale),
            "LANG": variant.language,
            "LC_ALL": variant.language,
            "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
        }
        command = [sys.executable, __file__, "--variant", str(VARIANTS.index(variant)), str(out / variant.name)]
        subprocess.run(command, check=True, env=environment)  # noqa: S603 - this script
        sys.stdout.write(f"{out / variant.name}\n")
    if not names:
        for state, name in IN_DOCS.items():
            picture = QImage(str(out / VARIANTS[0].name / f"{state}.png"))
            small = picture.scaledToWidth(_DOCS_WIDTH, Qt.TransformationMode.SmoothTransformation)
            if not small.save(str(DOCS / f"{name}.png")):
                raise OSError(f"{DOCS / name}.png cannot be written")


if __name__ == "__main__":
    if sys.argv[1] == "--variant":
        take(VARIANTS[int(sys.argv[2])], Path(sys.argv[3]))
    else:
        main(Path(sys.argv[1]), *sys.argv[2:])
