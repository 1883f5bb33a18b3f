"""Streams for tests: a publisher with something to publish, and its subscribers."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import zmq
from numpy.typing import NDArray

from app.acquisition.streams.messages import TOPICS
from app.acquisition.streams.publisher import Publisher
from app.bench.config import Bench, StreamSettings
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.measurement.measurement import Assumptions, FrameTotals, Measurement, RefinementState
from drivers.interface import Frame
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import Wavefront
from support.optics import FIELD, SmallBench
from support.patience import HANG_S, wait_until


@pytest.fixture
def port() -> Iterator[int]:
    """A port that the system gives to nobody else until the end of the test."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as ZeroMQ's, which may listen there
        yield int(free.getsockname()[1])


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
    monkeypatch.setattr("app.acquisition.streams.guard._HANDSHAKE_MS", int(2000 * HANG_S))
    with closing(Publisher(replace(stream_bench, streams=StreamSettings(port=port)))) as publisher:
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
