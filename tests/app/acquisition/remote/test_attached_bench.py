"""A bench of Python and `svwfs measure` on an instrument that runs elsewhere."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import pytest
from support.gui_bench import BENCH, FakeCamera
from support.patience import HANG_S, wait_until
from support.served import connected, newest, served

from app.acquisition.remote.server import Server
from app.acquisition.session import ConnectedBench, connect
from app.commands.measure import measure_attached
from app.errors import Interrupted, RunError
from app.recording.reader import Recording
from app.results.run_summary import Measured
from drivers.interface import WrongState

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("runtime_folder")]  # each prepares a reference


@pytest.mark.usefixtures("server")
def test_an_interrupted_recording_is_finished_before_the_client_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with connect() as bench:
        newest(bench._connection)

        def interrupt(*_: object) -> None:
            if bench.recording is not None and bench.recording.frames > 2:
                raise Interrupted("interrupted")

        monkeypatch.setattr(bench, "_progress", interrupt)
        with pytest.raises(Interrupted):
            bench.record(tmp_path / "run", 1000)
        assert Recording(tmp_path / "run").is_complete


@pytest.mark.usefixtures("server")
def test_a_watching_bench_switches_the_light_off(fake_camera: FakeCamera) -> None:
    with connected() as connection, connect(watch=True) as bench:
        newest(connection)
        bench.set_light(False)
        assert not fake_camera.light.shines
        with pytest.raises(WrongState, match="only watches"):
            bench.set_light(True)


def test_live_bench_in_another_process_works_as_in_this(server: Server, tmp_path: Path) -> None:
    with connect() as bench:
        for measurement in bench:
            if measurement.wavefront is not None:
                break
        assert bench.set_exposure(0.03) == 0.03
        assert bench.bench.sensor == BENCH.sensor
        bench.take_dark(3)
        bench.take_reference(3)
        assert next(iter(bench)).frame.exposure_s is not None
        bench.note_sample_in()
        assert len(Recording(bench.record(tmp_path / "run", 4))) == 4
        assert bench.controller in bench.clients
    assert server.acquisition.is_alive
    with ConnectedBench("other") as again:
        again.shut_down()
        wait_until(lambda: again.failure)


@pytest.mark.usefixtures("server")
def test_every_measurement_comes_once_and_those_missed_are_counted(fake_camera: FakeCamera) -> None:
    with connect() as bench:
        newest(bench._connection)
        every = bench.every()
        seen = [measurement.counts.acquired for measurement in islice(every, 10)]
        assert seen == list(range(seen[0], seen[0] + 10))
        assert bench.overtaken == 0
        fake_camera.period_s, before = 0.01, fake_camera._frames
        wait_until(lambda: fake_camera._frames > before + 30)  # more than the ring keeps
        seen += [measurement.counts.acquired for measurement in islice(every, 10)]
        assert bench.overtaken == seen[-1] - seen[0] + 1 - 20 > 0
        bench.shut_down()
        with pytest.raises(RunError, match="was shut down"):
            list(every)
    with pytest.raises(WrongState, match="its with block has ended"):
        bench.every()


def measured_attached(out: Path) -> Measured:
    return measure_attached("instrument", out, frames=4, progress=lambda *_: None)


@pytest.mark.usefixtures("server")
def test_measure_tells_of_a_light_that_is_off_before_it_records(fake_camera: FakeCamera, tmp_path: Path) -> None:
    with connected(takes_control=False) as connection:
        newest(connection)
        connection.switch_light_off().result(HANG_S)
    with pytest.raises(RunError, match="nothing was recorded: the light is off; switch it on"):
        measured_attached(tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert not fake_camera.light.shines


def test_measure_tells_of_a_missing_reference_before_it_records(fake_camera: FakeCamera, tmp_path: Path) -> None:
    with (
        served(fake_camera, begin=lambda _: None),
        pytest.raises(RunError, match="nothing was recorded: no reference yet"),
    ):
        measured_attached(tmp_path / "run")
    assert not (tmp_path / "run").exists()
