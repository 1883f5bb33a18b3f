"""Dockable panels: default layout, tabs, floating, closing, and what a restart restores."""

from __future__ import annotations

from pathlib import Path

import pytest
from PyQt6.QtCore import QByteArray, QRect, QSettings, Qt
from PyQt6.QtWidgets import QApplication, QMenu, QTabBar
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera, make_measurement
from support.window_tools import MakeWindow, click, dim_frame, tab, tabs, views

from app.gui.shell.docks import Dock
from app.gui.shell.main_window import MainWindow

Layout = dict[str, tuple[QRect, bool, bool]]


@pytest.fixture
def settings(tmp_path: Path) -> QSettings:
    return QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat)


@pytest.fixture
def window(make_window: MakeWindow) -> MainWindow:
    made = make_window()
    made.show_measurement(make_measurement(dim_frame(), views()))
    QApplication.processEvents()
    return made


def dock(window: MainWindow, title: str) -> Dock:
    return next(one for one in window.docks.docks if one.windowTitle() == title)


def layout(window: MainWindow) -> Layout:
    """Return where each panel is, whether it floats, and whether it is visible."""
    QApplication.processEvents()
    QApplication.processEvents()
    return {one.windowTitle(): (one.geometry(), one.isFloating(), one.panel.isVisible()) for one in window.docks.docks}


def check_same(found: Layout, expected: Layout) -> None:
    """Check places, to a few pixels, and states."""
    for title, (place, *state) in expected.items():
        assert list(found[title][1:]) == state, title
        if state[1]:  # Qt leaves the others where they were
            edges = zip(found[title][0].getCoords(), place.getCoords(), strict=True)
            assert all(abs((now or 0) - (was or 0)) <= 6 for now, was in edges), title


def choose_more(of: Dock, text: str) -> None:
    """Choose an entry of a panel's own menu."""
    found = of.more.menu()
    assert found is not None
    found.aboutToShow.emit()
    next(action for action in found.actions() if action.text().startswith(text)).trigger()
    QApplication.processEvents()


def menu(window: MainWindow, title: str) -> QMenu:
    """Find a menu and let it follow its buttons, as when it opens."""
    found = next(one for one in window.findChildren(QMenu) if one.title() == title)
    found.aboutToShow.emit()
    return found


def choose(window: MainWindow, title: str, text: str) -> None:
    found = menu(window, title)
    next(action for action in found.actions() if action.text() == text).trigger()
    found.aboutToHide.emit()


def test_default_layout_brings_closed_and_floating_panels_back(window: MainWindow) -> None:
    assert layout(window)["Camera"][2]
    for one in window.docks.docks:
        if one.windowTitle() == "Camera":
            one.setFloating(True)
        else:
            one.close()
    layout(window)
    choose(window, "&View", "Restore default layout")
    assert layout(window)["Wavefronts"][2]
    assert not dock(window, "Camera").isFloating()


def test_default_layout_has_controls_beside_the_camera_and_wavefronts_at_the_right(window: MainWindow) -> None:
    choose(window, "&View", "Restore default layout")
    place = {title: geometry for title, (geometry, _, _) in layout(window).items()}
    camera, wavefronts, quality, controls = (place[title] for title in ("Camera", "Wavefronts", "Quality", "Controls"))
    assert camera.right() < controls.left() < controls.right() < wavefronts.left()
    assert max(camera.bottom(), controls.bottom()) < quality.top()
    assert quality.width() == pytest.approx(camera.width() + controls.width(), abs=12)
    assert (wavefronts.top(), wavefronts.bottom()) == (camera.top(), quality.bottom())


def test_restored_layout_leaves_no_second_row_of_tabs(window: MainWindow) -> None:
    for _ in range(2):
        choose(window, "&View", "Restore default layout")
    layout(window)
    assert [bar.isVisible() for bar in window.findChildren(QTabBar) if bar.count()].count(True) == 1


def test_tab_shows_its_panel_and_hides_the_others(window: MainWindow) -> None:
    bar, at = tab(window, "Histogram")
    click(QtBot, bar, at)  # type: ignore[arg-type] # its mouse methods are static
    shown = {title for title, (_, _, is_visible) in layout(window).items() if is_visible}
    assert shown == {"Camera", "Wavefronts", "Histogram", "Controls"}


@pytest.mark.parametrize("title", ["Camera", "Wavefronts", "Controls"])
def test_header_floats_and_docks_a_panel(window: MainWindow, title: str) -> None:
    before = layout(window)
    chosen = dock(window, title)
    choose_more(chosen, "Float")
    assert chosen.isFloating()
    assert chosen.panel.isVisible()
    choose_more(chosen, "Float")
    check_same(layout(window), before)


def test_closed_panel_returns_from_the_menu(window: MainWindow) -> None:
    before = layout(window)
    choose_more(dock(window, "Camera"), "Close")
    assert not window.panels.camera.isVisible()
    choose(window, "Panels", "Camera")
    check_same(layout(window), before)


def test_panels_out_of_the_tabs_are_open_together_under_their_titles(window: MainWindow) -> None:
    history, histogram = dock(window, "History"), dock(window, "Histogram")
    for one in (history, histogram):
        one.setFloating(True)
    window.addDockWidget(Qt.DockWidgetArea.RightDockWidgetArea, history)
    histogram.setFloating(False)
    window.addDockWidget(Qt.DockWidgetArea.RightDockWidgetArea, histogram)
    history.setFloating(False)
    found = layout(window)
    assert all(found[title][2] for title in ("Quality", "History", "Histogram"))
    assert all(one.bar.height() > 10 for one in (history, histogram))
    assert dock(window, "Quality").bar.isHidden()


def test_last_tab_gets_its_title_back(window: MainWindow) -> None:
    for title in tabs(window):
        dock(window, title).setVisible(title == "Quality")
    layout(window)
    assert dock(window, "Quality").bar.isVisible()


def test_default_layout_is_restored_from_the_menu(window: MainWindow) -> None:
    choose(window, "&View", "Restore default layout")
    before = layout(window)
    dock(window, "Wavefronts").setFloating(True)
    dock(window, "Camera").close()
    dock(window, "Histogram").setFloating(True)
    window.addDockWidget(Qt.DockWidgetArea.LeftDockWidgetArea, dock(window, "Controls"))
    assert layout(window) != before
    choose(window, "&View", "Restore default layout")
    check_same(layout(window), before)


def test_layout_survives_a_restart(make_window: MakeWindow, settings: QSettings) -> None:
    first = make_window(saved=settings)
    first.resizeDocks([dock(first, "Camera"), dock(first, "Quality")], [100, 900], Qt.Orientation.Vertical)
    dock(first, "Controls").close()
    dock(first, "History").setFloating(True)
    chosen = layout(first)
    first.close()
    second = layout(make_window(saved=settings, resized=False))
    assert second["Camera"][0].height() == pytest.approx(chosen["Camera"][0].height(), abs=12)
    assert second["Camera"][0].height() < second["Quality"][0].height()
    assert [title for title, state in second.items() if state[1]] == ["History"]
    assert not second["Controls"][2]


def test_panels_of_a_minimised_window_are_open_after_a_restart(make_window: MakeWindow, settings: QSettings) -> None:
    first = make_window(saved=settings)
    layout(first)
    first.hide()
    first.close()
    second = layout(make_window(saved=settings, resized=False))
    assert {title for title, state in second.items() if state[2]} == {"Camera", "Wavefronts", "Quality", "Controls"}


@pytest.mark.parametrize("is_bytes", [True, False])
def test_state_of_another_layout_is_ignored(make_window: MakeWindow, settings: QSettings, *, is_bytes: bool) -> None:
    expected = layout(make_window())
    other = make_window()
    dock(other, "Camera").close()
    settings.setValue("window/panels", other.saveState(0) if is_bytes else "nonsense")
    settings.setValue("window/left", QByteArray(b"sizes of version 0.1"))
    assert layout(make_window(saved=settings)) == expected


def test_entries_show_the_state_of_their_buttons(window: MainWindow, live: tuple[MainWindow, FakeCamera]) -> None:
    def entries(of: MainWindow, title: str) -> dict[str, tuple[bool, bool]]:
        return {one.text(): (one.isEnabled(), one.isChecked()) for one in menu(of, title).actions()}

    assert entries(window, "&Bench")["Take a dark"] == (False, False)  # no devices
    window.panels.camera.arrows_toggle.trigger()
    assert entries(window, "&View")["Arrows"] == (True, False)
    assert entries(window, "&View")["Lattice"] == (True, True)
    connected, _ = live
    bench = entries(connected, "&Bench")
    assert bench["Take a dark"] == (True, False)
    assert bench["Light on"] == (True, True)
    assert bench["Reconnect after a failure"] == (False, False)
    menu(connected, "&Bench").aboutToHide.emit()
    assert all(one.isEnabled() for one in menu(window, "&File").actions() if one.text() == "Save the bench…")
