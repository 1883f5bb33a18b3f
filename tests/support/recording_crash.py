"""Kill a recording program and check what it leaves on disk.

The program reports every acquired frame through a pipe, so the number of acquired frames is known.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from app.acquisition.devices import open_devices
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, load_bench
from app.recording.reader import Recording
from drivers.interface import Devices, Frame
from support.patience import HANG_S

_MESSAGE = struct.Struct("<qId")  # camera index, checksum of the pixels, time of arrival in s


@dataclass(frozen=True, slots=True)
class Left:
    """State of a recording after its program was killed."""

    acquired: int  # since the recording began
    missing: int  # of those, without a line in frames.jsonl
    wrong: int  # with a line, but other pixels than the camera gave, or none
    rate_hz: float


def kill_one(bench: str, settings: tuple[str, ...], folder: Path, *, after_s: float) -> Left:
    """Start a program that records into `folder`, kill it some time after its first line, and check the recording."""
    reading, writing = os.pipe()
    program_itself = [sys.executable, "-m", "support.recording_crash"]
    command = [*program_itself, "--record", str(folder), "--pipe", str(writing), "--bench", bench, *settings]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    program = subprocess.Popen(command, pass_fds=[writing], env=environment)  # noqa: S603 - this file
    os.close(writing)
    told = b""
    try:
        deadline_s = time.monotonic() + HANG_S
        lines = folder / "frames.jsonl"
        while not (lines.exists() and lines.stat().st_size):
            assert program.poll() is None
            assert time.monotonic() < deadline_s
            told += os.read(reading, 1 << 14)
        end_s = time.monotonic() + after_s
        while (left_s := end_s - time.monotonic()) > 0:
            time.sleep(min(left_s, 0.1))
            told += os.read(reading, 1 << 14)
    finally:
        program.kill()
        program.wait()
        while piece := os.read(reading, 1 << 16):
            told += piece
        os.close(reading)
    return look(
        folder, [_MESSAGE.unpack_from(told, at) for at in range(0, len(told) - _MESSAGE.size + 1, _MESSAGE.size)]
    )


def look(folder: Path, told: list[tuple[int, int, float]]) -> Left:
    """Compare a recording with the acquired frames."""
    recording = Recording(folder)
    assert not recording.is_complete
    lines = [recording.line(index) for index in range(len(recording))]
    begins = max(at for at, (index, *_) in enumerate(told) if index == 0)  # the camera's last start
    acquired = {index: (checksum, time_s) for index, checksum, time_s in told[begins:]}
    expected = [index for index in acquired if index >= lines[0].camera_index]
    wrong = sum(zlib.crc32(recording.pixels(line.index).data) != acquired[line.camera_index][0] for line in lines)
    seconds = acquired[expected[-1]][1] - acquired[expected[0]][1]
    return Left(len(expected), len(expected) - len(lines), wrong, (len(expected) - 1) / max(seconds, 1e-9))


def record(bench: Bench, folder: Path, pipe: int) -> None:
    """Record until killed; send a message for every frame."""

    def open_telling(bench: Bench, progress: Callable[[float], None]) -> Devices:
        devices = open_devices(bench, progress)
        read = devices.camera.read

        def tell(timeout_s: float) -> Frame:
            frame = read(timeout_s)
            os.write(pipe, _MESSAGE.pack(frame.index, zlib.crc32(frame.pixels.data), frame.host_time_s))
            return frame

        devices.camera.read = tell  # type: ignore[method-assign] # the message comes first
        return devices

    acquisition = Acquisition(bench, open_telling)
    acquisition.start()
    for step in (*start_up(acquisition, 4), acquisition.start_recording(folder)):
        step.result()
    time.sleep(HANG_S)


def main() -> None:
    """Record, as the program to be killed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--record", type=Path)
    parser.add_argument("--pipe", type=int)
    parser.add_argument("--bench")
    parser.add_argument("settings", nargs="*")
    given = parser.parse_args()
    record(load_bench(given.bench, tuple(given.settings)), given.record, given.pipe)


if __name__ == "__main__":
    main()
