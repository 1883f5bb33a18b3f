"""Bench without motors: the user is asked for manual steps and confirms them."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.gui_bench import BENCH, FakeCamera, opener
from support.manual_bench import MANUAL, Person
from support.patience import HANG_S
from support.stage_contract import StageContract

from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.commands.measure import measure_bench
from app.errors import InputError, RunError
from drivers.interface import Stage, WrongState
from drivers.light_source import ManualLight, ManualLightSettings
from drivers.stage import ManualStage


@pytest.fixture
def camera() -> FakeCamera:
    camera = FakeCamera()
    camera.stage = ManualStage("square")
    return camera


class TestManualStage(StageContract):
    @pytest.fixture
    def stage(self) -> Stage:
        return Noted("square")


class Noted(ManualStage):
    """Manual stage with a user who acts at once."""

    def _set_sample_in(self, *, is_in: bool) -> None:
        self.note_sample(is_in)
        super()._set_sample_in(is_in=is_in)


def test_manual_stage_never_moves() -> None:
    stage = ManualStage("square")
    stage.set_sample_in(False)
    with pytest.raises(WrongState, match="put the sample into the beam"):
        stage.set_sample_in(True)
    assert not stage.is_sample_in
    stage.note_sample(True)
    stage.set_sample_in(True)
    with pytest.raises(WrongState, match="take the sample out of the beam"):
        stage.set_sample_in(False)


@pytest.mark.slow
@pytest.mark.long
def test_measure_asks_for_manual_steps(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, camera: FakeCamera
) -> None:
    person = Person(camera, presses=2)
    monkeypatch.setattr("sys.stdin", person)
    monkeypatch.setattr("app.acquisition.devices.open_devices", opener(camera))
    measured = measure_bench(MANUAL, tmp_path / "m", frames=3, progress=lambda *_: None)
    assert measured.reconstructed == 3
    assert len(person.saw) == 2
    assert person.saw[1] == (True, False)  # after dark and reference
    asked = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in asked] == ["take the sample out of the beam", "put the sample into the beam"]


@pytest.mark.slow
@pytest.mark.long
def test_measure_asks_for_a_manual_light(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, camera: FakeCamera
) -> None:
    light = ManualLight()
    camera.light = light  # type: ignore[assignment] # the camera sees whether it is on
    person = Person(camera, presses=4)
    monkeypatch.setattr("sys.stdin", person)
    monkeypatch.setattr("app.acquisition.devices.open_devices", opener(camera))
    bench = replace(MANUAL, light=ManualLightSettings())
    measured = measure_bench(bench, tmp_path / "m", frames=3, progress=lambda *_: None)
    assert measured.reconstructed == 3
    assert [is_on for is_on, _ in person.saw] == [True, True, False, True]
    asked = [line.split(",")[0] for line in capsys.readouterr().err.splitlines()]
    assert asked == [
        "take the sample out of the beam",
        "switch the light off",
        "switch the light on",
        "put the sample into the beam",
        "the light is manual: make sure that it is off",
    ]


class Mender(Person):
    """User who unblocks the light at the second request."""

    def __init__(self, camera: FakeCamera, presses: int) -> None:
        super().__init__(camera, presses)
        self._image = camera._images[0]
        camera._images[0] = np.zeros_like(self._image)

    def readline(self) -> str:
        if len(self.saw) == 2:
            self._camera._images[0] = self._image
        return super().readline()


@pytest.mark.slow
@pytest.mark.long
def test_measure_by_hand_retakes_unusable_reference(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, camera: FakeCamera
) -> None:
    person = Mender(camera, presses=4)
    monkeypatch.setattr("sys.stdin", person)
    monkeypatch.setattr("app.acquisition.devices.open_devices", opener(camera))
    measured = measure_bench(MANUAL, tmp_path / "m", frames=3, progress=lambda *_: None)
    assert measured.reconstructed == 3
    assert [is_sample_in for _, is_sample_in in person.saw] == [False] * 4
    first, *told, last = capsys.readouterr().err.splitlines()
    assert first.startswith("take the sample out of the beam")
    assert len(told) == 2
    assert all(line.startswith("the reference is unusable: ") for line in told)
    assert all("the sample out of the beam, then press Enter" in line for line in told)
    assert last.startswith("put the sample into the beam")


def test_measure_with_motors_fails_on_unusable_reference(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    camera = FakeCamera()
    camera._images[0] = np.zeros_like(camera._images[0])
    monkeypatch.setattr("app.acquisition.devices.open_devices", opener(camera))
    with pytest.raises(RunError, match="the reference is unusable: "):
        measure_bench(BENCH, tmp_path / "m", frames=3, progress=lambda *_: None)
    assert not camera.light.shines
    assert not (tmp_path / "m").exists()


@pytest.mark.parametrize("presses", [0, 1])
def test_measure_fails_if_terminal_is_closed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, camera: FakeCamera, presses: int
) -> None:
    monkeypatch.setattr("sys.stdin", Person(camera, presses))
    monkeypatch.setattr("app.acquisition.devices.open_devices", opener(camera))
    with pytest.raises(InputError, match="terminal was closed before"):
        measure_bench(MANUAL, tmp_path / "m", frames=3, progress=lambda *_: None)
    assert not camera.light.shines
    assert camera.state in {"closed", "stopped"}  # stopped if it was never opened


def test_measure_needs_a_terminal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, camera: FakeCamera) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("\n\n"))
    monkeypatch.setattr("app.acquisition.devices.open_devices", opener(camera))
    with pytest.raises(InputError, match=r"no motors: .* to take the sample out of the beam"):
        measure_bench(MANUAL, tmp_path / "m", frames=3, progress=lambda *_: None)


def test_window_starts_without_reference(camera: FakeCamera) -> None:
    acquisition = Acquisition(MANUAL, opener(camera))
    acquisition.start()
    for step in start_up(acquisition, frames=3):
        step.result(HANG_S)
    assert (
        acquisition.commands.submit(lambda instrument: instrument.status()).result(HANG_S).reference.validity
        == "missing"
    )
    assert camera.is_running
    assert acquisition.commands.submit(lambda instrument: instrument.darks.average is not None).result(HANG_S)
    acquisition.commands.submit(lambda instrument: instrument.devices.stage.note_sample(True)).result(HANG_S)
    with pytest.raises(WrongState, match="take the sample out"):
        acquisition.take_reference(3).result(HANG_S)
    assert acquisition.is_alive
    acquisition.commands.submit(lambda instrument: instrument.devices.stage.note_sample(False)).result(HANG_S)
    acquisition.take_reference(3).result(HANG_S)
    acquisition.close()
    assert acquisition.error is None
