"""Replay of a recording in the live view."""

from __future__ import annotations

import re
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.command_line import run
from support.patience import HANG_S, wait_until
from support.pictures import assert_drawn
from support.recordings import record

from app.acquisition.instrument import Instrument
from app.acquisition.worker import Acquisition
from app.bench.config import write_bench
from app.errors import InputError
from app.measurement.measurement import SKIPPED, Measurement
from app.recording.reader import Recording
from app.recording.writer import Record, RecordingWriter
from app.results.player import Player
from drivers.interface import Frame
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import rms

FRAMES = 6


@pytest.fixture(scope="module")
def recording(quick_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(quick_toml, tmp_path_factory.mktemp("recording") / "run", frames=FRAMES)


@pytest.fixture(scope="module")
def changing(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A recording whose second half has fewer pupil modes."""
    folder = tmp_path_factory.mktemp("recording") / "changing"
    kept = recording.calibration(0)
    fewer = replace(kept, bench=replace(kept.bench, reconstruction=ReconstructionSettings(pupil_modes=6)))
    writer = RecordingWriter(folder, {"command": "live", "bench": write_bench(kept.bench)})
    reconstructors = [(each, each.reconstructor()) for each in (kept, fewer)]
    for index in range(FRAMES):
        calibration, reconstructor = reconstructors[index * 2 // FRAMES]
        with one_blas_thread():
            wavefront = reconstructor(recording.pixels(index))
        frame = replace(recording.frame(index), host_time_s=0.2 * index)
        writer.write(Record.of(Measurement(frame, wavefront, "", calibration=calibration)))
    writer.finish("", acquired=FRAMES, facts={})
    writer.close()
    return Recording(folder)


def test_lines_have_the_rms_of_the_wavefronts(changing: Recording) -> None:
    wavefront = changing.calibration(0).reconstructor()(changing.pixels(0))
    assert changing.line(0).rms_rad == pytest.approx(rms(wavefront.views).mean(), rel=1e-3)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("behind_s", [0.0, 0.5])
def test_each_frame_uses_its_own_calibration(
    changing: Recording, monkeypatch: pytest.MonkeyPatch, behind_s: float
) -> None:
    """Also after a repeat, and on a slow computer; no dark or reference is taken."""
    measure = Instrument.measure

    def slowly(instrument: Instrument, frame: Frame) -> Measurement:
        time.sleep(behind_s)
        return measure(instrument, frame)

    monkeypatch.setattr(Instrument, "measure", slowly)
    player = Player(changing.folder)
    seen: list[Measurement] = []
    acquisition = Acquisition(player.bench, player.open_devices, sinks=(player.take, seen.append))
    acquisition.start()
    try:
        for step in player.begin(acquisition):
            step.result(HANG_S)
        wait_until(lambda: len(seen) >= 2 * FRAMES or not acquisition.is_alive)
        assert acquisition.is_alive, acquisition.failure
        status = acquisition.status
        assert status is not None
        assert (status.dark.validity, status.reference.validity, status.warning) == ("good", "good", "")
    finally:
        acquisition.close()
    which = [
        next(index for index in range(FRAMES) if np.array_equal(measurement.frame.pixels, changing.pixels(index)))
        for measurement in seen
    ]
    if behind_s:
        assert any(measurement.problem == SKIPPED for measurement in seen)
    assert which[: 2 * FRAMES] == [*range(FRAMES), *range(FRAMES)]
    for index, measurement in zip(which, seen, strict=True):
        assert measurement.calibration is not None
        modes = measurement.calibration.bench.reconstruction.pupil_modes
        assert modes == changing.calibration(0 if index < FRAMES // 2 else 1).bench.reconstruction.pupil_modes
        if measurement.wavefront is not None:  # otherwise skipped
            expected = changing.calibration(0 if index < FRAMES // 2 else 1).reconstructor()(changing.pixels(index))
            np.testing.assert_allclose(rms(measurement.wavefront.views), rms(expected.views), rtol=1e-3)


def test_changed_settings_change_the_wavefronts(changing: Recording) -> None:
    player = Player(changing.folder, settings=("reconstruction.method=zonal",), frames="1:3")
    assert player.bench.reconstruction.method == "zonal"


def test_frames_without_calibration_are_refused(changing: Recording, tmp_path: Path) -> None:
    frame = changing.frame(0)
    writer = RecordingWriter(tmp_path / "run", {"command": "live", "bench": write_bench(changing.bench)})
    writer.write(Record.of(Measurement(frame, None, "no reference yet")))
    writer.finish("", acquired=1, facts={})
    writer.close()
    with pytest.raises(InputError, match="have no calibration"):
        Player(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.long
def test_window_shows_a_replay(changing: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Offscreen; the result is the wavefront of one of the frames."""
    out = tmp_path / "out"
    arguments = ("--replay", changing.folder, "--frames", "0:2", "--seconds", "0.5", "--out", out)
    assert run(monkeypatch, "live", *arguments) == 0
    assert_drawn(out / "window.png")
    expected = [rms(changing.calibration(0).reconstructor()(changing.pixels(index)).views) for index in (0, 1)]
    with xr.open_dataset(out / "result.nc") as shown:
        assert any(np.allclose(shown["rms"], each, rtol=1e-3) for each in expected)


@pytest.mark.timeout(100)  # it would wait 120 s for a first wavefront
def test_replay_that_can_show_no_wavefront_ends_at_once(
    changing: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(changing.folder, tmp_path / "run")
    (folder / "calibrations" / "0" / "camera.json").write_text('{"full_scale": 10}')
    arguments = ("--replay", folder, "--frames", "0:1", "--seconds", "0.5", "--out", tmp_path / "out")
    assert run(monkeypatch, "live", *arguments) == 1
    errors = capsys.readouterr().err
    assert re.search(r"^svwfs: no wavefront in the first 2\d frames: ", errors, re.MULTILINE)
    assert "saturated" in errors


def test_frames_option_needs_a_recording(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "live", "--frames", "0:2") == 2
    assert "add --replay RECORDING" in capsys.readouterr().err
