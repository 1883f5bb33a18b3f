"""Figures of an instrument process under load; `python -m support.measure_processes --help`.

A simulated bench at 70 frames/s in a process of its own, and a client that sends commands. Others may watch, one of
them a window that is drawn offscreen, and frames may be recorded.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from app.acquisition.instrument import Instrument
from app.acquisition.remote.connection import Connection, reach
from app.errors import RunError

_PROGRAM = "import sys; from app.cli import main; sys.argv = ['svwfs', *sys.argv[1:]]; main()"
_WATCH = """
import time
from app.acquisition.remote.connection import Connection, reach
connection = reach("viewer", takes_control=False)
while connection.newest is None or connection.newest.wavefront is None:
    time.sleep(0.1)
print("watches", flush=True)
time.sleep(600)
"""
_COMMANDS = 200
_NAME = "measured"


def main() -> None:
    """Measure what the arguments say."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--bench", default="small_demo")
    parser.add_argument("--set", nargs="*", default=["camera.exposure_s=0.0143"], help="70 frames/s")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--viewers", type=int, default=0, help="programs that receive every frame they can")
    parser.add_argument("--window", action="store_true", help="the window watches, too")
    parser.add_argument("--record", action="store_true", help="every frame is recorded")
    parser.add_argument("--idle", action="store_true", help="the camera stands still")
    asked = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        serve = [sys.executable, "-c", _PROGRAM, "serve", "--bench", asked.bench, "--name", _NAME]
        _program(stack, [*serve, *(f"--set={each}" for each in asked.set)])
        client = _connect(stack)
        while client.newest is None or client.newest.wavefront is None or client.activity.text:
            time.sleep(0.05)
        watch = [sys.executable, "-c", _WATCH.replace('"viewer", ', f'"viewer", "{_NAME}", ')]
        watching = [_program(stack, watch) for _ in range(asked.viewers)]
        if asked.window:
            live = f"live --attach --name {_NAME} --seconds {asked.seconds + 10} --out {folder / 'window'}".split()
            os.environ["QT_QPA_PLATFORM"] = "offscreen"
            window = subprocess.Popen([sys.executable, "-c", _PROGRAM, *live], stdout=subprocess.DEVNULL)  # noqa: S603 - this interpreter
            stack.callback(window.terminate)
            watching.append(window)
            time.sleep(5.0)
        if asked.record:
            client.start_recording(folder / "recording").result()
        time.sleep(3.0)
        watched = [client.address.process, *(each.pid for each in watching)]
        if asked.idle:
            client.submit(Instrument.set, "is_running", False).result()
            time.sleep(1.0)
        before, began_s, used_s = client.counts, time.monotonic(), [_processor_s(each) for each in watched]
        time.sleep(asked.seconds)
        after, span_s = client.counts, time.monotonic() - began_s
        shares = [(_processor_s(each) - was) / span_s for each, was in zip(watched, used_s, strict=True)]
        latency = client.timings.summary()["to_result"]
        p50_ms, p99_ms = np.percentile([_round_trip_s(client) for _ in range(_COMMANDS)], (50, 99)) * 1e3
        acquired = after.acquired - before.acquired
        print(  # noqa: T201 - a table for its reader
            f"{asked.viewers} viewers: {acquired / span_s:.1f} frames/s, {after.reconstructed - before.reconstructed}"
            f" of {acquired} measured, {after.lost - before.lost} lost; command 50 %"
            f" {p50_ms:.1f} ms, 99 % {p99_ms:.1f} ms; exposure to"
            f" result 50 % {latency.p50_s * 1e3:.1f} ms, 99 % {latency.p99_s * 1e3:.1f} ms;"
            f" of one processor: instrument {shares[0]:.0%}, others {', '.join(f'{each:.0%}' for each in shares[1:])}"
            f" (load {os.getloadavg()[0]:.1f})"
        )
        if asked.window:
            window.wait()
            draw = json.loads((folder / "window" / "run.json").read_text())["timings"]["draw"]
            print(f"the window: {draw}")  # noqa: T201 - a table for its reader
        if client.recording is not None:
            print(f"the recording: {client.recording}")  # noqa: T201 - a table for its reader
        client.shut_down().result()


def _round_trip_s(client: Connection) -> float:
    """Time of a command that changes nothing, after a pause."""
    time.sleep(0.01)
    sent_s = time.perf_counter()
    client.submit(Instrument.set, "is_sample_in", True).result()
    return time.perf_counter() - sent_s


def _processor_s(process: int) -> float:
    """Processor time that a process has used (Linux)."""
    used = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
    return sum(map(int, used)) / os.sysconf("SC_CLK_TCK")


def _connect(stack: ExitStack) -> Connection:
    while True:
        try:
            client = reach("measuring", _NAME)
        except RunError:
            time.sleep(0.1)
        else:
            stack.callback(client.close)
            return client


def _program(stack: ExitStack, command: list[str]) -> subprocess.Popen[bytes]:
    """Start a program, wait for its first line, and end it at the end."""
    process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))  # noqa: S603 - this interpreter
    stack.callback(process.terminate)
    assert process.stdout is not None
    process.stdout.readline()
    return process


if __name__ == "__main__":
    main()
