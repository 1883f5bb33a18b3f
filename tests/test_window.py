"""The window: it shows what was measured, where it was measured, and asks the instrument for what its user wants."""

import gc
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gui_bench import BENCH, FULL_SCALE, LATTICE, SENSOR, FakeCamera, make_measurement, opener
from numpy.typing import NDArray
from PyQt6.QtCore import QEvent, QPoint, QRect, Qt, QTimer
from PyQt6.QtGui import QColor, QImage
from PyQt6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot

from app.acquisition import Acquisition, Measurement
from app.errors import Interrupted, RunError
from app.gui import theme
from app.gui.live import run_live
from app.gui.main_window import MainWindow
from app.gui.scale import MAGNIFICATIONS, RANGES, SteppedScale
from app.instrument import Standing
from drivers.interface import Disconnected
from reconstruction.displacement import Outcome
from reconstruction.geometry import Floats

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
pytestmark = pytest.mark.qt_log_ignore("propagateSizeHints")  # the offscreen platform says it of every window

MakeWindow = Callable[..., MainWindow]

LENSLETS = (SENSOR.lenslet_rows, SENSOR.lenslet_columns)


@pytest.fixture
def make_window(qapp: QApplication) -> Iterator[MakeWindow]:
    """Make windows that are closed at the end, whatever happens; none of their widgets may survive."""
    windows: list[MainWindow] = []

    def make(*cameras: FakeCamera) -> MainWindow:
        spare = iter(cameras)
        window = MainWindow(lambda: Acquisition(BENCH, opener(next(spare))))
        window.resize(1000, 760)
        window.show()
        windows.append(window)
        return window

    yield make
    for window in windows:
        window.close()
        window.deleteLater()
    windows.clear()
    qapp.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)
    gc.collect()
    assert not qapp.topLevelWidgets()


@pytest.fixture
def live(make_window: MakeWindow, qtbot: QtBot) -> tuple[MainWindow, FakeCamera]:
    """A window with live wavefronts."""
    camera = FakeCamera()
    window = make_window(camera)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    return window, camera


def wait_for_wavefront(qtbot: QtBot, window: MainWindow) -> None:
    qtbot.waitUntil(lambda: window.status_line.valid.text() == "117 of 117", timeout=10_000)
    qtbot.waitUntil(lambda: not window._pending, timeout=10_000)


def press(qtbot: QtBot, widget: QWidget, key: Qt.Key) -> None:
    qtbot.keyClick(widget, key)  # type: ignore[no-untyped-call] # pytest-qt declares no types for it


def picture(widget: QWidget) -> NDArray[np.uint8]:
    """What is seen of a widget, (row, column, rgb)."""
    image = widget.grab().toImage().convertToFormat(QImage.Format.Format_RGB888)
    data = image.constBits()
    assert data is not None
    lines = np.frombuffer(bytes(data.asarray(image.sizeInBytes())), np.uint8).reshape(image.height(), -1)
    return lines[:, : 3 * image.width()].reshape(image.height(), image.width(), 3)


def part(seen: NDArray[np.uint8], where: QRect) -> NDArray[np.uint8]:
    return seen[where.top() : where.bottom() + 1, where.left() : where.right() + 1]


def views(seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(0, 2, (3, 3, *LENSLETS))


def dim_frame() -> NDArray[np.uint16]:
    return np.full((300, 430), 1000, np.uint16)


def test_shows_a_recorded_measurement_without_any_device(make_window: MakeWindow) -> None:
    window = make_window()
    shown = views()
    shown[1, 2, 4, 5] = np.nan
    pixels = np.random.default_rng(2).integers(0, 4000, (300, 430), np.uint16)
    window.show_measurement(make_measurement(pixels, shown))

    np.testing.assert_array_equal(window.camera_panel._image.image, pixels)
    captions = window.wavefront_panel.grid.captions
    assert len(captions) == 9
    for (row, column), (numbers, place) in captions.items():
        view = shown[row, column]
        rms = np.sqrt(np.nanmean((view - np.nanmean(view)) ** 2))
        assert numbers == f"RMS {rms:.2f}   PV {np.nanmax(view) - np.nanmin(view):.2f}"
        x, y = ("\N{MINUS SIGN}0.50", "0", "+0.50")[column], ("\N{MINUS SIGN}0.50", "0", "+0.50")[row]
        assert place == f"x {x}  y {y} mm"


def test_camera_image_lies_as_on_the_camera(make_window: MakeWindow) -> None:
    window = make_window()
    window.camera_panel.arrows_toggle.setChecked(False)
    pixels = dim_frame()
    pixels[:60, -40:] = 60000  # the upper right corner: row 0 is on top, column 0 on the left
    window.show_measurement(make_measurement(pixels, views()))
    graphics = window.camera_panel._graphics
    QApplication.processEvents()
    seen = picture(graphics).min(axis=2)
    row, column = np.nonzero(seen > 200)
    middle = graphics.rect().center()
    assert row.size > 400
    assert column.min() > middle.x() + 0.3 * graphics.width()
    assert row.max() < middle.y()
    width, height = np.ptp(column) + 1, np.ptp(row) + 1
    assert width / height == pytest.approx(40 / 60, rel=0.1)


def test_views_lie_as_in_the_field_and_lenslets_as_in_the_pupil(make_window: MakeWindow) -> None:
    window = make_window()
    shown = np.zeros((3, 3, *LENSLETS))
    shown[0, 2, 1, 10] = 5.0  # the view on top at the right; in it a lenslet in the second row, near the right edge
    window.show_measurement(make_measurement(dim_frame(), shown))
    window.wavefront_panel._limit.value = 5.0
    window.wavefront_panel.grid.show_views(shown, 5.0)
    grid = window.wavefront_panel.grid
    seen = picture(grid).astype(int)
    tiles = grid.tile(0, 0).united(grid.tile(2, 2))
    red = (seen[..., 0] - seen[..., 2] > 120)[:, : tiles.right() + 1]
    row, column = np.nonzero(red)
    assert row.size > 20
    x = (column.mean() + 0.5 - tiles.left()) / tiles.width()
    y = (row.mean() + 0.5 - tiles.top()) / tiles.height()
    assert x == pytest.approx(2 / 3 + 10.5 / 13 / 3, abs=0.03)
    assert y == pytest.approx(1.5 / 9 / 3, abs=0.03)


def test_positive_is_red_and_negative_is_blue(make_window: MakeWindow) -> None:
    window = make_window()
    shown = np.zeros((3, 3, *LENSLETS))
    shown[1, 0], shown[1, 2] = -2, 2
    grid = window.wavefront_panel.grid
    grid.show_views(shown, 2.0)
    seen = picture(grid).astype(int)
    left, middle, right = (part(seen, grid.tile(1, column)).mean(axis=(0, 1)) for column in range(3))
    assert left[2] > left[0] + 100
    assert right[0] > right[2] + 100
    assert abs(middle[0] - middle[2]) < 20


def test_lost_lenslet_is_hatched_and_never_drawn_as_zero(make_window: MakeWindow) -> None:
    window = make_window()
    shown = np.zeros((3, 3, *LENSLETS))
    shown[1, 1, 2, 3] = np.nan
    window.show_measurement(make_measurement(dim_frame(), shown))
    grid = window.wavefront_panel.grid
    tile = part(picture(grid).astype(int), grid.tile(1, 1))
    step_y, step_x = tile.shape[0] / LENSLETS[0], tile.shape[1] / LENSLETS[1]
    lost = tile[int(2.25 * step_y) : int(2.75 * step_y), int(3.25 * step_x) : int(3.75 * step_x)]
    zero = tile[int(5.25 * step_y) : int(5.75 * step_y), int(3.25 * step_x) : int(3.75 * step_x)]
    assert zero.min() > 200  # the middle of the colours is nearly white
    assert lost.max() < 150
    assert "lost" in grid._value_at(grid.tile(1, 1).topLeft() + QPoint(int(3.5 * step_x), int(2.5 * step_y)))


def test_lost_lenslet_is_crossed_out_where_it_lies_and_says_why(make_window: MakeWindow) -> None:
    window = make_window()
    outcome = np.zeros(LENSLETS, np.int8)
    outcome[1, 10] = Outcome.SATURATED
    panel = window.camera_panel
    panel.show_bench(SENSOR, LATTICE, FULL_SCALE)
    window.show_measurement(make_measurement(dim_frame(), views(), outcome=outcome))
    QApplication.processEvents()
    seen = picture(panel._graphics).astype(int)
    row, column = np.nonzero((seen[..., 0] > 200) & (seen[..., 2] < 130))
    center = panel._view.mapSceneToView(QPoint(round(column.mean()), round(row.mean())).toPointF())
    expected = LATTICE.lenslet_centers_px(*LENSLETS)[1, 10]
    assert (center.x(), center.y()) == pytest.approx(tuple(expected), abs=2.0)
    panel._point_at(panel._view.mapViewToScene(center))
    assert "row 1, column 10: saturated" in panel.caption.text()
    panel._point_at(panel._view.mapViewToScene(center + QPoint(31, 0).toPointF()))
    assert panel.caption.text().endswith("lenslet row 1, column 11")


def test_arrows_point_where_the_light_has_moved(make_window: MakeWindow) -> None:
    window = make_window()
    panel = window.camera_panel
    panel.show_bench(SENSOR, LATTICE, FULL_SCALE)
    moved = np.full((*LENSLETS, 2), np.nan)
    outcome = np.full(LENSLETS, Outcome.DARK, np.int8)
    moved[4, 6], outcome[4, 6] = (1.2, 0.3), Outcome.CONVERGED
    window.show_measurement(make_measurement(dim_frame(), views(), outcome=outcome, displacement_px=moved))
    x, y = panel._arrows.getData()
    magnification = float(panel.legend.text().rpartition(" ")[2])
    assert magnification == 20
    np.testing.assert_allclose([x[0], y[0]], [215.0, 150.5])  # the lattice's middle
    np.testing.assert_allclose([x[1] - x[0], y[1] - y[0]], [1.2 * magnification, 0.3 * magnification])


def test_lost_lenslets_are_counted_by_their_reasons(make_window: MakeWindow) -> None:
    window = make_window()
    shown = window.status_line.valid
    for lost_rows, text, colour in (
        (0, "117 of 117", theme.TEXT),
        (2, "91 of 117", theme.AMBER),
        (5, "52 of 117", theme.RED),
    ):
        outcome = np.zeros(LENSLETS, np.int8)
        outcome[:lost_rows] = Outcome.DARK
        outcome[:lost_rows, 0] = Outcome.SATURATED
        window.show_measurement(make_measurement(dim_frame(), views(), outcome=outcome))
        window.update_text()
        assert shown.text() == text
        assert colour.name() in shown.styleSheet()
        assert (f"{12 * lost_rows} lost: no light\n{lost_rows} lost: saturated" in shown.toolTip()) == (lost_rows > 0)


def test_lenslets_without_a_value_are_left_out_of_the_numbers(make_window: MakeWindow) -> None:
    window = make_window()
    shown = np.tile(np.where(np.arange(LENSLETS[1]) % 2, 1.0, -1.0)[1:], (3, 3, LENSLETS[0], 1))
    shown = np.concatenate([np.full((*shown.shape[:3], 1), np.nan), shown], axis=3)  # lost in every view
    shown[0, 0] = np.nan  # a view outside the field
    window.show_measurement(make_measurement(dim_frame(), shown))
    captions = window.wavefront_panel.grid.captions
    assert captions[0, 0][0] == "RMS \N{EN DASH}   PV \N{EN DASH}"
    assert {captions[at][0] for at in captions if at != (0, 0)} == {"RMS 1.00   PV 2.00"}
    assert window.wavefront_panel._summary.text() == "mean RMS 1.00 rad"
    picture(window.wavefront_panel.grid)


def test_small_window_stays_readable(make_window: MakeWindow) -> None:
    window = make_window()
    window.resize(400, 300)
    window.show_measurement(make_measurement(dim_frame(), views()))
    QApplication.processEvents()
    panel = window.camera_panel
    assert panel.caption.geometry().top() > panel._graphics.geometry().bottom()
    assert window.wavefront_panel.grid._has_captions()
    panel.caption.setText("a very long line " * 20)
    QApplication.processEvents()
    assert window.width() == 900


def test_scales_rise_at_once_and_fall_only_when_it_is_worth_it() -> None:
    scale = SteppedScale(MAGNIFICATIONS)
    assert [scale.follow(needed) for needed in (1.7, 2.1, 1.9, 1.7, 1.5, np.nan, 0.0)] == [2, 5, 5, 5, 2, 2, 2]
    assert SteppedScale(RANGES).follow(11) == 15


def test_goes_from_opening_to_live_wavefronts_without_a_click(live: tuple[MainWindow, FakeCamera]) -> None:
    window, camera = live
    assert camera.light.is_on
    assert camera.stage.is_sample_in
    assert window._status is not None
    assert window._status.dark == "good"
    assert window._status.reference == "good"
    assert window.controls.start.text() == "Stop"


def test_intents_reach_the_devices(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    controls = window.controls
    acts: tuple[tuple[Callable[[], object], Callable[[], bool]], ...] = (
        (lambda: press(qtbot, window, Qt.Key.Key_Space), lambda: not camera.is_running),
        (controls.light.click, lambda: not camera.light.is_on),
        (controls.sample.click, lambda: not camera.stage.is_sample_in),
        (lambda: controls.exposure.setValue(30.4), lambda: camera.exposure_s == 0.03),
        (lambda: controls.em_gain.setValue(7), lambda: camera.em_gain == 7),
        (lambda: controls.current.setValue(120), lambda: camera.light.current_a == pytest.approx(0.12)),
        (lambda: controls.mask_requested.emit("stars"), lambda: camera.stage.mask == "stars"),
        (controls.start.click, lambda: camera.is_running),
        (lambda: controls.amplifier_requested.emit("normal"), lambda: camera.amplifier == "normal"),
    )
    for act, is_done in acts:
        act()
        qtbot.waitUntil(is_done, timeout=3000)
        qtbot.waitUntil(lambda: not window._pending, timeout=3000)
    assert camera.is_running
    qtbot.waitUntil(lambda: controls.exposure.value() == 30.0, timeout=3000)  # what the camera made of it
    assert controls.light.text() == "Light off"
    assert controls.amplifier.currentText() == "normal"
    controls.light.click()
    qtbot.waitUntil(lambda: "was taken with another amplifier" in window.messages.text.text(), timeout=3000)


def test_keys_act_while_a_number_is_being_edited(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.activateWindow()
    window.controls.exposure.edit()
    press(qtbot, window.controls.exposure, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: not camera.light.is_on, timeout=3000)


def test_settings_of_the_reconstruction_change(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    window.controls.setting_requested.emit("registration", "warp", "affine")
    window.controls.pupil_modes.setValue(15)
    window.controls.setting_requested.emit("reconstruction", "method", "zonal")

    def is_changed() -> bool:
        measurement = window._measurement
        assert measurement is not None
        return measurement.wavefront is not None and measurement.wavefront.displacement.coefficients.shape[2] == 3

    qtbot.waitUntil(is_changed, timeout=5000)
    assert window._status is not None
    assert window._status.bench.reconstruction.pupil_modes == 15
    assert window.controls.method.currentText() == "zonal"
    assert not window.controls.pupil_modes.isEnabled()


def test_reference_shines_green_only_while_it_serves(live: tuple[MainWindow, FakeCamera]) -> None:
    window, _ = live
    assert window._status is not None
    status = window._status

    def lamps(dark_standing: Standing, reference_standing: Standing) -> tuple[str, str]:
        shown = replace(status, dark=dark_standing, reference=reference_standing)
        window.controls.show_status(shown, is_settled=True)
        images = [
            button.icon().pixmap(32, 32).toImage() for button in (window.controls.dark, window.controls.reference)
        ]
        dark, reference = (image.pixelColor(image.rect().center()).name() for image in images)
        return dark, reference

    green, amber, off = theme.GREEN.name(), theme.AMBER.name(), theme.LINE.name()
    assert lamps("good", "good") == (green, green)
    assert lamps("good", "doubtful") == (green, amber)
    assert lamps("doubtful", "missing") == (amber, off)


@pytest.mark.parametrize(
    ("changes", "is_used"),
    [
        ({"method": "gauss_newton"}, True),
        ({"method": "correlation"}, False),
        ({"method": "centroids"}, False),
        ({"method": "itk_affine"}, False),
        ({"method": "block_flow"}, False),
        ({"method": "demons", "flow": "warp"}, True),
        ({"method": "ffd", "flow": "warp"}, True),
    ],
)
def test_warp_is_offered_where_it_has_an_effect(
    live: tuple[MainWindow, FakeCamera], changes: dict[str, Any], is_used: bool
) -> None:
    window, _ = live
    assert window._status is not None
    bench = replace(window._status.bench, registration=replace(window._status.bench.registration, **changes))
    window.controls.show_status(replace(window._status, bench=bench), is_settled=True)
    assert window.controls.warp.isEnabled() == is_used


def test_refused_value_is_told_and_the_loop_goes_on(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.controls.exposure.setValue(55)
    qtbot.waitUntil(lambda: "between 50 and 60 ms are broken" in window.messages.text.text(), timeout=3000)
    assert window.controls.exposure.value() == 20.0
    shown = window.status_line.shown
    qtbot.waitUntil(lambda: window.status_line.shown > shown + 3, timeout=3000)
    assert camera.exposure_s == 0.02


def test_frame_without_wavefront_says_why_and_shows_no_old_one(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, _ = live
    window.controls.light.click()
    qtbot.waitUntil(lambda: "is the light on?" in window.messages.text.text(), timeout=3000)
    assert window.wavefront_panel.grid._views is None
    assert window.status_line.valid.text() == "\N{EN DASH}"


def test_device_failure_is_told_and_the_window_reconnects(make_window: MakeWindow, qtbot: QtBot) -> None:
    first, second = FakeCamera(), FakeCamera()
    window = make_window(first, second)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    assert not window.messages.reconnect.isVisible()
    first.fault = Disconnected("the camera was unplugged")
    qtbot.waitUntil(lambda: "camera was unplugged" in window.messages.text.text(), timeout=3000)
    assert not first.light.is_on
    assert window.controls.light.text() == "Light off"
    assert not window.controls.isEnabled()
    window.messages.reconnect.click()
    wait_for_wavefront(qtbot, window)
    assert second.light.is_on
    qtbot.waitUntil(lambda: "unplugged" not in window.messages.text.text(), timeout=3000)
    assert not window.messages.reconnect.isVisible()
    assert window.controls.isEnabled()


def test_routine_shows_its_progress_and_can_be_cancelled(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.controls.frames.setValue(500)
    window.controls.reference.click()
    progress = window.messages.progress
    qtbot.waitUntil(lambda: progress.isVisible() and progress.value() > 10, timeout=3000)
    qtbot.waitUntil(lambda: window.messages.text.text() == "Taking the reference, 500 frames: Esc cancels")
    assert "reference" not in progress.text()  # it is said once
    press(qtbot, window, Qt.Key.Key_Escape)
    qtbot.waitUntil(lambda: "ancelled" in window.messages.text.text(), timeout=3000)
    qtbot.waitUntil(lambda: camera.is_running and camera.stage.is_sample_in, timeout=3000)
    qtbot.waitUntil(lambda: not window.messages.progress.isVisible(), timeout=3000)


def test_slow_redraw_does_not_let_the_shown_frame_age(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, camera = live
    camera.period_s = 0.001
    ages: list[float] = []
    draw = window.wavefront_panel.show_wavefront

    def draw_slowly(wavefront: object) -> None:
        assert window._measurement is not None
        ages.append(time.perf_counter() - window._measurement.frame.host_time_s)
        time.sleep(0.1)
        draw(wavefront)  # type: ignore[arg-type] # passed through

    monkeypatch.setattr(window.wavefront_panel, "show_wavefront", draw_slowly)
    qtbot.waitUntil(lambda: len(ages) >= 15, timeout=10_000)
    assert np.median(ages[-5:]) < 0.1
    assert max(ages[-5:]) < 0.3
    assert window.status_line.acquired.text() != window.status_line.shown_count.text()


def test_closing_in_a_long_exposure_is_quick_and_leaves_the_light_off(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, camera = live
    window.controls.exposure.setValue(8000)
    qtbot.waitUntil(lambda: camera.exposure_s == 8, timeout=3000)
    assert camera.light.is_on
    began_s = time.perf_counter()
    window.close()
    assert time.perf_counter() - began_s < 1
    assert not camera.light.is_on
    assert camera.is_closed
    assert not window.is_stuck


def test_help_lists_every_key(make_window: MakeWindow) -> None:
    window = make_window()
    bar = window.menuBar()
    assert bar is not None
    entries = [action for menu in bar.actions() if (inner := menu.menu()) is not None for action in inner.actions()]
    keys = [entry.shortcut().toString() for entry in entries]
    assert len(set(keys)) == len(keys)
    assert {"Space", "L", "S", "D", "R", "Esc", "Ctrl+P"} <= set(keys)
    entries[-1].trigger()
    dialog = window.findChildren(QWidget, "help")[0]
    assert dialog.isVisible()
    dialog.close()


def test_unattended_run_leaves_a_picture_and_a_result(qapp: QApplication, tmp_path: Path) -> None:
    camera = FakeCamera()
    finished: list[Measurement] = []
    status = run_live(
        lambda: Acquisition(BENCH, opener(camera)),
        offscreen_s=0.3,
        screenshot=tmp_path / "window.png",
        on_finish=finished.append,
    )
    assert status == 0
    assert finished[0].wavefront is not None
    image = QImage(str(tmp_path / "window.png"))
    assert image.width() > 800
    assert len({QColor(image.pixel(x, image.height() // 2)).rgb() for x in range(0, image.width(), 7)}) > 10
    assert camera.is_closed
    assert qapp is QApplication.instance()


def test_unattended_run_ends_with_the_reason_when_the_devices_fail(qapp: QApplication) -> None:
    camera = FakeCamera()
    camera.fault = Disconnected("no camera was found")
    with pytest.raises(RunError, match="no camera was found"):
        run_live(lambda: Acquisition(BENCH, opener(camera)), offscreen_s=0.3)
    assert qapp is QApplication.instance()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("offscreen_s", [None, 60.0])
def test_signal_closes_the_window_and_turns_the_light_off(
    qapp: QApplication, number: signal.Signals, offscreen_s: float | None
) -> None:
    assert qapp is QApplication.instance()
    camera = FakeCamera()
    before = signal.getsignal(number)
    QTimer.singleShot(800, lambda: os.kill(os.getpid(), number))
    with pytest.raises(Interrupted):
        run_live(lambda: Acquisition(BENCH, opener(camera)), offscreen_s=offscreen_s)
    assert camera.is_closed
    assert not camera.light.is_on
    assert signal.getsignal(number) == before


def test_unattended_run_whose_window_is_closed_is_no_success(qapp: QApplication, tmp_path: Path) -> None:
    camera = FakeCamera()
    finished: list[Measurement] = []
    QTimer.singleShot(800, qapp.closeAllWindows)
    with pytest.raises(RunError, match="closed before the run had finished"):
        run_live(
            lambda: Acquisition(BENCH, opener(camera)),
            offscreen_s=60,
            screenshot=tmp_path / "window.png",
            on_finish=finished.append,
        )
    assert not finished
    assert not list(tmp_path.iterdir())
    assert camera.is_closed
