"""Pictures of the window in its main states, for the documentation and for looking at them: `make screenshots`.

Each screen is a process of its own, because Qt reads its size once.
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
from pathlib import Path

from PyQt6.QtCore import QEvent, QPoint, QRect, Qt
from PyQt6.QtGui import QAction, QColor, QImage, QPainter
from PyQt6.QtWidgets import QApplication, QDialog, QWidget

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Commands
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench
from app.gui.shell.main_window import MainWindow
from app.gui.widgets.theme import styled_application, use_theme
from app.results.player import InstrumentFactory, Player
from app.results.view_maps import Quantity
from support.paths import DOCS, ROOT
from support.window_tools import tabs, use_font

_WAIT_S = 300.0
_SETTLE_MS = 2000  # numbers, plots in the background and notices
# px, theme, size of texts in percent
_SCREENS = ((1440, 900, "dark", 100), (1280, 720, "light", 100), (1280, 720, "dark", 150), (1920, 1080, "light", 100))
_IN_DOCS = {
    "live": "window",
    "recorded": "window_recorded",
    "replay": "window_replay",
    "lenslet": "window_lenslet",
    "history": "window_history",
    "layers": "window_layers",
    "calibration": "window_calibration",
    "stale": "window_stale",
}
# Middles of the numbers of README and tour, shares of width and height: verdict, camera, controls, wavefronts, plots,
# messages, recording, status.
_PARTS = (
    *((0.365, 0.016), (0.245, 0.062), (0.385, 0.405), (0.94, 0.09)),
    *((0.27, 0.505), (0.6, 0.977), (0.72, 0.016), (0.88, 0.945)),
)
_DOCS_WIDTH = 1100  # px
_DIALOGS = ("Shortcuts and conventions…", "Message log…", "Documentation…", "About svwfs…", "Choose the sensor region…")


class Photographer:
    """Brings the window into each state and saves a picture of it, or of a dialog."""

    def __init__(self, application: QApplication, folder: Path) -> None:
        self._application, self._folder = application, folder.resolve()

    def take_all(self) -> None:
        """Take all pictures."""
        bench, elsewhere = load_bench("live_demo"), tempfile.mkdtemp()
        os.chdir(elsewhere)
        runs = Path("recordings")  # as the pictures show it
        window = self._open()
        self._save("no_bench", window)
        window.recording_bar.recordings_folder = runs
        window.open(InstrumentFactory(lambda: Acquisition(bench, open_devices)))
        self._wait(lambda: _is_live(window))
        self._wait(lambda: _is_corrected(window))
        self._save("live", window)
        self._record(window)
        self._replay(next(runs.iterdir()))
        self._show_panels(window)
        self._show_dialogs(window)
        self._show_messages(window)
        self._close(window)
        shutil.rmtree(elsewhere)

    def _record(self, window: MainWindow) -> None:
        bar = window.recording_bar
        bar.prepare()
        bar.name.setText("mouse 7")
        bar.note.setText("3 % agarose, second slice")
        bar.stop_after.setValue(40)
        window.recording_panel.record.click()
        self._wait(lambda: window.recording_panel.record.text() != "Record")
        self._save("recording", window, settle_ms=300)
        self._wait(lambda: bar.folder is not None)
        self._save("recorded", window)
        bar.done.click()

    def _replay(self, run: Path) -> None:
        player, replayed = Player(run), self._open()
        replayed.open(InstrumentFactory(player.acquisition, player.begin, player))
        self._wait(lambda: _is_live(replayed))
        replayed.replay.slider.setValue(20)
        self._wait(lambda: replayed.replay.play.text() == "Play")  # the frame is reconstructed
        self._save("replay", replayed)
        self._close(replayed)

    def _show_panels(self, window: MainWindow) -> None:
        wavefronts = window.panels.wavefronts
        for quantity in (Quantity.PSF, Quantity.UNCERTAINTY, Quantity.WAVEFRONT):
            wavefronts.choice.setCurrentText(quantity)
            self._save(quantity.lower(), window)
        window.panels.lenslet.inspect(7, 7)
        for name, panel in tabs(window).items():
            panel.front_requested.emit()
            analysis = window.analyses.of[panel]
            if panel.request() is not None:
                self._wait(lambda analysis=analysis: analysis.request is not None and not analysis.is_busy)  # type: ignore[misc] # mypy and defaults
            self._save(name.lower(), window)
        wavefronts.menu.change(views=9)
        self._save("nine_views", window)
        wavefronts.menu.change(views=None)
        wavefronts.enlarge()
        self._save_dialogs("enlarged", window)

    def _show_dialogs(self, window: MainWindow) -> None:
        for action in window.findChildren(QAction):
            if action.text() in _DIALOGS:
                action.trigger()
                self._save_dialogs(action.text().rstrip("…").lower().replace(" ", "_"), window)
        window.benches.edit()
        self._save_dialogs("settings", window)
        window.benches.open("missing.toml")
        self._wait(window.benches.dialog.isVisible)
        self._save_dialogs("faulty_bench", window)
        window.controls.calibrate.click()
        self._wait(lambda: window.guide.yes.isVisible() or window.guide.question.text().startswith("Calibrated"))
        self._save_dialogs("calibration", window)

    def _show_messages(self, window: MainWindow) -> None:
        self._wait(lambda: window.controller.is_settled)
        window.controls.lattice.click()
        self._wait(window.messages.accept.isVisible)
        self._save("proposal", window)
        window.messages.discard.click()
        window.controls.wanted.emit(Commands.set_exposure_s, 0.03)
        self._save("stale", window)
        window.controls.light.click()
        self._save("light_off", window)

    def _open(self) -> MainWindow:
        window, screen = MainWindow(), self._application.primaryScreen()
        window.show()
        if screen is not None:
            window.resize(screen.size())
            window.docks.restore_default()  # for this size
        return window

    def _close(self, window: MainWindow) -> None:
        window.close()
        window.deleteLater()
        self._application.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)

    def _save(self, name: str, widget: QWidget, *, settle_ms: int = _SETTLE_MS) -> None:
        _pause(settle_ms)
        if not widget.grab().save(str(self._folder / f"{name}.png")):
            raise OSError(f"{self._folder / name}.png cannot be written")

    def _save_dialogs(self, name: str, window: MainWindow) -> None:
        """Save and close what is open beside the window."""
        _pause(500)
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


def _is_live(window: MainWindow) -> bool:
    if window.controller.failure:
        raise RuntimeError(window.controller.failure)
    measurement = window.shown.measurement
    return measurement is not None and measurement.wavefront is not None and window.controller.is_settled


def _is_corrected(window: MainWindow) -> bool:
    """True if the layers are found and a correction, if the bench wants one, is applied."""
    measurement = window.shown.measurement
    if measurement is None or measurement.assumed.sample is None:
        return False
    return measurement.assumed.refinement.stage in {"off", "applied"}


def _pause(milliseconds: int) -> None:
    """Let the window work for a while."""
    end_s = time.monotonic() + milliseconds / 1e3
    while time.monotonic() < end_s:
        QApplication.processEvents()
        time.sleep(0.01)


def take(theme: str, percent: int, folder: Path) -> None:
    """Take the pictures of a screen in this process."""
    application = QApplication(sys.argv[:1])
    use_font(application)
    font = application.font()
    font.setPointSizeF(font.pointSizeF() * percent / 100)
    application.setFont(font)
    styled_application()
    use_theme(application, theme)
    folder.mkdir(parents=True, exist_ok=True)
    Photographer(application, folder).take_all()


def main(out: Path) -> None:
    """Take the pictures of all screens; copy what the documentation shows."""
    out.mkdir(parents=True, exist_ok=True)
    for width, height, theme, percent in _SCREENS:
        screen = {"name": "screen", "x": 0, "y": 0, "width": width, "height": height}
        (out / "screen.json").write_text(json.dumps({"screens": [screen]}))  # the usual one has 800 x 800 pixels
        environment = {**os.environ, "QT_QPA_PLATFORM": f"offscreen:configfile={out / 'screen.json'}"}
        environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
        folder = out / f"{width}x{height}-{theme}-{percent}"
        command = [sys.executable, "-m", "support.screenshots", "--theme", theme, str(percent), str(folder)]
        subprocess.run(command, check=True, env=environment)  # noqa: S603 - this script
        sys.stdout.write(f"{folder}\n")
    width, height, theme, percent = _SCREENS[0]
    for state, name in _IN_DOCS.items():
        picture = QImage(str(out / f"{width}x{height}-{theme}-{percent}" / f"{state}.png"))
        small = picture.scaledToWidth(min(_DOCS_WIDTH, picture.width()), Qt.TransformationMode.SmoothTransformation)
        if not small.save(str(DOCS / f"{name}.png")):
            raise OSError(f"{DOCS / name}.png cannot be written")
    numbered(QImage(str(DOCS / "window.png"))).save(str(DOCS / "window_parts.png"))


def numbered(picture: QImage) -> QImage:
    """Return the picture of the window with the numbers of its parts."""
    made = picture.convertToFormat(QImage.Format.Format_RGB32)
    painter = QPainter(made)
    painter.setRenderHint(QPainter.RenderHint.Antialiasing)
    font = painter.font()
    font.setPixelSize(17)
    font.setBold(True)
    painter.setFont(font)
    for number, (x, y) in enumerate(_PARTS, start=1):
        circle = QRect(0, 0, 24, 24)
        circle.moveCenter(QPoint(round(x * made.width()), round(y * made.height())))
        painter.setBrush(QColor("gold"))
        painter.setPen(QColor("black"))
        painter.drawEllipse(circle)
        painter.drawText(circle, Qt.AlignmentFlag.AlignCenter, str(number))
    painter.end()
    return made


if __name__ == "__main__":
    if sys.argv[1] == "--theme":
        take(sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]))
    else:
        main(Path(sys.argv[1]))
