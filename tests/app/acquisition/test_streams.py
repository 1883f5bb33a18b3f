"""Streams: subscribers receive exact results, cost the acquisition nothing, and cannot flood it."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from numpy.typing import NDArray
from support.command_line import run
from support.optics import FIELD, SmallBench
from support.paths import DOCS
from support.patience import HANG_S, wait_until

from app.acquisition.streams.messages import TOPICS
from app.acquisition.streams.publisher import Publisher
from app.bench.config import Bench, StreamSettings
from app.errors import RunError
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.measurement.measurement import Assumptions, FrameTotals, Measurement, RefinementState
from app.recording.reader import Recording
from drivers.interface import Frame
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.settings import ReconstructionSettings
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront, rms

DOCUMENT = DOCS / "sharing.md"


@pytest.fixture
def port() -> Iterator[int]:
    """A port that the system gives to nobody else until the end of the test."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as ZeroMQ's, which may listen there
        port = int(free.getsockname()[1])
        if sys.platform == "win32":  # where ZeroMQ shares no port
            free.close()
        yield port


@pytest.fixture(scope="session")
def stream_bench(small_bench: SmallBench) -> Bench:
    return Bench(sensor=small_bench.sensor, field=FIELD)


@pytest.fixture(scope="session")
def measurement(small_bench: SmallBench, stream_bench: Bench) -> Measurement:
    frame, _ = small_bench.tilted(3000.0, 500.0)
    frame[: frame.shape[0] // 6] = 0  # lost lenslets, so that NaN is sent
    reference = Average(small_bench.reference, np.zeros_like(small_bench.reference), 1, 0.02, 8.0, "em")
    changed = ReconstructionSettings(basis="zernike")  # since it was opened
    in_force = replace(stream_bench, reconstruction=changed)
    calibration = Calibration(
        bench=in_force, dark=None, reference=reference, lattice=small_bench.lattice, full_scale=65535.0
    )
    return replace(measured(small_bench.reconstructor()(frame), 5), calibration=calibration)


def measured(wavefront: Wavefront | None, index: int, problem: str = "") -> Measurement:
    now_s = time.perf_counter()
    frame = Frame(
        pixels=np.zeros((2, 3), np.uint16),
        index=index,
        camera_time_s=7.25,
        host_time_s=now_s - 0.01,
        exposure_s=0.02,
        em_gain=8.0,
    )
    layer = AssumedSample((-0.975,), np.array([[0.01**2]]))  # 195 +- 2 mm before the lenslets
    assumed = Assumptions(layer, RefinementState("applied", 0.75, 0.01)) if index % 2 else Assumptions()
    return Measurement(frame, wavefront, problem, FrameTotals(9, 8, 1), now_s - 0.02, 0.02, assumed=assumed)


class Subscriber:
    """Subscriber in its own socket."""

    def __init__(self, port: int, *topics: str, keeps_little: bool = False) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        if keeps_little:
            self._socket.setsockopt(zmq.RCVHWM, 1)
            self._socket.setsockopt(zmq.RCVBUF, 1 << 16)
        self._socket.connect(f"tcp://127.0.0.1:{port}")
        for topic in topics:
            self._socket.subscribe(topic)
        self.topics = len(TOPICS) if "" in topics else len(topics)  # number of messages per measurement

    def close(self) -> None:
        self._context.destroy(linger=0)

    def hears(self, timeout_s: float = HANG_S) -> tuple[str, dict[str, Any], dict[str, NDArray[Any]]]:
        assert self._socket.poll(int(timeout_s * 1000))
        topic, text, *parts = self._socket.recv_multipart()
        header = json.loads(text)
        assert len(parts) == len(header["arrays"])
        return (
            topic.decode(),
            header,
            {
                array["name"]: np.frombuffer(part, array["dtype"]).reshape(array["shape"])
                for array, part in zip(header["arrays"], parts, strict=True)
            },
        )

    def is_waiting(self) -> bool:
        return not self._socket.poll(50)


@pytest.fixture
def publisher(stream_bench: Bench, port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Publisher]:
    """A publisher whose connections may say nothing for longer than any test."""
    monkeypatch.setattr("app.acquisition.streams.publisher._HANDSHAKE_MS", int(2000 * HANG_S))
    with running(stream_bench, port) as publisher:
        yield publisher


@contextmanager
def running(bench: Bench, port: int | None, address: str = "127.0.0.1") -> Iterator[Publisher]:
    publisher = Publisher(replace(bench, streams=StreamSettings(port=port, address=address)))
    with publisher.running():
        yield publisher


def until_heard(publisher: Publisher, subscriber: Subscriber, measurement: Measurement) -> int:
    """Publish until every topic arrives, receive all messages, and return the last sequence number."""
    heard = set[str]()

    def hears_every_topic() -> bool:
        publisher.take(measurement)
        while not subscriber.is_waiting():
            heard.add(subscriber.hears()[0])
        return len(heard) == subscriber.topics

    wait_until(hears_every_topic)
    publisher.take(measurement)  # what was published before arrives before it
    for _ in range(subscriber.topics):
        while subscriber.hears()[1]["sequence"] < publisher._sequence:
            pass
    return publisher._sequence


def test_subscriber_receives_exact_arrays(
    publisher: Publisher, port: int, measurement: Measurement, stream_bench: Bench, small_bench: SmallBench
) -> None:
    wavefront = measurement.wavefront
    assert wavefront is not None
    assert isinstance(wavefront.solution, ModalSolution)
    assert 0 < np.count_nonzero(wavefront.displacement.valid) < wavefront.displacement.valid.size
    with closing(Subscriber(port, "")) as subscriber:
        before = until_heard(publisher, subscriber, measurement)
        publisher.take(measurement)
        heard = {topic: (header, arrays) for topic, header, arrays in (subscriber.hears() for _ in range(3))}
    expected: dict[str, dict[str, NDArray[Any]]] = {
        "coefficients": {
            "coefficients": wavefront.solution.coefficients,
            "coefficients_sigma": wavefront.solution.coefficients_sigma,
        },
        "slopes": {
            "slopes": wavefront.displacement.coefficients * stream_bench.sensor.slope_per_px,
            "slopes_sigma": np.sqrt(wavefront.displacement.variance) * stream_bench.sensor.slope_per_px,
            "valid": wavefront.displacement.valid.astype(np.uint8),
        },
        "views": {"wavefront": wavefront.views, "wavefront_sigma": wavefront.sigma()},
    }
    assert heard.keys() == expected.keys()
    for topic, arrays in expected.items():
        header, received = heard[topic]
        assert received.keys() == arrays.keys()
        for array, about in zip(arrays.values(), header["arrays"], strict=True):
            np.testing.assert_array_equal(received[about["name"]], array)
            assert received[about["name"]].dtype == array.dtype
            assert len(about["dimensions"]) == array.ndim
        assert (header["format"], header["sequence"], header["frame"]) == (1, before + 1, 5)
        assert header["camera_time_s"] == 7.25
        assert header["exposure_end_unix_s"] == pytest.approx(time.time() - 0.02, abs=100)
        assert (header["refinement"], header["bias_age_s"], header["problem"]) == ("applied", 0.75, "")
        assert header["layers"] == [{"distance_m": pytest.approx(0.195), "distance_sigma_m": pytest.approx(2e-3)}]
        assert header["sensor"]["wavelength_m"] == stream_bench.sensor.wavelength_m
        assert header["lattice"] == asdict(small_bench.lattice)
        assert header["reconstruction"]["basis"] == "zernike"
        assert header["view_x_m"] == [-0.5e-3, 0, 0.5e-3]
        assert header["pupil_y_m"] == pytest.approx(np.arange(-3, 4) * 500e-6)


def test_subscriber_receives_only_its_topics(publisher: Publisher, port: int, measurement: Measurement) -> None:
    with closing(Subscriber(port, "slopes")) as subscriber:
        until_heard(publisher, subscriber, measurement)
        publisher.take(measurement)
        assert subscriber.hears()[0] == "slopes"
        assert subscriber.is_waiting()


def test_frame_without_wavefront_is_published(publisher: Publisher, port: int, measurement: Measurement) -> None:
    with closing(Subscriber(port, "views")) as subscriber:
        until_heard(publisher, subscriber, measurement)
        publisher.take(measured(None, 6, "the frame is saturated"))
        _, header, arrays = subscriber.hears()
    assert (header["frame"], header["problem"], header["arrays"], arrays) == (6, "the frame is saturated", [], {})
    assert (header["refinement"], header["bias_age_s"], header["lattice"]) == ("off", None, None)
    assert header["layers"] == []


def test_zonal_method_publishes_no_coefficients(
    publisher: Publisher, port: int, small_bench: SmallBench, measurement: Measurement
) -> None:
    zonal = measured(small_bench.reconstructor(method="zonal")(small_bench.reference), 8)
    with closing(Subscriber(port, "coefficients", "slopes")) as subscriber:
        until_heard(publisher, subscriber, measurement)
        publisher.take(zonal)
        assert subscriber.hears()[0] == "slopes"
        assert subscriber.is_waiting()


def test_stalled_subscriber_blocks_nothing(publisher: Publisher, port: int, measurement: Measurement) -> None:
    """More is published than is queued for it; another subscriber receives every measurement."""
    with closing(Subscriber(port, "views", keeps_little=True)) as stalled, closing(Subscriber(port, "slopes")) as other:
        until_heard(publisher, stalled, measurement)
        until_heard(publisher, other, measurement)
        sequence = 0
        for _ in range(1000):
            publisher.take(measurement)
            heard = other.hears()[1]["sequence"]
            assert heard == sequence + 1 or not sequence
            sequence = heard
        sequences = []
        while not stalled.is_waiting():
            sequences.append(stalled.hears()[1]["sequence"])
        assert np.all(np.diff(sequences) > 0)
        assert len(sequences) < 400  # the gaps show that it missed the others


@pytest.fixture
def lingers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last messages are sent, however late ZeroMQ's own thread is."""
    monkeypatch.setattr("app.acquisition.streams.publisher._LINGER_MS", int(1000 * HANG_S))


@pytest.mark.usefixtures("lingers")
def test_close_sends_waiting_messages(stream_bench: Bench, port: int, measurement: Measurement) -> None:
    with closing(Subscriber(port, "slopes")) as subscriber:
        with running(stream_bench, port) as publisher:
            before = until_heard(publisher, subscriber, measurement)
            publisher.take(measurement)
        assert subscriber.hears()[1]["sequence"] == before + 1
    with socket.socket() as free:  # the port is free again
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        free.bind(("127.0.0.1", port))


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("lingers")
def test_measure_publishes_what_it_records(
    port: int, small_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A subscriber from before the start; a busy computer may skip some frames."""
    arguments = ("--bench", small_toml, "--set", f"streams.port={port}", "--frames", "6", "--out", tmp_path / "run")
    with closing(Subscriber(port, "coefficients")) as subscriber:
        assert run(monkeypatch, "measure", *arguments) == 0
        recording = Recording(tmp_path / "run")
        indexes = {recording.line(index).camera_time_s: index for index in range(len(recording))}
        heard: dict[float, tuple[dict[str, Any], np.ndarray]] = {}
        while not heard.keys() & indexes or not subscriber.is_waiting():
            _, header, arrays = subscriber.hears()
            if arrays:
                heard[header["camera_time_s"]] = header, arrays["coefficients"]
    for camera_time_s in heard.keys() & indexes:
        index = indexes[camera_time_s]
        line = recording.line(index)
        header, coefficients = heard[camera_time_s]
        assert (header["frame"], header["lattice"]["center_x_px"]) == (line.camera_index, 121.3)
        np.testing.assert_array_equal(coefficients, recording.coefficients(index))


def test_taken_port_ends_command(
    publisher: Publisher,
    port: int,
    small_toml: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    settings = ("--bench", small_toml, "--set", f"streams.port={port}")
    assert publisher
    assert run(monkeypatch, "measure", *settings, "--frames", "2", "--out", tmp_path / "run") == 1
    assert re.search(f"127.0.0.1:{port}: Address (already )?in use", capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


@pytest.mark.posix  # a pipe cannot be polled there
def test_documented_subscriber_runs(publisher: Publisher, port: int, measurement: Measurement) -> None:
    example = re.search(r"<!-- tested apart -->\n```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert example is not None
    program = example[1].replace("5560", str(port))
    assert program != example[1]
    wavefront = measurement.wavefront
    assert wavefront is not None
    with subprocess.Popen([sys.executable, "-u", "-c", program], stdout=subprocess.PIPE, text=True) as running:  # noqa: S603 - our own document
        try:
            assert running.stdout is not None
            while not _can_be_read(running.stdout.fileno()):
                publisher.take(measurement)
            text = running.stdout.readline() + "".join(running.stdout.readline() for _ in range(2))
        finally:
            running.kill()
    frame, *values = (float(number) for number in re.findall(r"[-\d.e]+", text))
    assert frame == 5
    np.testing.assert_allclose(values, rms(wavefront.views).ravel(), rtol=1e-6)


def _can_be_read(descriptor: int) -> bool:
    poller = zmq.Poller()
    poller.register(descriptor, zmq.POLLIN)
    return bool(poller.poll(50))


@pytest.mark.posix
def test_without_port_no_socket_is_opened(stream_bench: Bench, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zmq, "Context", lambda: pytest.fail("a socket was made"))
    with running(stream_bench, None):
        pass
    monkeypatch.undo()
    with running(stream_bench, port):
        listening = _listening(port)
    assert listening == ["127.0.0.1"]


def _listening(port: int) -> list[str]:
    """Addresses on which a port is open, from the kernel's table."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    local = [row[1].split(":") for row in rows if row[3] == "0A"]
    return [socket.inet_ntoa(bytes.fromhex(host)[::-1]) for host, at in local if int(at, 16) == port]


def test_taken_port_is_one_sentence(stream_bench: Bench, port: int) -> None:
    with (
        running(stream_bench, port),
        pytest.raises(RunError, match=rf"127.0.0.1:{port}: Address (already )?in use; change streams.port"),
        running(stream_bench, port),
    ):
        pass


def test_foreign_address_is_one_sentence(stream_bench: Bench, port: int) -> None:
    with pytest.raises(RunError, match=r"assign|not available"), running(stream_bench, port, "192.0.2.1"):
        pass


def test_long_topic_closes_its_connection(publisher: Publisher, port: int, measurement: Measurement) -> None:
    with closing(Subscriber(port, "views")) as subscriber, closing(Subscriber(port, "v" * 10_000)) as other:
        until_heard(publisher, subscriber, measurement)
        assert max(map(len, publisher._subscriptions)) < 10_000
        assert other.is_waiting()


@pytest.mark.parametrize(("address", "is_warned"), [("127.0.0.1", False), ("127.8.9.1", False), ("0.0.0.0", True)])  # noqa: S104 - it is warned of
def test_open_address_is_warned_of(
    stream_bench: Bench, port: int, capsys: pytest.CaptureFixture[str], address: str, is_warned: bool
) -> None:
    with running(stream_bench, port, address):
        pass
    errors = capsys.readouterr().err
    assert errors.startswith("warning: every computer that reaches 0.0.0.0 can read the results") == is_warned
    assert bool(errors) == is_warned
