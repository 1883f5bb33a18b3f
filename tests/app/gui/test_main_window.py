"""Main window: measurements, their age, failures and progress."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from PyQt6.QtCore import Qt
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, FakeCamera, make_measurement, opener
from support.patience import HANG_S, own_time
from support.window_tools import LENSLETS, MakeWindow, count_pixels, dim_frame, press, views, wait_for_wavefront

from app.acquisition.worker import Acquisition
from app.gui.shell.help import TextDialog
from app.gui.shell.main_window import MainWindow
from app.gui.widgets import theme
from app.measurement.calibration import Calibration
from app.measurement.measurement import Assumptions, RefinementState
from app.results.player import InstrumentFactory
from drivers.interface import Disconnected
from reconstruction.displacement import LensletStatus
from reconstruction.reconstructor import Reconstructor


def test_shows_a_recorded_measurement_without_any_device(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    shown = views()
    shown[1, 2, 4, 5] = np.nan
    pixels = np.random.default_rng(2).integers(0, 4000, (300, 430), np.uint16)
    window.show_measurement(make_measurement(pixels, shown))

    count_pixels(qtbot, window)
    black, white = np.percentile(pixels, (1, 99.8))
    expected = np.clip((pixels - black) / (white - black), 0, 1) * 255
    image = window.panels.camera._image
    for channel in (0, 8, 16):  # grey
        np.testing.assert_allclose(image.colours(image.counts) >> channel & 0xFF, expected, atol=1)
    qtbot.waitUntil(lambda: len(window.panels.wavefronts.grid.captions) == 9)
    captions = window.panels.wavefronts.grid.captions
    for (row, column), (numbers, place) in captions.items():
        view = shown[row, column]
        rms = np.sqrt(np.nanmean((view - np.nanmean(view)) ** 2))
        assert numbers[0] == f"RMS {rms:#.3g} rad, PV {np.nanmax(view) - np.nanmin(view):#.3g}"
        x, y = ("\N{MINUS SIGN}0.50", "0", "+0.50")[column], ("\N{MINUS SIGN}0.50", "0", "+0.50")[row]
        assert place[0] == f"x {x}  y {y} mm"


def test_lost_lenslets_are_counted_by_reason(make_window: MakeWindow) -> None:
    window = make_window()
    shown = window.verdict
    for lost_rows, text, colour in (
        (0, "117 of 117", theme.GREEN),
        (2, "91 of 117", theme.AMBER),
        (5, "52 of 117", theme.RED),
    ):
        outcome = np.zeros(LENSLETS, np.int8)
        outcome[:lost_rows] = LensletStatus.DARK
        outcome[:lost_rows, 0] = LensletStatus.SATURATED
        window.show_measurement(make_measurement(dim_frame(), views(), outcome=outcome))
        window.update_text()
        assert shown.valid == text
        assert text in shown.text()
        assert shown.property("tone") == theme.tone(colour)
        assert (f"{12 * lost_rows} lost: no light</p><p>{lost_rows} lost: saturated" in shown.toolTip()) == (
            lost_rows > 0
        )


@pytest.mark.slow
@pytest.mark.long
def test_frame_without_wavefront_shows_reason_and_no_old_wavefront(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, _ = live
    window.controls.light.click()
    qtbot.waitUntil(lambda: window.messages.text.text() == "The light is off: switch it on (L)")
    assert window.panels.wavefronts.grid.maps is None
    assert window.verdict.valid == "\N{EN DASH}"


@pytest.mark.slow
@pytest.mark.long
def test_device_failure_is_shown_and_window_reconnects(make_window: MakeWindow, qtbot: QtBot) -> None:
    first, second = FakeCamera(), FakeCamera()
    window = make_window(first, second)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    assert not window.messages.reconnect.isVisible()
    first.fault = Disconnected("the camera was unplugged")
    qtbot.waitUntil(lambda: "camera was unplugged" in window.messages.text.text())
    assert not first.light.shines
    assert window.controls.light.text() == "Light off"
    assert not window.controls.isEnabled()
    window.messages.reconnect.click()
    wait_for_wavefront(qtbot, window)
    assert second.light.is_on
    qtbot.waitUntil(lambda: "unplugged" not in window.messages.text.text())
    assert not window.messages.reconnect.isVisible()
    assert window.controls.isEnabled()


@pytest.mark.slow
def test_light_that_does_not_answer_is_not_called_off(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, camera = live

    def fail(**_: object) -> None:
        raise Disconnected("the light was unplugged")

    for request in ("_switch", "_is_lit"):
        monkeypatch.setattr(camera.light, request, fail)
    qtbot.waitUntil(lambda: "light may still be on" in window.messages.text.text())
    assert window.controls.light.text() == "Light not reached"


@pytest.mark.slow
@pytest.mark.long
def test_status_line_shows_nothing_old_while_a_bench_opens(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    line = window.status_line
    qtbot.waitUntil(lambda: line.rate.text() != "\N{EN DASH}" and line.devices.text() == "running")
    window.open(InstrumentFactory(lambda: Acquisition(BENCH, opener(FakeCamera()))))
    shown = [label.text() for label in (line.rate, line.delay, line.lost, line.devices)]
    assert shown == ["\N{EN DASH}"] * 2 + ["0", ""]
    assert window.verdict.valid == "\N{EN DASH}"
    qtbot.waitUntil(lambda: line.devices.text() == "running")
    qtbot.waitUntil(lambda: line.devices.width() >= line.devices.sizeHint().width())


def test_times_are_told_in_milliseconds_and_seconds(make_window: MakeWindow) -> None:
    line = make_window().status_line
    for seconds, text in ((0.0123, "12.3 ms"), (4.56, "4.6 s")):
        line.restart()
        line.count(replace(make_measurement(dim_frame(), views()), latency_s=seconds))
        line.update_text(None)
        assert line.delay.text() == text


@pytest.mark.parametrize(("age_s", "is_old"), [(2.0, False), (120.0, True)])
def test_old_correction_is_called_old(make_window: MakeWindow, age_s: float, is_old: bool) -> None:
    window = make_window()
    assumed = Assumptions(refinement=RefinementState("applied", age_s, 0.1))
    window.show_measurement(replace(make_measurement(dim_frame(), views()), assumed=assumed))
    window.update_text()
    assert f"Correction: {age_s:.1f} s old{', which is old' * is_old};" in window.verdict.toolTip()


@pytest.mark.slow
@pytest.mark.long
def test_routine_shows_its_progress_and_can_be_cancelled(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.controls.frames.setValue(10_000)
    window.controls.reference.click()
    progress = window.messages.progress
    qtbot.waitUntil(lambda: progress.isVisible() and progress.value() > 0)
    qtbot.waitUntil(lambda: window.messages.text.text() == "Taking the reference, 10000 frames: Esc cancels")
    assert "reference" not in progress.text()  # the message names it
    press(qtbot, window, Qt.Key.Key_Escape)
    qtbot.waitUntil(lambda: "ancelled" in window.messages.text.text())
    qtbot.waitUntil(lambda: camera.is_running and camera.stage.is_sample_in)
    qtbot.waitUntil(lambda: not window.messages.progress.isVisible())


@pytest.mark.slow
@pytest.mark.long
def test_compilation_after_the_reference_is_explained(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    release = threading.Event()
    prepare = Calibration.reconstructor

    def compile_slowly(calibration: Calibration) -> Reconstructor:
        release.wait(HANG_S)
        return prepare(calibration)

    monkeypatch.setattr(Calibration, "reconstructor", compile_slowly)
    window.controls.reference.click()
    messages = window.messages
    qtbot.waitUntil(lambda: messages.text.text().startswith("Preparing the reconstruction with the new reference;"))
    assert "after an installation" in messages.text.text()
    assert "Esc" not in messages.text.text() + messages.progress.toolTip()
    assert messages.progress.isVisible()
    assert messages.progress.maximum() == 0  # busy, not 100 %
    assert messages.cancel.isHidden()
    release.set()
    qtbot.waitUntil(lambda: messages.text.text().startswith("Reference taken: mean of 20 frames; "))


@pytest.mark.slow
@pytest.mark.long
def test_slow_redraw_shows_the_newest_frame(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, camera = live
    camera.period_s = 0.04
    drawn: list[int] = []
    newest_before: list[int] = []  # at the end of the previous drawing
    draw = window.panels.wavefronts.show_wavefront

    def draw_slowly(wavefront: object) -> None:
        assert window.shown.measurement is not None
        drawn.append(window.shown.measurement.frame.index)
        time.sleep(0.2)
        draw(wavefront)  # type: ignore[arg-type] # passed through
        assert window.controller.acquisition is not None
        assert window.controller.acquisition.newest is not None
        newest_before.append(window.controller.acquisition.newest.frame.index)

    monkeypatch.setattr(window.panels.wavefronts, "show_wavefront", draw_slowly)
    qtbot.waitUntil(lambda: len(newest_before) >= 15)
    assert all(later >= newest for later, newest in zip(drawn[1:], newest_before, strict=False))
    behind = np.median(np.subtract(newest_before, drawn))  # counted in frames: a slow computer has fewer of them
    assert 0 < behind < 0.3 / camera.period_s
    line = window.status_line  # it counts from another start: the two may meet, but not stay together
    qtbot.waitUntil(lambda: line._newest is not None and line._newest.counts.acquired != line.shown)


@pytest.mark.slow
def test_closing_during_long_exposure_is_quick_and_turns_light_off(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, camera = live
    window.controls.exposure.setValue(8000)
    qtbot.waitUntil(lambda: camera.exposure_s == 8)
    assert camera.light.is_on
    with own_time() as elapsed_s:
        window.close()
        assert elapsed_s() < 4  # half an exposure
    assert not camera.light.shines
    assert camera.is_closed
    assert not window.controller.is_stuck


@pytest.mark.slow
def test_nothing_is_opened_beside_a_device_that_hangs(
    live: tuple[MainWindow, FakeCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    window, camera = live
    before = window.controller.acquisition
    with monkeypatch.context() as hanging:
        hanging.setattr("app.gui.shell.controller.CLOSING_S", 0.2)
        hanging.setattr(Acquisition, "is_alive", True)
        window.open(InstrumentFactory(lambda: Acquisition(BENCH, opener(FakeCamera()))))
    assert window.controller.acquisition is before
    assert "A device or a computation did not end within 45 s" in window.messages.log
    assert window._timer.isActive()
    assert not camera.light.shines
    window.open(InstrumentFactory(lambda: Acquisition(BENCH, opener(FakeCamera()))))  # it has ended
    assert window.controller.acquisition is not before


def test_keys_are_unique_and_help_opens(make_window: MakeWindow) -> None:
    window = make_window()
    entries = [
        action for menu in window.menu_bar.actions() if (inner := menu.menu()) is not None for action in inner.actions()
    ]
    keys = [key for entry in entries if (key := entry.shortcut().toString())]
    assert len(set(keys)) == len(keys)
    assert {"Space", "L", "S", "D", "R", "Esc", "Ctrl+E"} <= set(keys)
    next(entry for entry in entries if entry.shortcut().toString() == "F1").trigger()
    dialog = window.findChildren(TextDialog, "help")[0]
    assert dialog.isVisible()
    assert "Ctrl+L" in dialog.view.toPlainText()  # the help's own keys, too
    scroll_bar = dialog.view.horizontalScrollBar()
    assert scroll_bar is not None
    assert not scroll_bar.maximum()  # nothing is cut off
    dialog.close()
