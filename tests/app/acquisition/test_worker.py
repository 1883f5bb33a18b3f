"""The worker thread: commands between frames, routines that restore devices, reported failures."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.patience import HANG_S, own_time, wait_until
from support.running import Running, is_dark
from support.simulated_scene import lose_frames, stall, unplug

from app.acquisition.instrument import Instrument
from app.bench.config import load_bench
from app.errors import InputError
from app.measurement.measurement import SKIPPED, Measurement
from app.measurement.routines import Cancelled
from drivers.interface import Disconnected, WrongState
from reconstruction.quality.verdict import Fault
from simulated_devices.bench import SimulatedLight


@pytest.mark.usefixtures("no_hurry")
def test_start_up_yields_wavefronts(running: Running) -> None:
    running.begin()
    wait_until(lambda: len(running.measurements) >= 10)
    running.end()
    counts = running.measurements[-1].counts
    assert counts.acquired == len(running.measurements)
    skipped = [measurement.problem for measurement in running.measurements if measurement.wavefront is None]
    assert skipped == [SKIPPED] * len(skipped)  # seen once, on a busy computer
    assert counts.reconstructed == counts.acquired - len(skipped) > 0
    assert [measurement.frame.index for measurement in running.measurements] == list(range(counts.acquired))
    assert counts.lost == 0
    assert running.newest is running.measurements[-1]
    assert running.acquisition.failure == ""


def test_every_step_of_a_routine_is_a_sign_of_life(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    promised = list[float]()
    monkeypatch.setattr(SimulatedLight, "keep_alive", lambda _, within_s: promised.append(within_s))
    running.begin()
    promised.clear()
    running.acquisition.take_dark(10).result(HANG_S)
    assert promised.count(10.0) >= 10


def test_command_runs_between_frames_and_returns_result(running: Running) -> None:
    running.begin()
    setting = running.acquisition.commands.submit(lambda instrument: instrument.devices.camera.set_exposure(0.040004))
    set_to = setting.result(HANG_S)
    assert set_to == pytest.approx(0.04)
    assert running.acquisition.status is not None
    assert running.acquisition.status.exposure_s == set_to  # updated before the future resolves
    wait_until(lambda: running.measurements[-1].frame.exposure_s == set_to)


def test_cancelled_routine_restores_devices(running: Running) -> None:
    running.begin()
    long = running.acquisition.take_dark(10_000)
    wait_until(lambda: running.newest.problem == "taking the dark, 10000 frames")
    newest = running.newest
    assert newest.wavefront is None  # shown, not measured
    assert running.acquisition.activity.text == newest.problem
    assert running.acquisition.activity.progress > 0
    assert newest.frame.pixels.mean() == pytest.approx(500, abs=10)
    running.acquisition.cancel()
    with pytest.raises(Cancelled):
        long.result(HANG_S)
    assert not running.acquisition.commands.submit(is_dark).result(HANG_S)
    assert running.acquisition.activity.text == ""


def test_darkis_dark_and_reference_lit(running: Running) -> None:
    running.begin()
    averages = running.acquisition.commands.submit(
        lambda instrument: (instrument.darks.average, instrument.references.average)
    ).result(HANG_S)
    dark, reference = averages
    assert dark is not None
    assert reference is not None
    assert dark.mean.mean() == pytest.approx(500, abs=3)  # the camera's offset
    assert reference.mean.max() > 3000
    assert np.sqrt(np.median(dark.variance)) == pytest.approx(37 / 5.8, rel=0.7)  # read noise in counts, three frames


def test_stop_interrupts_long_exposure(quick_toml: Path) -> None:
    running = Running(load_bench(quick_toml, ("camera.readout_speed=2", "camera.exposure_s=30.0")))
    running.acquisition.start()
    running.acquisition.commands.submit(lambda instrument: instrument.devices.light.set_on(True)).result(HANG_S)
    running.acquisition.commands.submit(lambda instrument: instrument.devices.camera.start()).result(HANG_S)
    time.sleep(0.2)
    with own_time() as elapsed_s:
        running.acquisition.close()
        assert elapsed_s() < 1.0
    assert running.devices is not None
    with pytest.raises(WrongState):  # closed after the light was turned off
        _ = running.devices.light.is_on


def test_saturated_frame_keeps_loop_running(running: Running) -> None:
    running.begin()
    running.acquisition.commands.submit(lambda instrument: instrument.devices.camera.set_em_gain(400.0)).result(HANG_S)
    wait_until(lambda: "saturated" in running.measurements[-1].problem)
    running.acquisition.commands.submit(lambda instrument: instrument.devices.camera.set_em_gain(8.0)).result(HANG_S)
    wait_until(lambda: running.measurements[-1].wavefront is not None)


def test_reference_clipped_by_the_full_well_is_doubtful(quick_toml: Path) -> None:
    """Its counts stay below the camera's full scale."""
    clipped = (
        "camera.full_well_e=20000.0",
        "camera.em_gain=1.0",
        "camera.exposure_s=0.1",
        "camera.em_read_noise_e=[1.0, 1.0, 1.0]",
    )
    running = Running(load_bench(quick_toml, clipped))
    try:
        running.begin()
        status = running.acquisition.status
        assert status is not None
        assert status.dark.validity == "good"
        assert status.reference.validity == "doubtful"
        assert "clipped" in status.reference.note
        assert "clipped" in status.warning
    finally:
        running.acquisition.close()


def test_reference_without_light_is_a_warning(running: Running) -> None:
    running.begin()
    running.acquisition.commands.submit(lambda instrument: instrument.devices.light.set_current(0.0)).result(HANG_S)
    running.acquisition.take_reference(2).result(HANG_S)
    assert running.acquisition.status is not None
    assert "no light" in running.acquisition.status.warning
    assert running.acquisition.status.reference.validity == "doubtful"
    wait_until(lambda: "no light" in running.measurements[-1].problem)


def test_lost_frames_are_counted(running: Running) -> None:
    running.begin()
    running.acquisition.commands.submit(lambda _: lose_frames(running.camera, 5)).result(
        HANG_S
    )  # not while a frame is read
    wait_until(lambda: running.measurements[-1].counts.lost >= 5)  # a busy computer loses more
    last = running.measurements[-1]
    assert last.counts.acquired + last.counts.lost == last.frame.index + 1


def test_unplugged_camera_ends_loop_with_light_off(running: Running) -> None:
    running.begin()
    unplug(running.camera)
    wait_until(lambda: not running.acquisition.is_alive)
    assert isinstance(running.acquisition.error, Disconnected)
    assert "camera" in running.acquisition.failure
    assert running.devices is not None
    with pytest.raises(WrongState):
        _ = running.devices.light.is_on
    with pytest.raises(WrongState, match="camera"):  # a later command does not wait forever
        running.acquisition.commands.submit(is_dark).result(HANG_S)


@pytest.mark.slow
def test_stalled_camera_ends_loop(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    running.begin()
    monkeypatch.setattr("app.measurement.routines._MARGIN_S", 0.3)
    stall(running.camera)
    wait_until(lambda: not running.acquisition.is_alive)
    assert "no frame" in running.acquisition.failure


def test_impossible_bench_is_input_error(quick_toml: Path) -> None:
    running = Running(load_bench(quick_toml, ("simulation.screen.file=/nowhere/screen.npy",)))
    running.acquisition.start()
    wait_until(lambda: not running.acquisition.is_alive)
    assert isinstance(running.acquisition.error, InputError)
    assert "screen.npy" in running.acquisition.failure


def test_light_switched_off_by_hand_is_detected(running: Running) -> None:
    running.begin()
    assert running.devices is not None
    light = running.devices.light
    assert isinstance(light, SimulatedLight)
    light._bench.change(is_light_on=False)  # at its front panel
    wait_until(lambda: running.acquisition.status is not None and not running.acquisition.status.is_light_on)
    assert running.acquisition.is_alive


def test_camera_that_repeats_a_frame_is_reported(quick_toml: Path) -> None:
    running = Running(load_bench(quick_toml))
    try:
        running.begin()
        instrument = running.acquisition.commands.submit(lambda each: each).result(HANG_S)
        wait_until(lambda: running.newest.wavefront is not None)
        frame = running.newest.frame
        assert not running.newest.quality.reasons

        def repeat(_: Instrument) -> list[Measurement]:
            later = [
                replace(frame, index=frame.index + step, camera_time_s=frame.camera_time_s + step) for step in (1, 2)
            ]
            early = replace(frame, index=frame.index + 3, pixels=frame.pixels + 1)
            skipped, again = (
                replace(
                    early, index=early.index + step, camera_time_s=early.camera_time_s + step, pixels=early.pixels + 1
                )
                for step in (1, 2)
            )
            made = [instrument.measure(each) for each in (*later, early)]
            instrument.skip(skipped)
            return [*made, instrument.measure(again)]

        _, frozen, back, after_skipped = running.acquisition.commands.submit(repeat).result(HANG_S)
    finally:
        running.acquisition.close()
    assert frozen.quality.faults == after_skipped.quality.faults == Fault.FROZEN
    assert back.quality.faults == Fault.CLOCK
