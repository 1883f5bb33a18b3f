"""Settings of a bench in the window, and a new bench with connected devices."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PyQt6.QtTest import QTest
from PyQt6.QtWidgets import QApplication, QCheckBox, QComboBox, QFileDialog, QLineEdit
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import MakeWindow

from app.bench.config import Bench, load_bench
from app.bench.device_kinds import DeviceKind
from app.gui.shell.benches import Benches
from app.gui.shell.main_window import MainWindow
from app.gui.shell.settings_dialog import SettingsDialog
from drivers.device import DiscoveredDevice
from drivers.genicam import GenicamSettings
from drivers.light_source import ManualLightSettings

CAMERA = DiscoveredDevice(kind="camera", driver="genicam", description="a camera", settings={"device": "Mako 7"})


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Bench]:
    """The benches that the window opens."""
    opened: list[Bench] = []
    monkeypatch.setattr(MainWindow, "open", lambda self, access: opened.append(access.make.args[0]))
    monkeypatch.setattr(DeviceKind, "discover", lambda kind: ((CAMERA,) if kind.driver == "genicam" else (), ""))
    return opened


@pytest.fixture
def benches(make_window: MakeWindow, opened: list[Bench]) -> Benches:  # noqa: ARG001 - no device is opened
    return make_window().benches


def dialog_of(benches: Benches) -> SettingsDialog:
    assert benches.settings_dialog is not None
    return benches.settings_dialog


def write(dialog: SettingsDialog, path: str, text: str) -> QLineEdit:
    """Type a text into a field."""
    line = dialog.editors[path][1]
    assert isinstance(line, QLineEdit)
    line.selectAll()
    QTest.keyClicks(line, text)  # type: ignore[call-arg, arg-type] # PyQt's stub lacks staticmethod
    return line


def choose(dialog: SettingsDialog, path: str, text: str) -> None:
    choice = dialog.editors[path][1]
    assert isinstance(choice, QComboBox)
    choice.setCurrentText(text)
    choice.activated.emit(choice.currentIndex())


def test_changed_settings_are_opened(benches: Benches, opened: list[Bench]) -> None:
    benches.edit()
    dialog = dialog_of(benches)
    assert dialog.devices.isHidden()
    wavelength = write(dialog, "sensor.wavelength_m", "0.532 um")
    choose(dialog, "field.shape", "circle")
    assert "color" not in wavelength.styleSheet()
    dialog.apply.click()
    assert dialog.isVisible()  # for the next change
    assert [bench.sensor.wavelength_m for bench in opened] == [532e-9]
    assert opened[0].field.shape == "circle"
    assert opened[0].camera == load_bench("live_demo").camera


def test_wrong_setting_is_red_and_not_opened(benches: Benches, opened: list[Bench]) -> None:
    benches.edit()
    dialog = dialog_of(benches)
    for text, sentence in (("462 mm", "Wavelength must be 100 ... 20000 nm"), ("blue", "type a number in nm")):
        wavelength = write(dialog, "sensor.wavelength_m", text)
        assert sentence in dialog.problem.text()
        assert "color" in wavelength.styleSheet()
        assert not dialog.apply.isEnabled()
        assert not dialog.save.isEnabled()
    write(dialog, "sensor.wavelength_m", "500")
    assert not dialog.problem.text()
    dialog.apply.click()
    assert len(opened) == 1


def test_new_bench_has_the_connected_camera(
    benches: Benches, opened: list[Bench], qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    benches.make()
    dialog = dialog_of(benches)
    qtbot.waitUntil(lambda: dialog.camera.count() == 2)
    assert dialog.light.currentText().startswith("None found")
    dialog.camera.setCurrentText(CAMERA.name)
    dialog.camera.textActivated.emit(CAMERA.name)
    choose(dialog, "light.driver", "manual")
    QApplication.processEvents()
    unknown = {path: field.example for path, (field, _) in dialog.editors.items() if field.example}
    assert len(unknown) == 6  # rows and columns are found in a reference
    for field, example in unknown.items():  # of lenslets that are not this camera's
        line = dialog.editors[field][1]
        assert isinstance(line, QLineEdit)
        assert (line.text(), line.placeholderText()) == ("", f"for example {example}")
        assert not dialog.apply.isEnabled()
        write(dialog, field, example)
    write(dialog, "sensor.lenslet_rows", "20")
    assert dialog.apply.isEnabled()
    path = tmp_path / "mine.toml"
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(path), ""))
    dialog.save.click()
    qtbot.waitUntil(lambda: bool(opened))
    bench = load_bench(path)
    assert opened == [bench]
    assert bench.camera == GenicamSettings(device="Mako 7")
    assert bench.light == ManualLightSettings()
    assert (bench.sensor.lenslet_rows, bench.sensor.lenslet_columns, bench.lattice) == (20, None, None)
    assert benches.recent.paths() == (path,)


@pytest.mark.slow
@pytest.mark.long
def test_reconstruction_changes_without_opening_devices(
    live: tuple[MainWindow, FakeCamera], opened: list[Bench], qtbot: QtBot
) -> None:
    window, camera = live
    window.benches.edit()
    dialog = dialog_of(window.benches)
    choose(dialog, "reconstruction.method", "zonal")
    write(dialog, "reconstruction.pupil_modes", "21")
    choose(dialog, "registration.warp", "affine")
    dialog.apply.click()
    qtbot.waitUntil(lambda: window._status is not None and window._status.bench.reconstruction.method == "zonal")
    status = window.controller.status
    assert status is not None
    assert (status.bench.registration.warp, status.bench.reconstruction.pupil_modes) == ("affine", 21)
    assert not opened
    assert camera.is_running
    window.benches.edit()
    write(dialog, "sensor.wavelength_m", "500")
    dialog.apply.click()
    assert [bench.sensor.wavelength_m for bench in opened] == [500e-9]


def test_reason_of_a_failed_search_is_shown(benches: Benches, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch) -> None:
    unusable = replace(CAMERA, missing="install Aravis")

    def discover(kind: DeviceKind) -> tuple[tuple[DiscoveredDevice, ...], str]:
        if kind.driver == "coolled":
            raise OSError("no such bus")
        return {"genicam": ((unusable,), ""), "dcam": ((), "the DCAM-API is missing")}.get(kind.driver, ((), ""))

    monkeypatch.setattr(DeviceKind, "discover", discover)
    benches.make()
    dialog = dialog_of(benches)
    qtbot.waitUntil(lambda: dialog.camera.count() == 2)
    lines = dialog.failed.text().splitlines()
    assert len(lines) == 3
    assert lines[0].endswith("over DCAM-API, not searched: the DCAM-API is missing")
    assert lines[1] == f"{CAMERA.name} cannot be used yet: install Aravis"
    assert lines[2].endswith("on serial ports, not searched: OSError: no such bus")


def test_settings_have_the_names_of_people(benches: Benches) -> None:
    benches.edit()
    for path, (_, editor) in dialog_of(benches).editors.items():
        if isinstance(editor, QComboBox):
            texts = [editor.itemText(index) for index in range(editor.count())]
            assert not any("_" in text for text in texts), path
        assert "gauss_newton" not in editor.toolTip()
        if isinstance(editor, QCheckBox):
            assert editor.text() == ("yes" if editor.isChecked() else "no")
    method, light = (dialog_of(benches).editors[path][1] for path in ("registration.method", "light.driver"))
    assert isinstance(method, QComboBox)
    assert isinstance(light, QComboBox)
    assert method.itemText(method.findData("gauss_newton")) == "Gauss-Newton"
    assert light.itemText(light.findData("thorlabs_dc4100")) == "Thorlabs DC4100"
    assert light.toolTip() == "<p>Driver</p>"


def test_empty_list_is_none(benches: Benches) -> None:
    benches.edit()
    dialog = dialog_of(benches)
    line = write(dialog, "registration.excluded", "")
    assert (line.text(), line.placeholderText()) == ("", "none")
    for text, excluded in (("[[2, 3]]", ((2, 3),)), ("", ())):
        line.setText(text)
        line.textEdited.emit(text)
        assert not dialog.problem.text()
        bench = dialog._check()
        assert bench is not None
        assert bench.registration.excluded == excluded


def test_new_bench_is_not_red_before_anything_is_typed(benches: Benches, qtbot: QtBot) -> None:
    benches.make()
    dialog = dialog_of(benches)
    assert dialog.problem.text().startswith("Still to be filled in: Lenslet pitch, ")
    assert dialog.problem.property("tone") == "dim"
    assert not any("color" in editor.styleSheet() for _, editor in dialog.editors.values())
    rows = write(dialog, "sensor.lenslet_rows", "many")
    assert dialog.problem.property("tone") == "red"
    assert "color" in rows.styleSheet()
    qtbot.waitUntil(lambda: not dialog._search.is_busy)


def test_reason_of_a_failed_search_is_plain(benches: Benches, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch) -> None:
    why = "the API cannot be loaded (lib.so: Datei (x) fehlt): install it, then `svwfs devices`"
    monkeypatch.setattr(DeviceKind, "discover", lambda kind: ((), why if kind.driver == "dcam" else ""))
    benches.make()
    dialog = dialog_of(benches)
    qtbot.waitUntil(lambda: not dialog._search.is_busy)
    assert dialog.failed.text().endswith("not searched: the API cannot be loaded: install it, then svwfs devices")
    assert dialog.failed.toolTip().endswith(why)
