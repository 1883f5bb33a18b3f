"""Frames of another process's instrument: the newest or every one, what was overtaken, and a ring out of reach."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.gui_bench import make_frame
from support.patience import wait_until

from app.acquisition.remote.frames import RemoteFrames
from app.acquisition.serialization import Message
from app.acquisition.streams.messages import own_frame
from app.acquisition.streams.ring import RingWriter
from app.measurement.measurement import Measurement


def nothing(name: str, number: int) -> Future[Any]:
    """Stand for an instrument that is never asked."""
    raise AssertionError(name, number)


def publish(ring: RingWriter, frames: RemoteFrames, count: int, *, is_shown_only: bool = False) -> None:
    """Let an instrument write a record whose frame has the index `count`, in the ring of that name."""
    made = Measurement(make_frame(np.zeros((3, 4), np.uint16), index=count), None, "x")
    ring.write(Message(own_frame(made, {}, is_shown_only=is_shown_only)), count)
    frames.ring_name = ring.name


def test_frames_measured_before_a_command_are_shown_but_no_longer_passed_on(tmp_path: Path) -> None:
    passed: list[int] = []
    frames = RemoteFrames(nothing, (lambda made: passed.append(made.frame.index),), 0.0)
    with closing(RingWriter(10_000, tmp_path / "ring")) as ring:
        for index in range(3):
            if index == 1:
                frames.outdate(2)
            publish(ring, frames, index + 1)
            wait_until(lambda: frames.newest is not None and frames.newest.frame.index == index + 1)  # noqa: B023 - at once
        frames.close()
        frames.join()
    assert passed == [1, 3]


def indices(measurements: Iterator[Measurement], count: int) -> list[int]:
    return [made.frame.index for made in islice(measurements, count)]


@pytest.fixture
def frames() -> Iterator[RemoteFrames]:
    made = RemoteFrames(nothing, (), 0.0)
    yield made
    made.close()
    made.join()


def test_every_frame_comes_once_and_in_order_and_those_overtaken_are_counted(
    frames: RemoteFrames, tmp_path: Path
) -> None:
    with closing(RingWriter(10_000, tmp_path / "ring")) as ring:
        publish(ring, frames, 1)
        wait_until(lambda: frames.newest)
        every = frames.every()  # from now on
        for count in (2, 3, 4):
            publish(ring, frames, count, is_shown_only=count == 3)
        assert indices(every, 2) == [2, 4]
        wait_until(lambda: frames.newest is not None and frames.newest.frame.index == 4)
        assert frames.overtaken == 0
        for count in range(5, 16):  # three more than the ring has slots
            publish(ring, frames, count)
        assert indices(every, 8) == list(range(8, 16))
        assert frames.overtaken == 3
        publish(ring, frames, 20)  # nobody was there to read those between
        assert indices(every, 1) == [20]
        assert frames.overtaken == 7
        with closing(RingWriter(20_000, tmp_path / "ring")) as larger:
            for count in (21, 22):
                publish(ring, frames, count)
            for count in (23, 24):
                publish(larger, frames, count)
            assert indices(every, 1) == [21]
            frames.close()  # the instrument is gone: what is left is read
            assert [made.frame.index for made in every] == [22, 23, 24]
        assert frames.overtaken == 7


@pytest.mark.posix
def test_memory_that_cannot_be_opened_is_told(frames: RemoteFrames, monkeypatch: pytest.MonkeyPatch) -> None:
    """As from another container."""
    monkeypatch.setattr("app.acquisition.remote.frames._REPLACED_S", 0.0)
    frames.ring_name = "/proc/0/fd/3#elsewhere"
    wait_until(lambda: frames.error)
    assert "cannot be opened from here ([Errno 2] No such file or directory" in str(frames.error)
    assert "start it where the instrument runs" in str(frames.error)
