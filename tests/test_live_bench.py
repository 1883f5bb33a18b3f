"""The live bench of the Python interface: what it records, sets and measures, and how it ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.patience import wait_until
from support.pictures import html_picture

import svwfs
from app.acquisition.start_up import knows_sample
from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from drivers.dcam import DcamSettings
from drivers.interface import LightSource
from drivers.serial_lights import DC4100Settings


@pytest.fixture(scope="module")
def bench() -> Bench:
    return svwfs.load_bench("small_demo")


@pytest.mark.slow
@pytest.mark.long
def test_live_bench_records_and_reports_what_it_used(bench: Bench, tmp_path: Path) -> None:
    with svwfs.live(bench, average=3) as live:
        measurement = next(iter(live))
        assert measurement.wavefront is not None
        assert live.bench.lattice is not None
        assert live.warning == ""
        live.take_dark(2)
        live.take_reference(2)
        folder = live.record(tmp_path / "run", frames=4)
        with pytest.raises(svwfs.InputError, match="holds a recording already"):
            live.record(folder, frames=1)
    with pytest.raises(svwfs.WrongState, match="its with block has ended"):
        iter(live)
    recording = svwfs.open_recording(folder)
    assert len(recording) == 4
    chunk = folder / "frames.zarr/0/c/0/0/0"
    held = chunk.read_bytes()
    assert repr(recording).startswith(f"<Recording {folder}: 4 frames of 240 x 256 pixels; began 20")
    assert html_picture(recording._repr_html_()).shape == (240, 256, 3)
    assert recording.dark is not None
    assert recording.reference is not None
    assert recording.dark.shape == recording.reference.shape == (240, 256)
    assert recording.reference.mean() > recording.dark.mean() > 0
    assert recording.run["command"] == "python"
    chunk.write_bytes(b"")
    assert "is damaged: 0 bytes" in svwfs.open_recording(folder)._repr_html_()
    chunk.write_bytes(held)
    frames = recording.frames
    assert frames.sizes == {"frame": 4, "row": 240, "column": 256}
    assert frames["frame_index"].values.tolist() == sorted(frames["frame_index"].values.tolist())
    assert np.array_equal(frames[1:3, 5, ::-7].values, frames.values[1:3, 5, ::-7])
    assert frames[2:2].values.shape == (0, 240, 256)
    assert recording.results()["wavefront"].sizes["frame"] == 4


@pytest.mark.slow
def test_exposure_gain_and_light_are_set(bench: Bench) -> None:
    with svwfs.live(bench, average=2) as live:
        assert live.set_exposure(0.03) == live.bench.camera_model.exposure_s == pytest.approx(0.03, rel=1e-3)
        measurement = next(iter(live))
        assert measurement.frame.exposure_s == pytest.approx(0.03, rel=1e-3)
        assert live.warning == "the dark was taken at 20.0 ms: take it again"
        assert live.set_em_gain(3) == next(iter(live)).frame.em_gain == 3
        assert live.set_light_current(0.5) == pytest.approx(0.5)
        bright = next(iter(live)).frame.pixels.mean()
        live.set_light(False)
        dark = next(iter(live))
        assert dark.light is not None
        assert not dark.light.is_on
        assert dark.frame.pixels.mean() < 0.9 * bright
        live.set_light(True)
        assert next(iter(live)).frame.pixels.mean() == pytest.approx(bright, rel=0.1)
        for exposure_s in (0.02, 0.03) * 5:
            live.set_exposure(exposure_s)
            assert next(iter(live)).frame.exposure_s == pytest.approx(exposure_s, rel=1e-3)
        for impossible in (-1.0, float("nan")):
            with pytest.raises(svwfs.BadValue):
                live.set_exposure(impossible)
        live.set_light(False)
        with pytest.raises(svwfs.BadValue, match="True or False, not 'off'"):
            live.set_light("off")  # type: ignore[arg-type] # would light it
        live.set_light(np.bool_(False))  # type: ignore[arg-type] # of a calculation
        assert not next(iter(live)).light.is_on  # type: ignore[union-attr] # it was asked
        with pytest.raises((TypeError, ValueError)):
            live.set_light_current("much")  # type: ignore[arg-type] # no number
        assert next(iter(live)).frame is not None  # the worker goes on


def test_iteration_ends_with_the_block(bench: Bench) -> None:
    with svwfs.live(bench, average=2) as live:
        measurements = iter(live)
        next(measurements)
    assert list(measurements) == []


@pytest.mark.slow
def test_first_measurement_after_a_reference_uses_it(bench: Bench) -> None:
    with svwfs.live(bench, average=2) as live:
        before = next(iter(live)).calibration
        live.take_reference(3)
        after = next(iter(live)).calibration
    assert before is not None
    assert after is not None
    assert (before.reference.frames, after.reference.frames) == (2, 3)


def test_live_bench_outside_its_block_refuses_requests(bench: Bench) -> None:
    live = svwfs.live(bench, average=2)
    for request in (live.take_dark, live.auto_expose, lambda: next(iter(live)), lambda: live.record("run", frames=1)):
        with pytest.raises(svwfs.WrongState, match="with block"):
            request()
    with live, pytest.raises(svwfs.WrongState, match="entered before"):
        live.__enter__()
    with pytest.raises(svwfs.WrongState):
        live.take_dark()


@pytest.mark.parametrize("cause", [None, ZeroDivisionError("division")], ids=["end of block", "error in block"])
def test_light_that_cannot_be_switched_off_is_reported_on_leaving(cause: Exception | None, bench: Bench) -> None:
    def fail(_: object) -> None:
        raise svwfs.DeviceError("the light may still be on")

    def run() -> None:
        with svwfs.live(bench, average=2) as live:
            assert isinstance(live._acquisition, Acquisition)
            live._result(live._acquisition.commands.submit(lambda instrument: _spoil(instrument.devices.light, fail)))
            if cause is not None:
                raise cause

    with pytest.raises((svwfs.DeviceError, ZeroDivisionError)) as caught:
        run()
    text = "".join([str(caught.value), *getattr(caught.value, "__notes__", [])])
    assert "the light may still be on" in text


def _spoil(light: LightSource, close: Callable[[object], None]) -> None:
    light._close = close.__get__(light)  # type: ignore[method-assign] # a light that does not answer


def test_ctrl_c_ends_the_recording(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with svwfs.live(bench, average=2) as live:
        wait_until(lambda: knows_sample(live._acquisition))  # else the recording does not begin at once

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as during:
            during.setattr(live._arrived, "wait", interrupt)
            with pytest.raises(KeyboardInterrupt):
                live.record(tmp_path / "first", frames=1000)
        wait_until(lambda: live._acquisition.recording.stage == "finished")  # type: ignore[union-attr] # begun
        live.record(tmp_path / "second", frames=2)
    assert len(svwfs.open_recording(tmp_path / "first")) < 1000
    assert len(svwfs.open_recording(tmp_path / "second")) == 2


def test_live_bench_closes_the_devices_after_an_error(bench: Bench) -> None:
    live = svwfs.live(bench, average=2)
    with pytest.raises(ZeroDivisionError), live:
        1 / 0  # noqa: B018 - any error
    assert not live._acquisition.is_alive


def test_missing_device_is_reported_on_entering(bench: Bench) -> None:
    absent = replace(bench, camera=DcamSettings(), light=DC4100Settings(port="none"))
    with pytest.raises(svwfs.DeviceError), svwfs.live(absent):
        pass
