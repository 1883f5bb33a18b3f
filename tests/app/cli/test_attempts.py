"""Bad input ends in one clear line and the right status: no traceback, no crash, no hang.

The suite runs the same few hundred attempts each time; with SVWFS_SEQUENCES set, as in `make storms`, that many
random ones.
"""

from __future__ import annotations

import random
import shutil
import time
from pathlib import Path

import pytest
from support.attempts import Attempt, bench_keys, make_folder, some
from support.command_line import run
from support.recordings import record
from support.storm import MANY, Storm

FEW = 330
LONGEST_S = 20.0  # of computing in one attempt; one that waits for ever meets the timeout


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory, small_toml: Path) -> Path:
    """Good inputs: a bench, three images and a recording."""
    folder = tmp_path_factory.mktemp("prepared")
    quick = small_toml.read_text().replace('warp = "quadratic"', 'warp = "affine"')
    (folder / "bench.toml").write_text(quick.replace("[reconstruction]\n", "[reconstruction]\nresponse = false\n"))
    with pytest.MonkeyPatch.context() as patch:
        assert run(patch, "simulate", "--bench", folder / "bench.toml", "--out", folder) == 0
    (folder / "truth.nc").unlink()
    record(folder / "bench.toml", folder / "run", frames=4)
    return folder


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(0 if MANY else 600)
def test_bad_input_is_one_line(
    prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    seed = random.SystemRandom().randrange(2**32) if MANY else 0
    faults = []
    for number, attempt in enumerate(some(MANY or FEW, seed, bench_keys(prepared / "bench.toml"))):
        folder = tmp_path / str(number)
        make_folder(prepared, folder)
        monkeypatch.chdir(folder)
        if fault := fault_of(attempt, folder, monkeypatch, capfd):
            faults.append(f"{attempt}: {fault}")
        monkeypatch.chdir(tmp_path)
        shutil.rmtree(folder)
        Storm.tally.sequences += 1
        Storm.tally.steps += 1
    assert not faults, f"{len(faults)} of {number + 1} attempts, seed {seed}:\n" + "\n".join(faults)


def fault_of(attempt: Attempt, folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> str:
    """Faults in how an attempt ended; empty if there are none."""
    attempt.prepare(folder)
    begin_s = time.process_time()
    try:
        status = run(monkeypatch, *attempt.command)
    except BaseException as error:  # noqa: BLE001 - that is what is looked for
        capfd.readouterr()
        return f"{type(error).__name__}: {str(error)[:300]}"
    took_s = time.process_time() - begin_s
    output, errors = capfd.readouterr()
    lines = [line for line in errors.splitlines() if line and not line.startswith("note: ")]
    is_usage = status == 2 and lines[-1].startswith("Error: ")
    is_one_line = len(lines) == 1 and lines[0].startswith("svwfs: ")
    faults = {
        f"status {status}": status not in attempt.statuses,
        f"took {took_s:.0f} s": took_s > LONGEST_S,
        "control codes": "\x1b" in output + errors,
        "not one line": not (is_usage or is_one_line) if status else bool(lines),
        "partial files": any(".partial" in path.name for path in folder.rglob(".*")),
    }
    found = ", ".join(fault for fault, is_there in faults.items() if is_there)
    return f"{found}: {errors[:300]!r}" if found else ""
