"""The shared ring: every record is whole or refused, whoever reads, however slowly, and nothing stays behind."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from app.acquisition.serialization import Message, unpacked
from app.acquisition.streams.ring import RingReader, RingWriter


@pytest.fixture(params=["memory", pytest.param("file", marks=pytest.mark.posix)])
def ring(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RingWriter]:
    with monkeypatch.context() as elsewhere:
        if request.param == "file":  # as on other systems than Linux
            elsewhere.setattr(sys, "platform", "darwin")
        writer = RingWriter(20_000, tmp_path / "ring", slots=4)
    with closing(writer):
        yield writer


def record(number: int) -> Message:
    return Message((number, np.full(2000, number, np.int64)))


def test_records_arrive_until_they_are_overwritten(ring: RingWriter) -> None:
    with closing(RingReader(ring.name)) as reader:
        assert (reader.count, reader.read(0), reader.read(1)) == (0, None, None)
        for number in range(1, 11):
            assert ring.has_room_for(record(number))
            ring.write(record(number), number)
            assert reader.count == number
        kept = [count for count in range(-3, 15) if reader.read(count) is not None]
        assert kept == [7, 8, 9, 10]
        for count in kept:
            body = reader.read(count)
            assert body is not None
            number, array = unpacked(body)
            assert number == count
            assert (array == number).all()


def test_a_record_being_written_is_not_returned(ring: RingWriter) -> None:
    seen: list[bytes | None] = []
    with closing(RingReader(ring.name)) as reader:
        for number in (1, 2, 3, 4):
            ring.write(record(number), number)

        class Slow(Message):
            def write(self, buffer: memoryview) -> None:
                seen.append(reader.read(1))  # the slot that is being replaced
                seen.append(reader.read(5))
                super().write(buffer)
                seen.append(reader.read(5))

        ring.write(Slow((5, np.zeros(3))), 5)
        assert seen == [None, None, None]
        assert reader.read(5) is not None


def test_records_overwritten_while_they_are_copied_are_refused(
    ring: RingWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(RingReader(ring.name)) as reader:
        ring.write(record(1), 1)

        class Overtaken:
            def __init__(self, memory: object) -> None:
                self.memory = memory

            def __getitem__(self, part: slice) -> bytes:
                for number in (2, 3, 4, 5):  # while the reader copies
                    ring.write(record(number), number)
                return bytes(self.memory[part])  # type: ignore[index] # of a mapped file

            def __buffer__(self, flags: int) -> memoryview:  # pragma: no cover - newer Pythons
                return memoryview(self.memory)  # type: ignore[arg-type] # the same

        memory = reader._memory
        unpack_from = __import__("struct").unpack_from
        monkeypatch.setattr(
            "app.acquisition.streams.ring.struct.unpack_from", lambda form, _, start: unpack_from(form, memory, start)
        )
        monkeypatch.setattr(reader, "_memory", Overtaken(memory))
        assert reader.read(1) is None
        monkeypatch.setattr(reader, "_memory", memory)


def test_a_busy_writer_never_gives_a_torn_record(ring: RingWriter) -> None:
    whole, over = 0, threading.Event()

    def write() -> None:
        number = 0
        while not over.is_set():
            number += 1
            ring.write(record(number), number)

    thread = threading.Thread(target=write, name="writer")
    thread.start()
    try:
        with closing(RingReader(ring.name)) as reader:
            while whole < 300:
                if (body := reader.read(count := reader.count)) is not None:
                    number, array = unpacked(body)
                    assert number == count
                    assert (array == number).all()
                    whole += 1
    finally:
        over.set()
        thread.join()


def test_ring_that_a_reader_has_open_can_be_closed(tmp_path: Path) -> None:
    """Windows removes no file that is open."""
    writer = RingWriter(20_000, tmp_path / "ring")
    writer.write(record(1), 1)
    with closing(RingReader(writer.name)) as reader:
        writer.close()
        assert reader.read(1) is not None
    assert not list(tmp_path.iterdir())


@pytest.mark.posix  # Windows has no file of it
def test_another_file_is_no_ring(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_bytes(b"x" * 1000)
    with pytest.raises(ValueError, match="no ring"):
        RingReader(f"{other}#1234")
    with pytest.raises(OSError, match="nothing"):
        RingReader(str(tmp_path / "nothing#1234"))
