"""An instrument and its clients: the same frames, states and commands as within one process, and who may command."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from support.gui_bench import BENCH, FakeCamera
from support.patience import HANG_S, wait_until
from support.served import connected, newest, served

from app.acquisition.address import taken_address
from app.acquisition.remote.connection import reach
from app.acquisition.remote.messages import Command
from app.acquisition.remote.server import Server
from app.errors import InputError, RunError
from app.measurement.measurement import Measurement
from app.recording.reader import Recording
from app.recording.recorder import RecordingLimit
from drivers.interface import BadValue, Disconnected, WrongState
from reconstruction.pupil import Pupil

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("runtime_folder")]  # each prepares a reference


def test_wavefronts_are_those_of_the_instrument(server: Server) -> None:
    there: dict[int, Measurement] = {}
    acquisition = server.acquisition
    acquisition._path.sinks = (*acquisition._path.sinks, lambda made: there.update({made.frame.index: made}))
    with connected() as connection:
        wait_until(lambda: connection.newest is not None and connection.newest.frame.index in there)
        found = newest(connection, lambda made: made.wavefront and made.frame.index in there)
        sent = there[found.frame.index]
        assert found.wavefront is not None
        assert sent.wavefront is not None
        np.testing.assert_array_equal(found.frame.pixels, sent.frame.pixels)
        np.testing.assert_array_equal(found.wavefront.views, sent.wavefront.views)
        np.testing.assert_allclose(found.wavefront.sigma(), sent.wavefront.sigma(), rtol=1e-6)  # in single precision
        assert (found.counts, found.quality.faults) == (sent.counts, sent.quality.faults)
        assert found.latency_s == sent.latency_s
        assert connection.bench == BENCH
        assert connection.stage_times().result(HANG_S)["register"].count > 0


@pytest.mark.usefixtures("server")
def test_commands_act_and_the_status_has_changed_when_they_are_done(fake_camera: FakeCamera) -> None:
    with connected() as connection:
        newest(connection)
        assert connection.has_control
        assert connection.set_exposure_s(0.03).result(HANG_S) == 0.03
        assert connection.status is not None
        assert connection.status.exposure_s == 0.03
        assert connection.status.dark.note.endswith("take it again")
        connection.take_dark(3).result(HANG_S)
        assert connection.status.dark.validity == "good"
        area = connection.status.area
        assert connection.set_area(area).result(HANG_S) == area
        assert connection.free_minutes(Path.cwd()).result(HANG_S) > 0
        assert fake_camera.light.shines
        connection.switch_light_off().result(HANG_S)
        assert not fake_camera.light.shines
        assert not connection.status.is_light_on


@pytest.mark.usefixtures("server")
def test_impossible_commands_are_refused() -> None:
    commands: list[tuple[str, tuple[object, ...], type[Exception]]] = [
        ("set_exposure_s", (0.055,), BadValue),
        ("set_exposure_s", ("abc",), BadValue),
        ("set_light_on", (1,), BadValue),
        ("limit_recording", (5,), BadValue),
        ("limit_recording", (RecordingLimit(frames="x"),), BadValue),  # type: ignore[arg-type] # of another program
        ("change_settings", ([("registration.threads", "x")],), BadValue),
        ("change_settings", ([("nothing.x", 5)],), BadValue),
        ("change_settings", ([5],), BadValue),
        ("take_dark", (0,), BadValue),
        ("status", (), BadValue),
        ("submit", (), BadValue),
        ("take_dark", (), BadValue),
        ("take_dark", (3, 4), BadValue),
        ("close", (), BadValue),
        ("_prepare", ("x",), BadValue),
        ("show_file", (Path("/nothing.tif"),), InputError),
    ]
    with connected() as connection:
        for name, arguments, error in commands:
            assert isinstance(connection.commands.add(name, *arguments).exception(HANG_S), error)
        assert isinstance(connection.commands.add("limit_recording", limit=5).exception(HANG_S), BadValue)
        connection.limit_recording(limit=RecordingLimit(frames=2)).result(HANG_S)
        newest(connection)  # it goes on


@pytest.mark.usefixtures("server")
def test_one_client_has_control_and_the_others_watch(fake_camera: FakeCamera) -> None:
    with connected("first") as first, connected("second") as second:
        wait_until(lambda: len(first.clients) == 2)
        assert first.has_control
        assert not second.has_control
        with pytest.raises(WrongState, match=r"only watches: first [\d.]+ has control"):
            second.take_dark(3).result(HANG_S)
        assert newest(second).wavefront is not None
        second.switch_light_off().result(HANG_S)  # anyone may
        assert isinstance(second.commands.add("set", {1, 2}).exception(HANG_S), RunError)
        assert not second.take_dark(3).cancel()  # it is on its way
        assert not fake_camera.light.shines
        second.take_control().result(HANG_S)
        assert second.has_control
        second.set_light_on(True).result(HANG_S)
        with pytest.raises(WrongState, match="second"):
            first.commands.add("cancel").result(HANG_S)


def test_command_that_its_client_gave_up_is_not_executed_unless_it_switches_off(
    fake_camera: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frozen instrument reads the commands when it goes on."""
    hear = Server._hear

    def give_up(send: Callable[[], Future[Any]]) -> None:
        goes_on = threading.Event()

        def hear_late(server: Server, identity: bytes, message: object, now_s: float) -> None:
            assert not isinstance(message, Command) or goes_on.wait(HANG_S)
            hear(server, identity, message, now_s)

        with monkeypatch.context() as frozen:
            frozen.setattr("app.acquisition.remote.connection.ANSWER_S", 1.2)
            frozen.setattr(Server, "_hear", hear_late)
            with pytest.raises(RunError, match="does not answer"):
                send().result(HANG_S)
            goes_on.set()

    with served(fake_camera, begin=lambda _: None), connected() as connection:
        wait_until(lambda: connection.status is not None)
        give_up(lambda: connection.set_light_on(True))
        connection.set_exposure_s(0.03).result(HANG_S)
        assert fake_camera.light.log.lightings == 0
        connection.set_light_on(True).result(HANG_S)
        assert fake_camera.light.shines
        give_up(connection.switch_light_off)
        wait_until(lambda: not fake_camera.light.shines)
        give_up(connection.shut_down)
        wait_until(lambda: not connection.is_alive)


@pytest.mark.usefixtures("server")
def test_control_is_free_when_its_client_leaves_or_falls_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    with connected("watching", takes_control=False) as other:
        with connected("first"):
            wait_until(lambda: other.controller.startswith("first"))
        wait_until(lambda: not other.controller)
        monkeypatch.setattr("app.acquisition.remote.server._SILENT_S", 1.5)
        with connected("silent") as silent:
            wait_until(lambda: other.controller.startswith("silent"))
            with monkeypatch.context() as silence:
                silence.setattr(silent, "_say", lambda *_: None)
                wait_until(lambda: not other.controller)
                assert other.clients == (other.name,)
            wait_until(lambda: silent.name in other.clients)  # it is heard again, and only watches
            assert not other.controller
            with pytest.raises(WrongState, match="nobody has control"):
                silent.take_dark(3).result(HANG_S)


@pytest.mark.usefixtures("server")
def test_a_last_command_is_sent_before_leaving(tmp_path: Path) -> None:
    with connected("watching", takes_control=False) as watching:
        with connected() as connection:
            newest(connection)
            connection.start_recording(tmp_path / "run").result(HANG_S)
            connection.stop_recording()
        wait_until(lambda: watching.recording is not None and watching.recording.stage == "finished")


@pytest.mark.usefixtures("server")
def test_a_late_client_gets_everything() -> None:
    with connected() as first:
        newest(first)
    with connected() as second:
        found = newest(second)
        assert found.calibration is not None
        assert found.calibration.dark is not None
        with_pupil = replace(BENCH.sensor, pupil=Pupil(shape="all"))  # all lenslets of the rectangle are lit
        assert found.calibration.bench == replace(BENCH, sensor=with_pupil)


@pytest.mark.usefixtures("server")
def test_frames_of_routines_are_shown_but_not_measured(fake_camera: FakeCamera) -> None:
    taken: list[Measurement] = []
    connection = reach("test", sinks=(taken.append,))
    try:
        newest(connection)
        fake_camera.period_s = 0.1
        future = connection.take_reference(20)
        shown = newest(connection, lambda made: "taking the reference" in made.problem)
        assert shown.wavefront is None
        wait_until(lambda: "taking the reference" in connection.activity.text)
        connection.cancel()
        assert future.exception(HANG_S) is not None
        assert not any("taking" in made.problem for made in taken)
    finally:
        connection.close()


@pytest.mark.usefixtures("server")
def test_recordings_are_made_by_the_instrument(tmp_path: Path) -> None:
    with connected() as connection:
        newest(connection)
        connection.start_recording(tmp_path / "run", limit=RecordingLimit(frames=5)).result(HANG_S)
        wait_until(lambda: connection.recording is not None and connection.recording.stage == "finished")
        with pytest.raises(InputError):
            connection.start_recording(tmp_path / "run").result(HANG_S)
    assert len(Recording(tmp_path / "run")) == 5


def test_a_failing_device_ends_the_instrument_and_its_clients_say_why(fake_camera: FakeCamera) -> None:
    with served(fake_camera), connected() as connection:
        newest(connection)
        fake_camera.fault = Disconnected("the camera was unplugged")
        wait_until(lambda: not connection.is_alive)
        assert isinstance(connection.error, Disconnected)
        assert connection.failure == "the camera was unplugged"
        assert isinstance(connection.take_dark(3).exception(HANG_S), Disconnected)
    assert not fake_camera.light.shines


def test_a_client_ends_the_instrument(fake_camera: FakeCamera) -> None:
    with served(fake_camera) as server, connected() as connection, connected() as other:
        newest(connection)
        connection.shut_down().result(HANG_S)
        wait_until(lambda: not connection.is_alive)
        wait_until(lambda: not other.is_alive)
        assert other.failure == "the instrument was shut down"
        wait_until(lambda: not server.acquisition.is_alive)
        assert not fake_camera.light.shines


def test_an_instrument_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.acquisition.remote.connection.ANSWER_S", 0.5)
    with taken_address() as address, zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        socket.bind(address.endpoint)
        address.announce()
        with pytest.raises(RunError, match=f"process {address.process} does not answer"):
            reach("test")
    assert not [each for each in threading.enumerate() if each.name.startswith("connection")]
