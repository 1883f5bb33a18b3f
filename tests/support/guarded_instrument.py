"""An instrument in a process of its own, with a DCAM camera and a DC4100 whose stand-in is in the test's process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from support.dcam_tools import built
from support.paths import FOREIGN_FRAMES
from support.wires.dc4100 import DC4100Wire

INSTRUMENT = """
import sys, time
from pathlib import Path
from support.wires.dcam.stand_in import StandIn
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench

bench = load_bench(sys.argv[1])
StandIn(Path(bench.camera.library)).reset(1.0)
acquisition = Acquisition(bench)
acquisition.start()
for step in start_up(acquisition, frames=3):
    step.result()
print("lit", flush=True)
while acquisition.is_alive:
    time.sleep(0.01)
sys.exit(acquisition.failure)
"""


def children(pid: int) -> set[int]:
    """The processes that all threads of a process have started, and that live."""
    found = set[int]()
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # of a thread that has ended meanwhile
            found |= {int(child) for child in (task / "children").read_text().split()}
    return {child for child in found if not is_gone(child)}


def is_gone(pid: int) -> bool:
    """True if a process has ended, also if its parent has not noticed yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):  # before and while it is read
        return True


def bench_toml(port: str, folder: Path) -> Path:
    path = folder / "bench.toml"
    path.write_text(
        (FOREIGN_FRAMES / "bench.toml").read_text()
        + f"""
[camera]
driver = "dcam"
library = "{built()}"
exposure_s = 0.02

[light]
driver = "thorlabs_dc4100"
port = "{port}"
current_a = 0.1
"""
    )
    return path


def _hear_all() -> None:
    """Die of what jobs of a shell and of `nohup` ignore."""
    for number in (signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@contextmanager
def lit_instrument(bench: Path, lamp: DC4100Wire) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(  # noqa: S603 - this interpreter
        [sys.executable, "-c", INSTRUMENT, str(bench)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        start_new_session=True,
        preexec_fn=_hear_all,  # noqa: PLW1509 - no thread is needed in it
    ) as program:
        try:
            assert program.stdout is not None
            assert program.stderr is not None
            assert program.stdout.readline() == "lit\n", program.stderr.read()
            assert lamp.is_lit
            yield program
        finally:
            program.kill()
