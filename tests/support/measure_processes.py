"""Figures of an instrument process under load, printed by `python -m support.measure_processes [VIEWERS] [idle]`.

A simulated bench at 70 frames/s in a process of its own, with a client that sends commands and others that watch; if
it is to be idle, the camera is stopped.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from app.acquisition.instrument import Instrument
from app.acquisition.remote.connection import Connection
from app.errors import RunError

_SERVE = "import sys; from app.cli import main; sys.argv = ['svwfs', *sys.argv[1:]]; main()"
_WATCH = """
import time
from app.acquisition.remote.connection import Connection
connection = Connection("viewer", controls=False)
while connection.newest is None or connection.newest.wavefront is None:
    time.sleep(0.1)
print("watches", flush=True)
time.sleep(600)
"""
_SPAN_S, _COMMANDS = 10.0, 200
_NAME = "measured"


def main() -> None:
    """Measure with as many viewers as the first argument says."""
    viewers = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    with ExitStack() as stack:
        serve = [sys.executable, "-c", _SERVE, "serve", "--bench", "small_demo", "--set", "camera.exposure_s=0.0143"]
        stack.enter_context(_program([*serve, "--name", _NAME]))
        client = _connect(stack)
        while client.newest is None or client.newest.wavefront is None or client.activity.text:
            time.sleep(0.05)
        watch = _WATCH.replace('"viewer", ', f'"viewer", "{_NAME}", ')
        watching = [stack.enter_context(_program([sys.executable, "-c", watch])).pid for _ in range(viewers)]
        time.sleep(3.0)
        watched = [client.place.process, *watching]
        if "idle" in sys.argv:
            client.submit(Instrument.set, "is_running", False).result()
            time.sleep(1.0)
        before, began_s, used_s = client.counts, time.monotonic(), [_processor_s(each) for each in watched]
        time.sleep(_SPAN_S)
        after, span_s = client.counts, time.monotonic() - began_s
        shares = [(_processor_s(each) - was) / span_s for each, was in zip(watched, used_s, strict=True)]
        latency = client.timings.summary()["to_result"]
        trips_s = []
        for _ in range(_COMMANDS):
            sent_s = time.perf_counter()
            client.submit(Instrument.set, "is_sample_in", True).result()
            trips_s.append(time.perf_counter() - sent_s)
            time.sleep(0.01)
        p50_ms, p99_ms = np.percentile(trips_s, (50, 99)) * 1e3
        acquired = after.acquired - before.acquired
        print(  # noqa: T201 - a table for its reader
            f"{viewers} viewers: {acquired / span_s:.1f} frames/s, {after.reconstructed - before.reconstructed} of"
            f" {acquired} measured, {after.lost - before.lost} lost; command 50 %"
            f" {p50_ms:.1f} ms, 99 % {p99_ms:.1f} ms; exposure to"
            f" result 50 % {latency.p50_s * 1e3:.1f} ms, 99 % {latency.p99_s * 1e3:.1f} ms;"
            f" of one processor: instrument {shares[0]:.0%}, each viewer {np.mean(shares[1:] or [0]):.0%}"
            f" (load {os.getloadavg()[0]:.1f})"
        )
        client.shut_down().result()


def _processor_s(process: int) -> float:
    """Processor time that a process has used (Linux)."""
    used = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
    return sum(map(int, used)) / os.sysconf("SC_CLK_TCK")


def _connect(stack: ExitStack) -> Connection:
    while True:
        try:
            client = Connection("measuring", _NAME)
        except RunError:
            time.sleep(0.1)
        else:
            stack.callback(client.close)
            return client


def _program(command: list[str]) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(command, stdout=subprocess.PIPE)  # noqa: S603 - this interpreter
    assert process.stdout is not None
    process.stdout.readline()
    return process


if __name__ == "__main__":
    main()
