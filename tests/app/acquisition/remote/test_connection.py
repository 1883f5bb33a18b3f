"""An instrument and its clients: the same frames, states and commands as within one process, and who may command."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zmq
from support.gui_bench import BENCH, FakeCamera, make_frame
from support.patience import HANG_S, wait_until
from support.served import connected, served

from app.acquisition.instrument import Instrument
from app.acquisition.place import Place, runtime_folder, taken_place
from app.acquisition.remote.connection import Connection, reach
from app.acquisition.remote.frames import NewestFrames
from app.acquisition.remote.messages import MOST_BYTES, Accepted, Answer, Command, Hello, Notice, RingRecord, Sign
from app.acquisition.remote.ring import RingReader, RingWriter
from app.acquisition.remote.server import Server
from app.acquisition.remote.wire import Packed, unpacked
from app.acquisition.session import ConnectedBench, connect
from app.acquisition.start_up import start_up
from app.commands.measure import measure_attached
from app.errors import InputError, Interrupted, RunError
from app.measurement.measurement import Assumptions, Measurement, RefinementState
from app.recording.reader import Recording
from app.recording.recorder import RecordingLimit
from app.results.frame_tallies import Measured
from drivers.interface import BadValue, Disconnected, WrongState
from reconstruction.layers.layered_wavefront import FREE

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("runtime_folder")]  # each prepares a reference


@pytest.fixture
def camera() -> FakeCamera:
    return FakeCamera()


@pytest.fixture
def server(camera: FakeCamera, runtime_folder: Path) -> Iterator[Server]:
    assert runtime_folder.is_dir()
    with served(camera) as running:
        yield running


def newest(connection: Connection, holds: Callable[[Measurement], object] = lambda made: made.wavefront) -> Measurement:
    wait_until(lambda: connection.newest is not None and holds(connection.newest))
    assert connection.newest is not None
    return connection.newest


ONE_THREAD = """
import time
import scipy.linalg
from threadpoolctl import threadpool_info
from app.acquisition.remote.frames import NewestFrames

def threads():
    return max(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")

before = threads()
frames = NewestFrames(lambda _: None, (), 0.0)
while threads() == before:
    time.sleep(0.01)
during = threads()
frames.close()
frames.join()
print(before, during, threads())
"""


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="BLAS has as many threads as processors at most")
def test_client_keeps_to_one_thread_of_blas() -> None:
    """Others would wait busily: the client would take seven times the processor time, of the instrument, too."""
    environment, command = os.environ | {"OPENBLAS_NUM_THREADS": "2"}, [sys.executable, "-c", ONE_THREAD]
    said = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, timeout=HANG_S, check=True)  # noqa: S603 - our own program
    assert said.stdout == "2 1 2\n"


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
        np.testing.assert_array_equal(found.wavefront.sigma(), sent.wavefront.sigma())
        assert (found.counts, found.quality.faults) == (sent.counts, sent.quality.faults)
        assert found.latency_s == sent.latency_s
        assert connection.bench == BENCH
        wait_until(lambda: connection.timings.summary()["register"].count > 0)


@pytest.mark.usefixtures("server")
def test_commands_act_and_the_status_has_changed_when_they_are_done(camera: FakeCamera) -> None:
    with connected() as connection:
        newest(connection)
        assert connection.has_control
        assert connection.submit(Instrument.set, "exposure_s", 0.03, paused=True).result(HANG_S) == 0.03
        assert connection.status is not None
        assert connection.status.exposure_s == 0.03
        assert connection.status.dark.note.endswith("take it again")
        connection.submit(Instrument.take_dark, 3).result(HANG_S)
        assert connection.status.dark.validity == "good"
        area = connection.status.area
        assert connection.set_area(area).result(HANG_S) == area
        assert connection.free_minutes(Path.cwd()).result(HANG_S) > 0
        assert camera.light.shines
        connection.switch_light_off().result(HANG_S)
        assert not camera.light.shines
        assert not connection.status.is_light_on


@pytest.mark.usefixtures("server")
def test_impossible_commands_are_refused() -> None:
    commands: list[tuple[str, tuple[object, ...], type[Exception]]] = [
        ("set", ("exposure_s", 0.055), BadValue),
        ("set", ("exposure_s", "abc"), BadValue),
        ("limit_recording", (5,), BadValue),
        ("take_dark", (), BadValue),
        ("take_dark", (3, 4), BadValue),
        ("close", (), BadValue),
        ("_prepare", ("x",), BadValue),
        ("show_file", (Path("/nothing.tif"),), InputError),
    ]
    with connected() as connection:
        for name, arguments, error in commands:
            assert isinstance(connection._send(name, *arguments).exception(HANG_S), error)
        newest(connection)  # it goes on


@pytest.mark.usefixtures("server")
def test_one_client_has_control_and_the_others_watch(camera: FakeCamera) -> None:
    with connected("first") as first, connected("second") as second:
        wait_until(lambda: len(first.clients) == 2)
        assert first.has_control
        assert not second.has_control
        with pytest.raises(WrongState, match=r"only watches: first [\d.]+ has control"):
            second.submit(Instrument.take_dark, 3).result(HANG_S)
        assert newest(second).wavefront is not None
        second.switch_light_off().result(HANG_S)  # anyone may
        assert isinstance(second._send("set", {1, 2}).exception(HANG_S), TypeError)
        assert not second.submit(Instrument.take_dark, 3).cancel()  # it is on its way
        assert not camera.light.shines
        second.take_control().result(HANG_S)
        assert second.has_control
        second.submit(Instrument.set, "is_light_on", True).result(HANG_S)
        with pytest.raises(WrongState, match="second"):
            first._send("cancel").result(HANG_S)


@pytest.mark.usefixtures("server")
def test_control_is_free_when_its_client_leaves_or_falls_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    with connected("watching", controls=False) as other:
        with connected("first"):
            wait_until(lambda: other.controller.startswith("first"))
        wait_until(lambda: not other.controller)
        monkeypatch.setattr("app.acquisition.remote.server._SILENT_S", 1.5)
        with connected("silent") as silent:
            wait_until(lambda: other.controller.startswith("silent"))
            with monkeypatch.context() as silence:
                silence.setattr(silent, "_say", lambda _: None)
                wait_until(lambda: not other.controller)
                assert other.clients == (other.name,)
            wait_until(lambda: silent.name in other.clients)  # it is heard again, and only watches
            assert not other.controller
            with pytest.raises(WrongState, match="nobody has control"):
                silent.submit(Instrument.take_dark, 3).result(HANG_S)


@pytest.mark.usefixtures("server")
def test_connections_of_one_process_are_told_apart() -> None:
    with connected("notebook") as first, connected("notebook") as second:
        assert first.name != second.name
        assert first.has_control
        assert not second.has_control


@pytest.mark.usefixtures("server")
def test_a_last_command_is_sent_before_leaving(tmp_path: Path) -> None:
    with connected("watching", controls=False) as watching:
        with connected() as connection:
            newest(connection)
            connection.start_recording(tmp_path / "run").result(HANG_S)
            connection.stop_recording()
        wait_until(lambda: watching.recording is not None and watching.recording.stage == "finished")


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
def test_a_watching_bench_switches_the_light_off(camera: FakeCamera) -> None:
    with connected() as connection, connect(watch=True) as bench:
        newest(connection)
        bench.set_light(False)
        assert not camera.light.shines
        with pytest.raises(WrongState, match="only watches"):
            bench.set_light(True)


@pytest.mark.usefixtures("server")
def test_a_bias_that_the_instrument_subtracted_is_subtracted_here() -> None:
    with connected() as connection:
        made = newest(connection)
        assert made.registered is not None
        assert made.calibration is not None
        bias = np.full(made.registered.coefficients.shape, 0.1)
        bias[0] = 0.3
        applied = replace(made, assumed=Assumptions(FREE, RefinementState("applied", bias=bias)), wavefront=None)
        found = connection._frames._solved(RingRecord(applied, has_wavefront=True, is_shown_only=False))
        reconstructor = made.calibration.reconstructor()
        assert found.wavefront is not None
        assert made.wavefront is not None
        np.testing.assert_array_equal(found.wavefront.views, reconstructor.solve(made.registered, bias=bias).views)
        assert np.nanmax(np.abs(found.wavefront.views - made.wavefront.views)) > 0.01


def test_frames_measured_before_a_command_are_shown_but_no_longer_passed_on(tmp_path: Path) -> None:
    passed: list[int] = []
    frames = NewestFrames(lambda _: None, (lambda made: passed.append(made.frame.index),), 0.0)
    with closing(RingWriter(10_000, tmp_path)) as ring:
        for index in range(3):
            if index == 1:
                frames.outdate(2)
            measurement = Measurement(make_frame(np.zeros((3, 4), np.uint16), index=index), None, "x")
            frames.announce(Notice(ring.place, ring.write(Packed(RingRecord(measurement, False, False)))))
            wait_until(lambda: frames.newest is not None and frames.newest.frame.index == index)  # noqa: B023 - at once
        frames.close()
        frames.join()
    assert passed == [0, 2]


@pytest.mark.usefixtures("server")
def test_a_late_client_gets_everything() -> None:
    with connected() as first:
        newest(first)
    with connected() as second:
        found = newest(second)
        assert found.calibration is not None
        assert found.calibration.dark is not None
        assert found.calibration.bench == BENCH


@pytest.mark.usefixtures("server")
def test_frames_of_routines_are_shown_but_not_measured(camera: FakeCamera) -> None:
    taken: list[Measurement] = []
    connection = reach("test", sinks=(taken.append,))
    try:
        newest(connection)
        camera.period_s = 0.1
        future = connection.submit(Instrument.take_reference, 20)
        shown = newest(connection, lambda made: "taking the reference" in made.problem)
        assert shown.wavefront is None
        assert "taking the reference" in connection.activity.text
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


def test_a_failing_device_ends_the_instrument_and_its_clients_say_why(camera: FakeCamera) -> None:
    with served(camera), connected() as connection:
        newest(connection)
        camera.fault = Disconnected("the camera was unplugged")
        wait_until(lambda: not connection.is_alive)
        assert isinstance(connection.error, Disconnected)
        assert connection.failure == "the camera was unplugged"
        assert isinstance(connection.submit(Instrument.take_dark, 3).exception(HANG_S), Disconnected)
    assert not camera.light.shines


def test_a_client_ends_the_instrument(camera: FakeCamera) -> None:
    with served(camera) as server, connected() as connection, connected() as other:
        newest(connection)
        connection.shut_down().result(HANG_S)
        wait_until(lambda: not connection.is_alive)
        wait_until(lambda: not other.is_alive)
        assert other.failure == "the instrument was shut down"
        wait_until(lambda: not server.acquisition.is_alive)
        assert not camera.light.shines


def text_message(text: str) -> bytes:
    return len(text).to_bytes(8, "little") + bytes(56) + text.encode()


def test_strangers_are_not_heard(server: Server) -> None:
    with connected(controls=False) as watching, zmq.Context() as context:
        wait_until(lambda: server.acquisition.status is not None)
        messages: list[list[bytes | bytearray]] = [
            [b"wrong key", Packed(Hello("stranger", True, 0.0)).message()],
            [server.place.key.encode(), b"no message"],
            [server.place.key.encode(), text_message('{"of":[]}')],
            [server.place.key.encode(), text_message('{"tuple":[' * 5000 + "]}" * 5000)],
            [server.place.key.encode()],
            [b""],
            [server.place.key.encode(), Packed(Command(1, "shut_down")).message()],  # without a hello
            [server.place.key.encode(), Packed(Sign.ALIVE).message(), b"more"],
        ]
        for parts in messages:
            with context.socket(zmq.DEALER) as socket:
                socket.connect(server.place.endpoint)
                socket.send_multipart(parts)
        newest(watching)
        time.sleep(0.3)
        assert watching.clients == (watching.name,)
        assert watching.is_alive
        assert not watching.controller


@contextmanager
def silent_client(server: Server) -> Iterator[zmq.Socket[bytes]]:
    """A client that has said hello, and reads no more."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.RCVHWM, 1)
        socket.connect(server.place.endpoint)
        say(socket, server, Hello("silent", True, 0.0))
        wait_until(lambda: server._clients)
        yield socket


def say(socket: zmq.Socket[bytes], server: Server, message: object) -> None:
    socket.send_multipart([server.place.key.encode(), Packed(message).message()])


def send_notices(server: Server, count: int) -> None:
    """Let the server tell of so many frames, one after the other."""
    frame = Measurement(make_frame(np.zeros((3, 4), np.uint16)), None, "x")
    for _ in range(count):
        before = server._noticed
        server._publish(frame, is_shown_only=True)
        while server._noticed == before:
            time.sleep(0.0005)


def read_all(socket: zmq.Socket[bytes]) -> list[object]:
    """The messages that have arrived; those whose object is missing are left out."""
    found = list[object]()
    while socket.poll(500):
        with suppress(RunError, ValueError):
            found.append(unpacked(socket.recv()))
    return found


def test_an_answer_reaches_a_client_that_did_not_read_for_long(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    wait_until(lambda: server.acquisition.status is not None)
    monkeypatch.setattr("app.acquisition.remote.server._SILENT_S", 60.0)
    monkeypatch.setattr("app.acquisition.remote.server._BEHIND_S", 60.0, raising=False)
    with silent_client(server) as socket:
        send_notices(server, 2000)  # more than the system keeps by itself
        say(socket, server, Command(7, "free_minutes", (Path.cwd(),)))
        answers = [each.number for each in read_all(socket) if isinstance(each, Answer)]
    assert answers == [7]


def test_a_client_that_does_not_read_gets_no_news_until_it_does(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_until(lambda: server.acquisition.status is not None)
    monkeypatch.setattr("app.acquisition.remote.server._SILENT_S", 60.0)
    monkeypatch.setattr("app.acquisition.remote.server._BEHIND_S", 0.1)
    with silent_client(server) as socket:
        time.sleep(0.3)
        read_all(socket)
        send_notices(server, 20)
        assert read_all(socket) == []
        say(socket, server, Sign.ALIVE)
        told = [each.count for each in read_all(socket) if isinstance(each, Notice)]
    assert server._ring is not None
    assert told
    assert told[0] > 20


@pytest.mark.parametrize("is_every_frame_read", [False, True])
def test_frames_are_passed_on_as_often_as_they_are_read(server: Server, is_every_frame_read: bool) -> None:
    sinks = (lambda _: None,) if is_every_frame_read else ()
    with closing(reach("client", sinks=sinks)) as connection:
        newest(connection)
        connection.submit(Instrument.set, "is_running", False).result(HANG_S)
        assert server._ring is not None
        frame, before, began_s = make_frame(np.zeros((3, 4), np.uint16)), server._ring.count, time.monotonic()
        for number in range(100):
            time.sleep(0.002)
            server._publish(Measurement(frame, None, str(number)), is_shown_only=False)
        written, seconds = server._ring.count - before, time.monotonic() - began_s
        assert written == 100 if is_every_frame_read else 0 < written <= seconds / 0.02 + 1
        newest(connection, lambda made: made.problem == "99")


def test_a_disk_that_does_not_answer_holds_up_nobody(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = threading.Event()
    monkeypatch.setattr(server.acquisition._recorder, "free_minutes", lambda _: answers.wait(HANG_S) and 7.0)
    with connected() as connection:
        asked = connection.free_minutes(Path.cwd())
        connection.take_control().result(HANG_S)
        assert not asked.done()
        answers.set()
        assert asked.result(HANG_S) == 7.0


def test_messages_that_are_too_large_are_not_heard(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    large = Command(1, "use", (np.zeros(2**20),))
    with connected(controls=False) as watching, silent_client(server) as socket:
        monkeypatch.setattr("app.acquisition.remote.outbox.MOST_BYTES", 2**10)
        with pytest.raises(BadValue, match="too large"):
            watching._send("use", *large.arguments).result(HANG_S)
        assert server._socket.getsockopt(zmq.MAXMSGSIZE) == MOST_BYTES
        say(socket, server, large)
        assert any(isinstance(each, Accepted) for each in read_all(socket))  # this one may come


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # the worker ends loudly
@pytest.mark.parametrize("where", ["_publish", "_answer"])
def test_a_fault_of_the_instruments_end_switches_the_light_off_and_is_told(
    camera: FakeCamera, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    faults = list[Exception]()

    def fail(*_: object, **__: object) -> None:
        raise OSError("no memory is left")

    with served(camera, faults=faults) as server, connected() as connection:
        newest(connection)
        if where == "_publish":
            monkeypatch.setattr(server, "_write", fail)
        else:
            monkeypatch.setattr(server, "_answer", fail)
            connection.take_control()
        wait_until(lambda: not connection.is_alive)
        assert connection.failure == "OSError: no memory is left"
        wait_until(lambda: faults)
        assert not server.acquisition.is_alive
        assert not camera.light.shines
    assert str(faults[0]) == "no memory is left"


def test_everything_is_closed_though_one_step_fails(camera: FakeCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError("no state")

    faults = list[Exception]()
    with served(camera, faults=faults) as server:
        with connected() as connection:
            newest(connection)
        monkeypatch.setattr(server, "_tell_state", fail)
        wait_until(lambda: faults)
        assert not server.acquisition.is_alive
        assert not camera.light.shines
        assert server._socket.closed
        assert server._ring is not None
        with pytest.raises(FileNotFoundError):
            RingReader(server._ring.place)


def test_larger_frames_get_a_larger_ring(server: Server) -> None:
    with closing(reach("client", sinks=(lambda _: None,))) as connection:  # else it might be left out
        found = newest(connection)
        before = server._ring
        assert before is not None
        assert connection.status is not None
        assert found.frame.pixels.nbytes < before._stride
        server._publish(
            Measurement(found.frame.__class__(np.zeros((900, 900), np.uint16), 7, 0.0, 0.0, 0.1, 1.0), None, "large"),
            is_shown_only=True,
        )
        wait_until(lambda: server._ring is not before)
        newest(connection)  # goes on in the new one


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


def measured_attached(out: Path) -> Measured:
    return measure_attached("instrument", 4, out, lambda *_: None)


@pytest.mark.usefixtures("server")
def test_measure_tells_of_a_light_that_is_off_before_it_records(camera: FakeCamera, tmp_path: Path) -> None:
    with connected(controls=False) as connection:
        newest(connection)
        connection.switch_light_off().result(HANG_S)
    with pytest.raises(RunError, match="nothing was recorded: the light is off; switch it on"):
        measured_attached(tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert not camera.light.shines


def test_measure_tells_of_a_missing_reference_before_it_records(camera: FakeCamera, tmp_path: Path) -> None:
    with served(camera, begin=lambda _: None), pytest.raises(RunError, match="nothing was recorded: no reference yet"):
        measured_attached(tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("server")
def test_a_measurement_after_a_command_was_taken_after_it(camera: FakeCamera) -> None:
    with connect() as bench:
        for measurement in bench:
            if measurement.wavefront is not None:
                break
        for exposure_s in (0.03, 0.04, 0.045):
            bench.set_exposure(exposure_s)
            after = camera._index
            assert next(iter(bench)).frame.index >= after - 2


def test_without_an_instrument_the_sentence_says_how_to_start_one() -> None:
    with pytest.raises(RunError, match=r"no instrument runs: start one with svwfs serve"):
        reach("test")
    (runtime_folder() / "instrument.json").write_text("{")  # of a killed one
    with pytest.raises(RunError, match="no instrument runs"):
        reach("test")
    assert [each.name for each in runtime_folder().iterdir()] == ["instrument.lock"]


def test_a_place_belongs_to_one_instrument() -> None:
    with taken_place() as place:
        place.announce()
        assert Place.of() == place
        with pytest.raises(RunError, match="runs as instrument already"), taken_place():
            pass
        with taken_place("second") as second:
            assert second.endpoint != place.endpoint
    with pytest.raises(RunError, match="no instrument runs"):
        Place.of()


@pytest.mark.parametrize("name", ["", "../x", "a b", "a/b"])
def test_names_that_are_no_words_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="cannot have the name"), taken_place(name):
        pass
    with pytest.raises(InputError, match="cannot have the name"):
        Place.of(name)


@pytest.mark.skipif(os.name != "posix", reason="Windows has a temporary folder for each user")
def test_desktop_and_cron_find_the_same_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("SVWFS_RUNTIME_DIR")
    found = set[Path]()
    for variables in ({}, {"XDG_RUNTIME_DIR": str(tmp_path), "TMPDIR": str(tmp_path)}):
        for name in ("XDG_RUNTIME_DIR", "TMPDIR"):
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr("tempfile.tempdir", None)
        found.add(runtime_folder())
    assert found == {Path(f"/tmp/svwfs-{os.getuid()}")}  # noqa: S108 - the folder that is meant


def test_a_folder_that_others_may_enter_is_refused() -> None:
    runtime_folder().chmod(0o755)
    with pytest.raises(RunError, match="open to others"), taken_place():
        pass


def test_an_instrument_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.acquisition.remote.connection.ANSWER_S", 0.5)
    with taken_place() as place, zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        socket.bind(place.endpoint)
        place.announce()
        with pytest.raises(RunError, match=f"process {place.process} does not answer"):
            reach("test")
    assert not [each for each in threading.enumerate() if each.name.startswith("connection")]


def test_commands_sent_at_start_up_are_those_of_any_instrument(camera: FakeCamera) -> None:
    with served(camera, begin=lambda _: None), connected() as connection:
        wait_until(lambda: connection.status is not None)
        for step in start_up(connection, 3):
            step.result(HANG_S)
        assert newest(connection).wavefront is not None
