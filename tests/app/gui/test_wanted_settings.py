"""Settings from the choice until they are in force, and the gaps that they leave in a recording."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.patience import HANG_S

from app.gui.shell.main_window import MainWindow
from app.measurement.calibration import Calibration
from app.recording.reader import Recording
from reconstruction.reconstructor import Reconstructor


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int | None]:
    """Numbers of pupil modes of the reconstructors that are built."""
    found = list[int | None]()
    build = Calibration.reconstructor

    def note(calibration: Calibration) -> Reconstructor:
        found.append(calibration.bench.reconstruction.pupil_modes)
        return build(calibration)

    monkeypatch.setattr(Calibration, "reconstructor", note)
    return found


@contextmanager
def held_up(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Builds of reconstructors wait until the end of the block."""
    release, build = threading.Event(), Calibration.reconstructor

    def wait(calibration: Calibration) -> Reconstructor:
        release.wait(HANG_S)
        return build(calibration)

    with monkeypatch.context() as patch:
        patch.setattr(Calibration, "reconstructor", wait)
        yield
        release.set()


@pytest.mark.slow
@pytest.mark.long
def test_last_of_many_choices_wins_and_the_others_are_not_built(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, made: list[int | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    window, camera = live
    controls = window.controls
    with held_up(monkeypatch):
        for modes in (10, 15, 21, 6, 12):
            controls.wanted.emit("reconstruction.pupil_modes", modes)
        controls.refine.click()
        is_refined = controls.refine.isChecked()
        controls.wanted.emit("mask", "stars")
        window.refresh()
        assert controls.choices["mask"].currentText() == "stars"
        assert [one.property("wanted") for one in (controls.refine, controls.choices["mask"])] == [True, True]
        assert not controls.exposure.property("wanted")
        window.messages.warn("an old message")
        qtbot.waitUntil(
            lambda: (
                "Preparing the reconstruction with pupil modes 10" in window.messages.progress.toolTip().capitalize()
            )
        )
        assert window.messages.progress.isVisible()
    qtbot.waitUntil(lambda: not window.settings.wanted)
    qtbot.waitUntil(lambda: window.controller.is_settled)
    assert made == [10, 12]
    assert camera.stage.mask == "stars"
    qtbot.waitUntil(lambda: not controls.refine.property("wanted"))
    status = window.controller.status
    assert status is not None
    assert (status.bench.reconstruction.pupil_modes, status.bench.reconstruction.refine) == (12, is_refined)


@pytest.mark.slow
@pytest.mark.long
def test_refused_choice_gives_way_to_the_value_in_force(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    window.controls.exposure.setValue(55)  # which the camera refuses
    qtbot.waitUntil(lambda: "are broken" in window.messages.log)
    qtbot.waitUntil(lambda: window.controls.exposure.value() == 20)
    assert not window.settings.wanted


@pytest.mark.slow
@pytest.mark.long
def test_gap_of_a_setting_is_noted_in_the_recording(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    window.recording_bar.recordings_folder = tmp_path
    acquisition = window.controller.acquisition
    assert acquisition is not None
    acquisition.start_recording(tmp_path / "run").result(HANG_S)
    qtbot.waitUntil(lambda: acquisition.recording is not None and acquisition.recording.frames > 3)
    with held_up(monkeypatch):
        window.controls.wanted.emit("reconstruction.pupil_modes", 10)
        qtbot.waitUntil(lambda: window._activity.text.startswith("preparing"))
        qtbot.wait(300)
    qtbot.waitUntil(lambda: acquisition.recording is not None and len(acquisition.recording.gaps) == 1)
    qtbot.waitUntil(lambda: "1 gap of" in window.recording_panel.text.text())
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: "with 1 gap of" in window.messages.log)
    assert "(preparing the reconstruction with pupil modes 10)" in window.messages.log
    recording = Recording(tmp_path / "run")
    gaps = [(line.gap_s, line.gap_cause) for line in map(recording.line, range(len(recording))) if line.gap_s]
    assert len(gaps) == 1
    assert gaps[0][0] > 0.2
    assert gaps[0][1] == "preparing the reconstruction with pupil modes 10"
