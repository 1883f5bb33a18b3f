"""Runs the storms of all or some drivers with SVWFS_SEQUENCES sequences each: `make storms`.

Each thousand sequences have their own process, as hypothesis slows down with its memory. The GenICam camera, in real
time, has many processes, each in its own network namespace. A process without a step for five minutes hangs, and writes
its stacks to the log.
"""

from __future__ import annotations

import argparse
import faulthandler
import math
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from app.commands.terminal import progress_bar
from support.paths import TESTS
from support.storm import FEW, MANY, Storm

STORMS = {
    "genicam": "drivers/genicam/test_genicam.py::test_storm_raises_only_device_errors",
    "dcam": "drivers/dcam/test_dcam_storm.py",
    "micro_manager": "drivers/micro_manager/test_micro_manager.py::test_storm_raises_only_device_errors",
    "simulated_camera": "simulated_devices/test_simulated_storms.py::TestSimulatedCamera",
    "recording": "app/recording/test_recording_camera_storm.py",
    "simulated_light": "simulated_devices/test_simulated_storms.py::TestSimulatedLight",
    "thorlabs_dc4100": "drivers/serial_lights/test_dc4100.py::TestStorm",
    "thorlabs_dc2200": "drivers/usb_lights/test_dc2200.py::TestStorm",
    "coolled": "drivers/serial_lights/test_coolled.py::TestStorm",
}
WAITING = {"genicam", "micro_manager"}  # mostly for a real clock
BATCH = 1000  # sequences per process
AT_ONCE = 12  # waiting processes
HANGS_S = 300.0  # longer than a stall of a busy computer
_OPTIONS = ["-q", "--timeout=0", "-o", "faulthandler_timeout=0", "-p", "no:cacheprovider"]
_OPTIONS += ["-W", "ignore:Module already imported:pytest.PytestAssertRewriteWarning"]  # storm.py
_TALLY = struct.Struct("<qq")  # sequences, steps
_is_interrupted = threading.Event()
_OWN_NETWORK = ["unshare", "--user", "--map-root-user", "--net", "sh", "-c", 'ip link set lo up && exec "$@"', "sh"]


@dataclass(slots=True)
class Share:
    """A process running sequences of one driver, with its progress."""

    log: Path
    sequences: int = 0
    steps: int = 0
    has_failed: bool = False

    def run(self, driver: str, wanted: int, *, own_network: bool) -> None:
        """Run that many sequences."""
        if _is_interrupted.is_set():
            return
        reading, writing = os.pipe()
        command = [sys.executable, "-m", "support.run_storms", "--pipe", str(writing), driver]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(sys.path),
            "SVWFS_SEQUENCES": str(wanted),
            "QT_QPA_PLATFORM": "offscreen",
        }
        with self.log.open("wb") as log:
            process = subprocess.Popen(  # noqa: S603 - this file
                [*_OWN_NETWORK, *command] if own_network else command,
                pass_fds=[writing],
                env=environment,
                cwd=TESTS.parent,
                stdout=log,
                stderr=log,
            )
        os.close(writing)
        with open(reading, "rb") as pipe:  # noqa: PTH123 - it has no path
            while len(tally := pipe.read(_TALLY.size)) == _TALLY.size:
                self.sequences, self.steps = _TALLY.unpack(tally)
        self.has_failed = process.wait() != 0


def run_here(driver: str, pipe: int) -> int:
    """Run SVWFS_SEQUENCES sequences of a driver in this process, and report the progress."""
    errors = os.fdopen(os.dup(2), "w")  # visible although pytest captures output
    over = threading.Event()

    def report() -> None:
        os.write(pipe, _TALLY.pack(Storm.tally.sequences, Storm.tally.steps))

    def watch() -> None:
        steps, moved_s = 0, time.monotonic()
        while not over.wait(1.0):
            report()
            if steps != Storm.tally.steps or not steps:  # compilation comes before the first step
                steps, moved_s = Storm.tally.steps, time.monotonic()
            elif time.monotonic() - moved_s > HANGS_S:
                faulthandler.dump_traceback(errors)
                os._exit(3)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        return int(pytest.main([*_OPTIONS, str(TESTS / STORMS[driver])]))
    finally:
        over.set()
        watcher.join()
        errors.close()
        report()


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a driver's storm."""

    driver: str
    sequences: int
    steps: int
    failed: tuple[Path, ...]  # logs
    took_s: float

    def __str__(self) -> str:
        counts = f"{self.sequences:8d} sequences{self.steps:9d} steps{len(self.failed):3d} failures"
        return " ".join([f"{self.driver:18}{counts}{self.took_s:7.0f} s", *map(str, self.failed)])


def run_driver(driver: str, wanted: int, folder: Path, on_progress: Callable[[float], None]) -> Outcome:
    """Run a driver's storm in several processes."""
    begin_s = time.monotonic()
    at_once = AT_ONCE if driver in WAITING and has_networks() else 1
    count = max(at_once, math.ceil(wanted / BATCH))
    shares = [Share(folder / f"{driver}_{number}.log") for number in range(count)]
    with ThreadPoolExecutor(at_once) as pool:
        each = math.ceil(wanted / count)
        running = [pool.submit(share.run, driver, each, own_network=at_once > 1) for share in shares]
        while not all(one.done() for one in running):
            on_progress(min(sum(share.sequences for share in shares) / wanted, 1.0))
            time.sleep(0.5)
    for one in running:
        one.result()
    return Outcome(
        driver,
        sum(share.sequences for share in shares),
        sum(share.steps for share in shares),
        tuple(share.log for share in shares if share.has_failed),
        time.monotonic() - begin_s,
    )


def has_networks() -> bool:
    """True if a process can have its own network namespace."""
    return (
        shutil.which("unshare") is not None
        and subprocess.run([*_OWN_NETWORK, "true"], capture_output=True, check=False).returncode == 0  # noqa: S603 - a constant
    )


def main() -> int:
    """Run one driver's storm in this process, or the named ones in their own processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drivers", nargs="*", metavar="driver", help=f"of {', '.join(STORMS)}; all where none is named")
    parser.add_argument("--pipe", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if unknown := [driver for driver in given.drivers if driver not in STORMS]:
        parser.error(f"there is no driver {unknown[0]!r}; there are {', '.join(STORMS)}")
    if given.pipe is not None:
        return run_here(given.drivers[0], given.pipe)
    drivers, wanted = given.drivers or list(STORMS), MANY or FEW
    folder = Path(tempfile.mkdtemp(prefix="svwfs-storms-"))
    done = dict.fromkeys(drivers, 0.0)
    failures = 0
    with progress_bar() as progress, ThreadPoolExecutor(os.cpu_count()) as pool:

        def run(driver: str) -> Outcome:
            def on_progress(fraction: float) -> None:
                done[driver] = fraction
                progress(f"{wanted} sequences a driver", sum(done.values()) / len(drivers))

            return run_driver(driver, wanted, folder, on_progress)

        try:
            for outcome in pool.map(run, drivers):
                failures += len(outcome.failed)
                sys.stdout.write(f"{outcome}\n")
                sys.stdout.flush()
        except KeyboardInterrupt:  # the processes receive it, too
            _is_interrupted.set()
            return 130
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
