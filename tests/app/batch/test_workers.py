"""Batches and studies on real worker processes of Dask: identical results, killed workers, a lost scheduler."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from distributed import Security
from distributed.comm.core import connect
from support.batches import batch, files_of, small_blocks
from support.command_line import run
from support.patience import HANG_S
from support.posix import SIGKILL
from support.recordings import record

from app.batch import workers as workers_module
from app.batch.workers import Workers, workers
from app.errors import InputError, RunError
from app.recording.reader import Recording

BLOCK, FRAMES = 4, 40


@pytest.fixture(scope="module")
def recording(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(small_toml, tmp_path_factory.mktemp("recording") / "run", frames=FRAMES)


@pytest.fixture(scope="module")
def alone(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Chunks of the results that one process makes."""
    out = tmp_path_factory.mktemp("alone") / "r.zarr"
    with pytest.MonkeyPatch.context() as patch:
        small_blocks(patch, BLOCK)
        batch(out, recording)
    return contents(out)


@pytest.fixture(scope="module")
def two_workers() -> Iterator[Workers]:
    with workers(2, None) as started:
        yield started


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    small_blocks(monkeypatch, BLOCK)


def contents(out: Path) -> dict[str, bytes]:
    return {name: chunk for name, (_, chunk) in files_of(out).items()}


def differing(out: Path, alone: dict[str, bytes]) -> list[str]:
    """Names of the chunks that one of the two lacks or that have other contents."""
    made = contents(out)
    return sorted(name for name in made.keys() | alone.keys() if made.get(name) != alone.get(name))


class Killing:
    """Evaluates on workers, and kills one of them after some results."""

    def __init__(self, on: Workers, after: set[int]) -> None:
        self._on, self._after = on, after
        self.killed: list[int] = []
        self.items = 0

    def __call__(self, function: Any, items: Any) -> Iterator[Any]:
        for each in self._on(function, items):
            self.items += 1
            if self.items in self._after:
                self.killed.append(self._kill())
            yield each

    def _kill(self) -> int:
        living = [pid for pid in self._on._client.run(os.getpid, on_error="ignore").values() if isinstance(pid, int)]
        pid = sorted(living)[len(self.killed) % len(living)]
        os.kill(pid, SIGKILL)
        return pid


@pytest.mark.slow
@pytest.mark.long
def test_three_killed_workers_change_nothing(
    recording: Recording, two_workers: Workers, alone: dict[str, bytes], tmp_path: Path
) -> None:
    """The two workers make the same files as a process alone."""
    killing = Killing(two_workers, {2, 5, 8})
    made = batch(tmp_path / "r.zarr", recording, evaluate=killing)
    assert (made.wavefronts, made.failed, len(set(killing.killed))) == (FRAMES, {}, 3)
    assert differing(tmp_path / "r.zarr", alone) == []


@pytest.mark.slow
@pytest.mark.long
def test_nothing_tells_other_users_what_the_workers_do(two_workers: Workers) -> None:
    (port,) = _http_ports(two_workers)
    with pytest.raises(HTTPError, match="404"):
        urlopen(f"http://127.0.0.1:{port}/info/main/workers.html", timeout=HANG_S)


def _http_ports(started: Workers) -> set[int]:
    """Ports of the scheduler's HTTP server."""
    return set(started._client.run_on_scheduler(lambda dask_scheduler: {dask_scheduler.http_server.port}))


def test_other_users_cannot_send_code_to_the_workers(two_workers: Workers) -> None:
    """Neither without a certificate nor with another one, and neither to the scheduler nor to a worker."""
    info = two_workers._client.scheduler_info(n_workers=-1)
    nannies = [each["nanny"] for each in info["workers"].values()]
    addresses = [info["address"], *info["workers"], *nannies]
    assert len(addresses) == 5
    for address in addresses:
        assert address.startswith("tls://127.0.0.1:")
        for scheme, security in (("tcp", None), ("tls", Security.temporary())):
            with pytest.raises((OSError, TimeoutError)):
                asyncio.run(_ask(address.replace("tls", scheme), security))


async def _ask(address: str, security: Security | None) -> None:
    arguments = {} if security is None else security.get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=2, **arguments), 5)
    await comm.write({"op": "identity", "reply": True})
    await asyncio.wait_for(comm.read(), 5)


@pytest.mark.slow
@pytest.mark.long
def test_workers_import_nothing_from_the_working_folder(tmp_path: Path) -> None:
    """Neither do the processes that Python starts beside them, as the one that frees what they shared."""
    for name in sys.stdlib_module_names:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()\n")
    program = (
        "from app.batch.workers import workers\nif __name__ == '__main__':\n with workers(1, None) as started:\n  "
    )
    program += "print(dict(started(abs, [-3.0])))"
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts" / "command.py").write_text(program)
    done = subprocess.run(  # noqa: S603 - the program above
        [sys.executable, tmp_path / "scripts" / "command.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, "{-3.0: 3.0}\n"), done.stderr
    assert not (tmp_path / "ran").exists()


def test_errors_of_tasks_are_results(two_workers: Workers) -> None:
    results = dict(two_workers(_inverse, [1.0, 0.0, 4.0]))
    assert (results[1.0], results[4.0]) == (1.0, 0.25)
    assert isinstance(results[0.0], ZeroDivisionError)


def _inverse(number: float) -> float:
    return 1 / number


@pytest.mark.slow
@pytest.mark.long
def test_deadly_task_is_told(two_workers: Workers) -> None:
    """After some workers, the task is at fault; Dask's usual four would take long to start."""
    _allow_failures(two_workers, 1)
    ((_, error),) = two_workers(os._exit, [3])
    _allow_failures(two_workers, 3)
    assert isinstance(error, InputError)
    assert str(error) == "2 workers died of it; is there too little memory?"


def _allow_failures(on: Workers, count: int) -> None:
    on._client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", count))


@contextmanager
def scheduler_and_worker() -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Address and process of a scheduler with one worker."""
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    scheduler = subprocess.Popen(  # noqa: S603 - Dask's own program
        [*command, "--no-dashboard"], stderr=subprocess.PIPE, text=True, env=environment
    )
    worker = None
    try:
        assert scheduler.stderr is not None
        address = next(
            found[1] for line in scheduler.stderr if (found := re.search(r"Scheduler at:\s+(tcp://\S+)", line))
        )
        words = ["-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        worker = subprocess.Popen(  # noqa: S603 - the same
            [sys.executable, *words], stderr=subprocess.DEVNULL, env=environment
        )
        yield address, scheduler
    finally:
        for process in (worker, scheduler):
            if process is not None:
                process.kill()
                process.wait()
        if scheduler.stderr is not None:
            scheduler.stderr.close()


@pytest.mark.slow
@pytest.mark.long
def test_second_run_completes_what_a_killed_scheduler_left(
    recording: Recording, alone: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "r.zarr"
    with scheduler_and_worker() as (address, scheduler), workers(None, address) as cluster:
        killing = Killing(cluster, {3})
        killing._kill = lambda: scheduler.kill() or 0  # type: ignore[method-assign,func-returns-value] # not a worker
        with pytest.raises(RunError, match=r"the scheduler is lost.*; \d+ of 40 frames are in .*the same command"):
            batch(out, recording, evaluate=killing)
    left = files_of(out)
    done = sum(name.startswith("state/") for name in left)
    assert 2 <= done < FRAMES // BLOCK
    made = batch(out, recording)
    assert made.computed == FRAMES - BLOCK * done
    assert differing(out, alone) == []
    kept = {name for name in left if name.startswith("state/")}
    assert all(files_of(out)[name][0] == left[name][0] for name in kept)  # not written again


# `svwfs batch` with small blocks, of which all after the second take their time; its worker imports this, too.
UNHURRIED = """
import time
from app.batch import store
from app.cli import main

store.BLOCK_FRAMES = 4
write = store.ResultStore.write

def write_late(self, number, frames, *results):
    time.sleep(3.0 if frames.start > 4 else 0.0)
    return write(self, number, frames, *results)

store.ResultStore.write = write_late
if __name__ == "__main__":
    main()
"""


@pytest.mark.posix
@pytest.mark.slow
@pytest.mark.long
def test_ctrl_c_stops_cleanly(recording: Recording, alone: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "r.zarr"
    (tmp_path / "program.py").write_text(UNHURRIED)
    given = (tmp_path / "program.py", "batch", recording.folder, "--out", out, "--workers", "1")
    words = [sys.executable, *map(str, given)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    started = subprocess.Popen(  # noqa: S603 - this program
        words, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True
    )
    deadline_s = time.monotonic() + HANG_S
    while not (out / "state" / "c" / "0" / "1").exists():
        assert time.monotonic() < deadline_s
        assert started.poll() is None
        time.sleep(0.02)
    os.killpg(started.pid, signal.SIGINT)  # as a terminal does, also to the worker
    _, said = started.communicate(timeout=HANG_S)
    assert started.returncode == 130
    assert re.search(r"svwfs: interrupted: \d+ of 40 frames are in \S+, the same command does the rest\n$", said)
    assert "Traceback" not in said
    done = sum(name.startswith("state/") for name in files_of(out))
    assert batch(out, recording).computed == FRAMES - BLOCK * done
    assert differing(out, alone) == []


@pytest.mark.slow
@pytest.mark.long
def test_command_reports_failures_at_the_end(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with scheduler_and_worker() as (address, _):
        words = ("batch", recording.folder, tmp_path / "nowhere", "--out", tmp_path / "r.zarr", "--scheduler", address)
        assert run(monkeypatch, *words) == 1
    said = capsys.readouterr()
    assert "nowhere: no such folder" in said.out
    assert f"holds 1 recording with {FRAMES} frames" in said.out
    assert said.err.endswith("svwfs: 1 of 2 recordings failed\n")


@pytest.mark.slow
@pytest.mark.long
def test_wrong_store_is_refused_before_workers_start(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def start(*_: object) -> None:
        pytest.fail("workers were started")

    monkeypatch.setattr(workers_module, "workers", start)
    (tmp_path / "letter.txt").touch()
    batch(tmp_path / "r.zarr", recording)
    for out, sentence, options in (
        (recording.folder / "r.zarr", "lies in the recording", ()),
        (tmp_path / "letter.txt", "is a file; the results need a folder", ()),
        (tmp_path / "r.nc", "the results are a Zarr store, which is a folder: end its name with .zarr", ()),
        (tmp_path / "r.zarr", "its results differ from these in rounds", ("--refine", "1")),
        (tmp_path / "new.zarr", "registration.foo is an unknown key", ("--set", "registration.foo=1")),
        (tmp_path / "new.zarr", f"selects no frame; {recording.folder} has {FRAMES}", ("--frames", f"{FRAMES}:")),
    ):
        assert run(monkeypatch, "batch", recording.folder, "--out", out, "--workers", "1", *options) == 2
        assert sentence in capsys.readouterr().err


def test_missing_scheduler_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers_module, "_CONNECT_S", 0.5)
    with (
        pytest.raises(RunError, match=r"tcp://127.0.0.1:1: no scheduler can be reached there"),
        workers(None, "tcp://127.0.0.1:1"),
    ):
        pass
    with pytest.raises(InputError, match="give one option"), workers(2, "tcp://127.0.0.1:1"):
        pass


def test_wrong_address_is_refused_before_a_client_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the client waits 40 s for its end, and prints a traceback."""
    monkeypatch.setattr("distributed.Client", None)
    for address in (
        "garbage://x:1",
        "",
        "node1",
        "tcp://",
        "tcp://:8786",
        "tcp://node1:99999",
        "tcp://node1:x",
        "[::1:1",
    ):
        sentence = f"--scheduler {address}: give host and port, as tcp://node1:8786"
        with pytest.raises(InputError, match=re.escape(sentence)), workers(None, address):
            pass


@pytest.mark.slow
def test_without_dask_a_sentence_tells_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"workers need Dask: install the extra svwfs\[batch\]"), workers(1, None):
        pass
